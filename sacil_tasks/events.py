"""What happened to the candidates so far: latches updated after every control step.

All tensors are batched over parallel environments (b) and the three candidates; order tensors
hold 0 for "not yet" and 1, 2, 3 in the order in which things happened.
"""

from dataclasses import dataclass, fields

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from sacil_tasks.sizes import CANDIDATES

TOUCH_N = 0.5
"""Least finger force that counts, in newtons."""

_GRASP_COSINE = 0.0872
"""cos 85 degrees: a grasping finger pushes along the closing direction within this angle."""

RAISED_M, CARRIED_M, ACQUIRED_STEPS = 0.010, 0.020, 5
DISPLACED_M = 0.030


@dataclass
class Events:
    """Latches of one batch of episodes."""

    start: Float[Tensor, "b 3 3"]
    """Candidate positions at reset, in the world frame."""

    touch_order: Int[Tensor, "b 3"]
    """Order of the first finger contacts."""

    handle_order: Int[Tensor, "b 3"]
    """Order in which candidates were acquired (grasped and carried) or pressed."""

    displaced: Bool[Tensor, "b 3"]
    """Moved more than 30 mm before being acquired."""

    grasped: Bool[Tensor, "b 3"]
    """Held between both fingers after the last control step."""

    held_steps: Int[Tensor, "b 3"]
    """Consecutive control steps it has been grasped and away from its start."""

    @classmethod
    def create(cls, count: int, device: torch.device) -> "Events":
        """Nothing has happened in `count` environments."""
        shape = (count, CANDIDATES)
        return cls(
            start=torch.zeros((*shape, 3), device=device),
            touch_order=torch.zeros(shape, dtype=torch.int32, device=device),
            handle_order=torch.zeros(shape, dtype=torch.int32, device=device),
            displaced=torch.zeros(shape, dtype=torch.bool, device=device),
            grasped=torch.zeros(shape, dtype=torch.bool, device=device),
            held_steps=torch.zeros(shape, dtype=torch.int32, device=device),
        )

    def restart(self, env_idx: Tensor, start: Float[Tensor, "n 3 3"]) -> None:
        """Forget the last episode of some environments."""
        for field in fields(self):
            getattr(self, field.name)[env_idx] = 0
        self.start[env_idx] = start

    def state(self) -> dict[str, Tensor]:
        """Copies for the state dictionary, each "b n"."""
        return {f.name: getattr(self, f.name).flatten(1).clone() for f in fields(self)}

    def set_state(self, state: dict[str, Tensor], env_idx: Tensor) -> None:
        """Restore what `state` gave for some environments."""
        for field in fields(self):
            latch = getattr(self, field.name)
            saved = torch.as_tensor(state[field.name], device=latch.device, dtype=latch.dtype)
            latch[env_idx] = saved.view(-1, *latch.shape[1:])

    def touch(self, forces_n: Float[Tensor, "b 2 3 3"], closing: Float[Tensor, "b 3"]) -> None:
        """Take in the forces of both fingers on each candidate.

        `closing` is the direction, in the world, from the right finger to the left one.
        """
        strength = forces_n.norm(dim=-1)
        pushes = strength > TOUCH_N
        append_order(self.touch_order, pushes.any(dim=1))
        along = (forces_n * closing[:, None, None]).sum(-1)
        along[:, 1] *= -1
        squeezes = pushes & (along >= _GRASP_COSINE * strength)
        self.grasped = squeezes.all(dim=1)
        self.held_steps *= self.grasped

    def release(self) -> None:
        """Take in that no finger touches any candidate."""
        self.grasped.zero_()
        self.held_steps.zero_()

    def carry(self, positions: Float[Tensor, "b 3 3"], *, skip_resting: bool) -> None:
        """Take in where candidates are: those held away from their start become acquired.

        `skip_resting` asks first whether there is anything to latch: quick on the CPU only.
        """
        moved = positions - self.start
        if skip_resting and not self.grasped.any() and moved.abs().max() < RAISED_M:
            return
        carried = (moved[..., 2] > RAISED_M) | (moved[..., :2].norm(dim=-1) > CARRIED_M)
        self.held_steps = (self.held_steps + 1) * (self.grasped & carried)
        self.handle(self.held_steps >= ACQUIRED_STEPS)
        self.displaced |= (moved.norm(dim=-1) > DISPLACED_M) & (self.handle_order == 0)

    def handle(self, now: Bool[Tensor, "b 3"]) -> Bool[Tensor, "b 3"]:
        """Latch candidates handled now; returns those that are new."""
        return append_order(self.handle_order, now)


def append_order(order: Int[Tensor, "b 3"], now: Bool[Tensor, "b 3"]) -> Bool[Tensor, "b 3"]:
    """Number, in `order`, those that are `now` for the first time; returns which they are."""
    new = now & (order == 0)
    order += new * ((order > 0).sum(-1, keepdim=True, dtype=order.dtype) + 1)
    return new
