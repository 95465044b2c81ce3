"""Latches: what counts as touching, grasping, acquiring and displacing, on made-up batches."""

import pytest
import torch

from sacil_tasks.events import ACQUIRED_STEPS, Events

CLOSING = torch.tensor([[0.0, 1.0, 0.0]])
STILL = torch.zeros(1, 3, 3)


def _forces(left: float, right: float, candidate: int = 1, axis: int = 1) -> torch.Tensor:
    forces_n = torch.zeros(1, 2, 3, 3)
    forces_n[0, 0, candidate, axis] = left
    forces_n[0, 1, candidate, axis] = right
    return forces_n


def _events() -> Events:
    return Events.create(1, torch.device("cpu"))


@pytest.mark.parametrize(
    ("forces_n", "touched", "grasped"),
    [
        (_forces(5, -5), True, True),
        (_forces(-5, 5), True, False),  # pulled apart
        (_forces(5, 0), True, False),  # one finger only
        (_forces(5, -5, axis=2), True, False),  # both push down
        (_forces(0.1, -0.1), False, False),
    ],
)
def test_grasp_needs_both_fingers_to_squeeze(
    forces_n: torch.Tensor, *, touched: bool, grasped: bool
) -> None:
    events = _events()
    events.touch(forces_n, CLOSING)
    assert events.touch_order.tolist() == [[0, int(touched), 0]]
    assert events.grasped.tolist() == [[False, grasped, False]]


@pytest.mark.parametrize("fast", [True, False])
def test_acquired_means_carried_for_some_steps(*, fast: bool) -> None:
    raised = STILL.clone()
    raised[0, 1, 2] = 0.02
    events = _events()
    for step in range(ACQUIRED_STEPS):
        assert events.handle_order.sum() == 0, f"acquired after {step} steps"
        events.touch(_forces(5, -5), CLOSING)
        events.carry(raised, skip_resting=fast)
    assert events.handle_order.tolist() == [[0, 1, 0]]


def test_an_interrupted_grasp_starts_counting_again() -> None:
    raised = STILL + 0.02
    events = _events()
    for step in range(3 * ACQUIRED_STEPS):
        if step % (ACQUIRED_STEPS - 1):
            events.touch(_forces(5, -5), CLOSING)
        else:
            events.release()
        events.carry(raised, skip_resting=True)
    assert events.handle_order.sum() == 0


@pytest.mark.parametrize("fast", [True, False])
def test_pushed_away_is_displaced_carried_away_is_not(*, fast: bool) -> None:
    events = _events()
    pushed = STILL.clone()
    pushed[0, 0, 0] = 0.05
    events.carry(pushed, skip_resting=fast)
    assert events.displaced.tolist() == [[True, False, False]]
    events.handle(torch.tensor([[False, False, True]]))
    events.carry(STILL + 0.05, skip_resting=fast)
    assert events.displaced.tolist() == [[True, True, False]]


def test_order_counts_up_and_never_changes() -> None:
    events = _events()
    for k, new in ((2, True), (0, True), (2, False), (1, True)):
        now = torch.zeros(1, 3, dtype=torch.bool)
        now[0, k] = True
        assert events.handle(now).any() == new
    assert events.handle_order.tolist() == [[2, 3, 1]]


def test_environments_of_a_batch_are_independent() -> None:
    """Batched over b, the latches equal those of b single environments."""
    generator = torch.Generator().manual_seed(0)
    batch, single = Events.create(4, torch.device("cpu")), [_events() for _ in range(4)]
    for _ in range(20):
        forces_n = torch.randn(4, 2, 3, 3, generator=generator) * 2
        positions = torch.randn(4, 3, 3, generator=generator) * 0.02
        batch.touch(forces_n, CLOSING.expand(4, 3))
        batch.carry(positions, skip_resting=False)
        for i, events in enumerate(single):
            events.touch(forces_n[i : i + 1], CLOSING)
            events.carry(positions[i : i + 1], skip_resting=False)
    for name, latch in batch.state().items():
        alone = torch.cat([events.state()[name] for events in single])
        assert torch.equal(latch, alone), name


def test_restart_forgets_some_environments_only() -> None:
    events = Events.create(2, torch.device("cpu"))
    events.handle(torch.ones(2, 3, dtype=torch.bool))
    kept = events.state()
    events.restart(torch.tensor([1]), torch.ones(1, 3, 3))
    assert events.handle_order.tolist() == [[1, 1, 1], [0, 0, 0]]
    assert events.start[1].eq(1).all()
    events.set_state(kept, torch.arange(2))
    assert events.handle_order.tolist() == [[1, 1, 1], [1, 1, 1]]
