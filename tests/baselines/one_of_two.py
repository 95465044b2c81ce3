"""What each of two ranks does in `test_distributed.py`: they start once, for all of its tests.

`python one_of_two.py DATA OUT`, in the environment that `torchrun` gives its processes.
"""

import signal
import sys
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import torch
from networks import TEXT, gradients, make_batch, registered, rows, tiny
from safetensors.torch import save_file

from baselines import agent, run, trainer
from baselines.agent import Network, find_agent
from baselines.batch import Batch
from baselines.distributed import averaged, batch_norms, process_group, rank, share
from baselines.options import parse
from baselines.train import main
from baselines.trainer import shared_loss
from sacil_tasks.errors import UsageError, run_command


def network_of(name: str) -> Network:
    """A small network of an agent, the same every time."""
    spec, variant = find_agent(name)
    torch.manual_seed(0)
    return spec.create(tiny(spec.config("cpu", variant)), TEXT).train()


def batch_of(network: Network) -> Batch:
    return make_batch(network.sight, goals=network.goal_sight)


def draw_alike(patch: Callable[[object, str, object], None]) -> None:
    """What a loss draws at random for each row is the same for all rows, whoever has them."""
    draw = torch.rand

    def same(count: int, *shape: int) -> torch.Tensor:
        return draw(1, *shape, generator=torch.Generator().manual_seed(0)).expand(count, *shape)

    patch(torch, "rand", same)


def know_tiny(patch: Callable[[object, str, object], None]) -> None:
    """Make the agent `tiny` known, and let its runs be logged and saved every second step."""
    known = {**agent.agent_modules(), "tiny": "synthetic"}
    patch(agent, "agent_modules", lambda: known)
    patch(run, "LOG_EVERY", 2)
    patch(run, "SAVE_EVERY_S", 0.0)


def train(data: Path, out: Path, *flags: str) -> None:
    tasks = ("--tasks", "pick_and_lift", "pick_up_cup", "--agent", "tiny:goals", "--dropout", "0")
    paths = ("--data", str(data), "--out", str(out))
    main(parse([*tasks, *paths, "--steps", "12", "--validate-every", "4", *flags]))


def learn_from_a_share(name: str, out: Path) -> None:
    """Write gradients, loss and terms as two ranks find them."""
    network = network_of(name)
    if batch_norms(network):
        return
    taught = shared_loss(network)
    loss, terms = taught(rows(batch_of(network), share(4)))
    loss.backward()
    found = averaged({"loss": loss.item()} | {n: term.item() for n, term in terms.items()})
    if rank() == 0:
        scalars = {f"term {term}": torch.tensor(value) for term, value in found.items()}
        save_file(gradients(network) | scalars, out / f"{name}.safetensors")


def at_step(step: int, on: int, action: Callable[[], None]) -> None:
    """Run `action` in the middle of a step of one rank, once."""
    learn = trainer.Trainer.learn

    def learn_or_act(self: trainer.Trainer, batch: Batch) -> dict[str, float]:
        if self.step == step:
            trainer.Trainer.learn = learn
            if rank() == on:
                action()
        return learn(self, batch)

    trainer.Trainer.learn = learn_or_act


def diverge() -> None:
    """Make the coming loss infinite."""
    isfinite = torch.isfinite

    def not_finite(loss: torch.Tensor) -> torch.Tensor:
        torch.isfinite = isfinite
        return ~isfinite(loss)

    torch.isfinite = not_finite


def everything(data: Path, out: Path) -> None:
    """All stages, in an order that leaves the ranks in step; the last one ends them."""
    for name in registered():
        learn_from_a_share(name, out)
    know_tiny(setattr)
    train(data, out / "unbroken")
    at_step(5, 1, lambda: signal.raise_signal(signal.SIGINT))
    with suppress(KeyboardInterrupt):
        train(data, out / "stopped")
    stopped_at = run.TrainState.load(out / "stopped").progress.step
    train(data, out / "stopped", "--resume")
    at_step(3, 1, diverge)
    try:
        train(data, out / "diverged")
    except UsageError as error:
        (out / f"rank{rank()}").write_text(f"stopped at {stopped_at}; {error}")
    at_step(3, 0, lambda: setattr(run, "METRICS", "/dev/full"))
    train(data, out / "full")


def start() -> None:
    torch.set_num_threads(1)
    draw_alike(setattr)
    with process_group():
        everything(*map(Path, sys.argv[1:]))


if __name__ == "__main__":
    run_command(start)
