"""One training step.

A step is a function of (seed, step) and of the state before it, so a run that was killed and
resumed ends in the same bits as an unbroken one.
"""

import ctypes
import logging
import time
import warnings
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, nullcontext
from typing import TypeAlias

import torch
from torch import Tensor, nn
from torch.nn.parallel import DistributedDataParallel

from baselines.agent import Network, Recipe
from baselines.batch import Batch, moved
from baselines.distributed import anywhere, batch_norms, rank, ranks
from baselines.layers.products import FullWidth
from baselines.loader import Loader
from baselines.optim import Ema, Lamb, TensorTable, copy_into, learning_rate
from baselines.samples import stream
from sacil_tasks.errors import UsageError

log = logging.getLogger(__name__)

Loss: TypeAlias = Callable[[Batch], tuple[Tensor, dict[str, Tensor]]]

_M_TRIM_THRESHOLD, _M_MMAP_MAX = -1, -4
"""Names of glibc's malloc.h."""


def keep_freed_memory() -> None:
    """Make glibc reuse the large blocks of a step in the next one: 8 to 22 % more samples a second.

    By default it gives them back to the system, which then hands them out again page by page,
    zeroed. Elsewhere than on glibc nothing happens.
    """
    libc = ctypes.CDLL(None)
    if hasattr(libc, "mallopt"):
        libc.mallopt(_M_MMAP_MAX, 0)
        libc.mallopt(_M_TRIM_THRESHOLD, 2**31 - 1)


class _Loss(nn.Module):
    """A network whose forward pass is its loss, which is what DDP can wrap."""

    def __init__(self, network: Network) -> None:
        super().__init__()
        self.network = network

    def forward(self, batch: Batch) -> tuple[Tensor, dict[str, Tensor]]:
        return self.network.loss(batch)


def shared_loss(network: Network) -> Loss:
    """The network's loss; with several ranks its gradients are the means over them.

    Losses are means over samples, or are computed of all ranks' samples on each rank
    (`distributed.gathered`), so that is the gradient of the whole batch. Batch norm is the
    exception: its layers are named in a warning. Gradients are shared as long as the function that
    is returned lives.
    """
    if ranks() == 1:
        return network.loss
    if names := batch_norms(network):
        log.warning(
            "batch norm (%s) sees the samples of one process only: what is learnt depends on the "
            "number of processes.",
            ", ".join(names),
        )
    # Channels last, a 1x1 convolution has strides of two kinds that mean the same.
    warnings.filterwarnings("ignore", "Grad strides do not match bucket view strides")
    return DistributedDataParallel(_Loss(network))


class Trainer:
    """A network with its loader, optimiser and weight average, at some step of its run."""

    def __init__(
        self, network: Network, loader: Loader, recipe: Recipe, *, steps: int, seed: int
    ) -> None:
        """Begin at step 0 of `steps`, with the weights `network` has now."""
        keep_freed_memory()
        self.network = network.train()
        self.device = network.device
        self.recipe = recipe
        self.steps = steps
        self.step = 0
        self._loader = loader
        self._seed = seed
        self._optimiser = Lamb(network, weight_decay=recipe.weight_decay)
        self._ema = Ema(network, decay=recipe.ema_decay)
        self._loss = shared_loss(network)

    def advance(self) -> dict[str, float]:
        """Take one step; returns this rank's loss and terms, and the seconds its parts took.

        Raises:
            UsageError: the loss is not finite on some rank; the weights are left as they were.
        """
        start = time.perf_counter()
        batch = moved(self._loader.batch(self.step), self.device)
        loaded = time.perf_counter()
        terms = self.learn(batch)
        learnt = time.perf_counter()
        self._optimiser.step(self.lr)
        self._ema.update(self.step)
        self.step += 1
        seconds = {
            "seconds_loading": loaded - start,
            "seconds_network": learnt - loaded,
            "seconds_optimiser": time.perf_counter() - learnt,
        }
        return terms | seconds

    @property
    def lr(self) -> float:
        """Learning rate of the coming step."""
        peak, warmup = self.recipe.lr, self.recipe.warmup_steps
        return learning_rate(self.step, total=self.steps, peak=peak, warmup=warmup)

    def learn(self, batch: Batch) -> dict[str, float]:
        """Forward and backward; returns the loss and its terms.

        Raises:
            UsageError: the loss is not finite on some rank.
        """
        # Dropout draws from torch's global generator: fix it by step, or a resumed run differs.
        torch.manual_seed(int(stream(self._seed, self.step, "torch").integers(2**63)) + rank())
        with self._arithmetic():
            loss, terms = self._loss(batch)
        if anywhere(not torch.isfinite(loss)):
            raise self._diverged("the loss")
        loss.backward()
        return {name: float(term) for name, term in ({"loss": loss.detach()} | terms).items()}

    def _arithmetic(self) -> AbstractContextManager[object]:
        """D-precision: bfloat16 in the `cpu` preset; 32 bits at a CPU's full width."""
        if self.recipe.precision == "bf16":
            return torch.autocast(self.device.type, torch.bfloat16)
        return FullWidth() if self.device.type == "cpu" else nullcontext()

    def check_finite(self) -> None:
        """Refuse to save weights that a last, too large step has spoilt.

        Raises:
            UsageError: a weight is not finite.
        """
        if not all(bool(weight.isfinite().all()) for weight in self.network.parameters()):
            raise self._diverged("a weight")

    def _diverged(self, what: str) -> UsageError:
        return UsageError(
            f"{what} is no longer finite at step {self.step}. "
            "The state saved last is kept; train again with a lower --recipe.lr."
        )

    @property
    def averaged(self) -> TensorTable:
        """The weights to evaluate."""
        return self._ema.weights(self.network)

    def state(self) -> TensorTable:
        """The tensors a resumed run needs, by name: live, not copies."""
        return {
            f"{part}/{name}": tensor
            for part, tensors in self._parts().items()
            for name, tensor in tensors.items()
        }

    def restore(self, tensors: TensorTable, step: int) -> None:
        """Continue from what `state` gave at `step`.

        Raises:
            ValueError: the tensors are those of another network.
        """
        copy_into(self.state(), tensors)
        self.step = step

    def _parts(self) -> dict[str, Mapping[str, Tensor]]:
        return {
            "weights": {n: t.detach() for n, t in self.network.state_dict().items()},
            "average": self._ema.average,
            "mean": self._optimiser.mean,
            "square": self._optimiser.square,
        }
