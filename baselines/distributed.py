"""Several processes train one network, each on its share of every batch, as `torchrun` starts them.

Gradients are averaged by torch's `DistributedDataParallel`; whatever else the ranks must agree on
goes through the functions here. For one process each of them is the identity.
"""

import logging
import math
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, redirect_stderr, redirect_stdout
from datetime import timedelta
from typing import Any, Literal, TypeAlias

import torch
from jaxtyping import Shaped
from torch import Tensor, distributed, nn
from torch.distributed.rendezvous import rendezvous

from sacil_tasks.errors import UsageError

Device: TypeAlias = Literal["auto", "cpu", "cuda"]
"""`auto`: a GPU where there is one."""

PATIENCE = timedelta(hours=1)
"""How long ranks wait for each other: the first one validates and saves alone."""

PLAIN_BATCH_NORM = (nn.BatchNorm1d, nn.BatchNorm2d, nn.BatchNorm3d)


def ranks() -> int:
    """How many processes train together."""
    return distributed.get_world_size() if distributed.is_initialized() else 1


def rank() -> int:
    """Which of them this is, from 0; the first one alone writes and speaks."""
    return distributed.get_rank() if distributed.is_initialized() else 0


@contextmanager
def process_group() -> Iterator[None]:
    """Join the processes that `torchrun` started, if it did.

    What ends one rank ends all: the others find it gone at their next exchange. Only the first one
    to end says why; the others leave without a word.

    Raises:
        SystemExit: another rank has ended before.
    """
    if int(os.environ.get("WORLD_SIZE", "1")) == 1:
        yield
        return
    store, number, size = next(rendezvous("env://"))
    # Numbers to agree on are in host memory, so they travel by gloo also between GPUs.
    backend = "cpu:gloo,cuda:nccl" if torch.cuda.is_available() else "gloo"
    distributed.init_process_group(
        backend, store=store, rank=number, world_size=size, timeout=PATIENCE
    )
    try:
        with ExitStack() as stack:
            if number > 0:
                stack.enter_context(_muted())
            yield
    except (Exception, KeyboardInterrupt):
        if _ends_first(store, number):
            raise
        raise SystemExit(1) from None
    distributed.destroy_process_group()


def _ends_first(store: Any, number: int) -> bool:
    """Whether no rank has ended before this one."""
    try:
        return store.compare_set("ended", "", str(number)) == str(number).encode()
    except RuntimeError:  # the store went with the process that held it
        return False


@contextmanager
def _muted() -> Iterator[None]:
    """Print, log and draw nothing."""
    with open(os.devnull, "w") as nowhere, redirect_stdout(nowhere), redirect_stderr(nowhere):
        logging.disable()
        try:
            yield
        finally:
            logging.disable(logging.NOTSET)


def own_device(choice: Device) -> torch.device:
    """Where this process computes: each process of a machine takes a GPU of its own.

    Raises:
        UsageError: a GPU is asked for, or there are some, but not one for each process.
    """
    found, wanted = torch.cuda.device_count(), int(os.environ.get("LOCAL_WORLD_SIZE", "1"))
    if choice == "cpu" or (choice == "auto" and found == 0):
        return torch.device("cpu")
    if found < wanted:
        raise UsageError(
            f"{wanted} processes need a GPU each, but this machine has {found}. "
            "Start fewer with --nproc_per_node, or choose --device cpu."
        )
    device = torch.device("cuda", int(os.environ.get("LOCAL_RANK", "0")))
    torch.cuda.set_device(device)
    return device


def device_name(device: torch.device) -> str:
    """`cpu`, or what the GPU is called."""
    return torch.cuda.get_device_name(device) if device.type == "cuda" else device.type


def share(rows: int) -> slice:
    """Which rows of a batch are this rank's: a run of them, as many as every other's.

    Raises:
        UsageError: they cannot be shared equally.
    """
    each, rest = divmod(rows, ranks())
    if rest:
        raise UsageError(
            f"a batch of {rows} cannot be shared equally by {ranks()} processes. "
            f"Choose --recipe.batch as a multiple of {ranks()}, or another --nproc_per_node."
        )
    return slice(rank() * each, (rank() + 1) * each)


def gathered(rows: Shaped[Tensor, "b *d"]) -> Shaped[Tensor, "all_b *d"]:
    """The rows of all ranks, in the order of the batch; gradients go back to whose they are."""
    return rows if ranks() == 1 else _Gather.apply(rows)


class _Gather(torch.autograd.Function):
    """All-gather; backwards every rank gets the sum of what all ranks say about its rows.

    torch's own (`distributed.nn.functional.all_gather`) is deprecated.
    """

    @staticmethod
    def forward(ctx: Any, rows: Shaped[Tensor, "b *d"]) -> Shaped[Tensor, "all_b *d"]:
        rows = rows.contiguous()
        parts = [torch.empty_like(rows) for _ in range(ranks())]
        distributed.all_gather(parts, rows)
        return torch.cat(parts)

    @staticmethod
    def backward(ctx: Any, *gradients: Shaped[Tensor, "all_b *d"]) -> Shaped[Tensor, "b *d"]:
        (gradient,) = gradients
        total = gradient.clone(memory_format=torch.contiguous_format)
        distributed.all_reduce(total)
        return total.chunk(ranks())[rank()]


def _summed(values: Sequence[float]) -> list[float]:
    total = torch.tensor(values, dtype=torch.float64)
    distributed.all_reduce(total)
    return total.tolist()


def averaged(values: Mapping[str, float]) -> dict[str, float]:
    """Means over the ranks on which a value exists (is not NaN); names are the same on all."""
    if ranks() == 1:
        return dict(values)
    exist = [not math.isnan(value) for value in values.values()]
    known = [value if e else 0.0 for value, e in zip(values.values(), exist, strict=True)]
    sums = _summed([*known, *exist])
    counts = sums[len(values) :]
    means = [total / n if n else math.nan for total, n in zip(sums, counts, strict=False)]
    return dict(zip(values, means, strict=True))


def anywhere(flag: bool) -> bool:  # noqa: FBT001
    """Whether `flag` holds on any rank; all ranks must ask."""
    return flag if ranks() == 1 else _summed([flag]) != [0.0]


def wait_for_all() -> None:
    """Go on when all ranks have come this far."""
    anywhere(False)  # noqa: FBT003


def of_first(number: int) -> int:
    """The number that the first rank holds."""
    return number if ranks() == 1 else int(_summed([number if rank() == 0 else 0])[0])


@contextmanager
def first_rank_first() -> Iterator[None]:
    """Run the block on the first rank, then on the others, which find what it has made."""
    if rank() > 0:
        wait_for_all()
    yield
    if rank() == 0:
        wait_for_all()


def batch_norms(network: nn.Module) -> list[str]:
    """Layers whose training depends on which samples a process has beside each other."""
    found = network.named_modules()
    return [n for n, layer in found if isinstance(layer, PLAIN_BATCH_NORM) and layer.training]
