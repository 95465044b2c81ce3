"""Open the named drawer and put the item of the named size into it."""

from typing import Any, ClassVar

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64, Int, Int64
from mani_skill.utils.structs import Actor, Articulation, Link
from torch import Tensor

from sacil_tasks import fixtures, props
from sacil_tasks.errors import UsageError
from sacil_tasks.events import append_order
from sacil_tasks.interface import Keyframe
from sacil_tasks.placing import PlacingEnv, seen_from
from sacil_tasks.poses import downwards, grasp_height_m, sideways
from sacil_tasks.scenes import Layout
from sacil_tasks.spec import Fixture, TaskSpec

SPEC = TaskSpec(
    name="put_item_in_drawer",
    suites=("single",),
    family="block",
    slots=("size",),
    receptacles={"drawer": ("bottom", "middle", "top")},
    templates=(
        "put the {size} item in the {drawer} drawer",
        "put the {size} block away in the {drawer} drawer",
        "open the {drawer} drawer and place the {size} item inside",
        "leave the {size} item in the {drawer} drawer",
    ),
    held_out_templates=(
        "store the {size} cube in the {drawer} drawer",
        "the {drawer} drawer is for the {size} item",
    ),
    keyframes=11,
    spacing_m=0.11,
    yaw_limit_deg=45.0,
    fixture=Fixture(
        xy_m=(-0.10, -0.05),
        shift_m=0.02,
        yaw_deg=((100.0, 116.0),),
        spots_m=((-0.09, -0.085), (-0.09, 0.085), (-0.21, 0.0)),
        spot_shift_m=0.012,
    ),
    clutter_region_m=((0.11, 0.14), (0.02, 0.14)),
)

OPENED_M = 0.05
"""A drawer that is farther out counts as opened."""

OPENING_KEYFRAMES = 5
"""Keyframes of the expert before it turns to an item; `drawer_open` spares the first four."""

PULL_M, OPENING_M = 0.170, 0.168
"""How far the expert pulls, and how far the drawer then is open."""

DROP_M = 0.062
"""Items are let go this far behind the outer face of the drawer's front: nearer to the cabinet
the palm would meet the handle of the drawer above."""

PALM_CLEAR_M = 0.025
"""How far below the top of a neighbour the tool centre may go: the palm is 37 mm above it."""

CARRY_M = 0.48
"""Height of the gripper while it carries an item over the cabinet."""


class PutItemInDrawerEnv(PlacingEnv):
    """
    **Task Description:**
    Three cubes that differ in size only lie on a cabinet with three drawers. Open the drawer that
    is named and put the cube whose size is named into it. D-cabinet.

    With `reset(options={"drawer_open": True})` the named drawer is open from the start; the
    expert's first four keyframes are then of no use.

    **Randomizations:**
    - the middle of the cabinet's front is within 0.02 m of (-0.10, -0.05) along each axis; the
      front faces left and slightly towards the robot, 100 to 116 degrees from x
    - cubes lie within 0.012 m of three spots of the cabinet's top along each axis, in any order
    - cube headings are uniform in +-45 degrees
    - sizes are three neighbouring rungs of a ladder, jittered; which cube has which is uniform
    - one colour for all cubes, out of 20; in half of the training scenes each has its own

    **Success Conditions:**
    - the named cube was picked up, is at rest inside the named drawer and is let go
    - no other cube is in a drawer; drawers that were not named may be open
    - strictly: no other cube was acquired or displaced
    """

    RESET_OPTIONS: ClassVar[tuple[str, ...]] = (*PlacingEnv.RESET_OPTIONS, "drawer_open")
    task: ClassVar[TaskSpec] = SPEC
    fixture: Articulation

    def _build_candidate(self, index: int, name: str, size_m: float, rgb: props.Rgb) -> Actor:
        return props.build_block(self.scene, index, name, size_m, rgb)

    def _rest_height_m(self, sizes_m: Float[Tensor, "b 3"]) -> Float[Tensor, "b 3"]:
        return fixtures.CABINET_TOP_M + sizes_m / 2

    def _load_extras(self) -> None:
        self.fixture = fixtures.build_cabinet(self.scene, "cabinet")
        self.drawers = [self.fixture.links_map[name] for name in fixtures.HANDLE_HEIGHTS_M]

    def _check_options(self, options: dict[str, Any]) -> None:
        super()._check_options(options)
        if not isinstance(opened := options.get("drawer_open", False), bool):
            raise UsageError(f"drawer_open is True or False, but {opened!r} came.")

    def _create_state(
        self, labels: Int64[np.ndarray, "b 3"], sizes_m: Float64[np.ndarray, "b 3"]
    ) -> None:
        super()._create_state(labels, sizes_m)
        self._open_order = torch.zeros_like(self._labels, dtype=torch.int32)

    def _task_state(self) -> dict[str, Tensor]:
        return super()._task_state() | {"open_order": self._open_order}

    def _place_extras(self, env_idx: Tensor, layouts: list[Layout]) -> None:
        super()._place_extras(env_idx, layouts)
        shut = torch.zeros((len(env_idx), len(self.drawers)), device=self.device)
        self.fixture.set_qpos(shut)
        self.fixture.set_qvel(shut)
        self._open_order[env_idx] = 0

    def _initialize_episode(self, env_idx: Tensor, options: dict[str, Any]) -> None:
        super()._initialize_episode(env_idx, options)
        if options.get("drawer_open", False):
            named = torch.nn.functional.one_hot(self._drawer[env_idx], len(self.drawers))
            self.fixture.set_qpos(OPENING_M * named)

    def _get_obs_extra(self, info: dict) -> dict[str, Tensor]:
        extra = super()._get_obs_extra(info)
        if self.obs_mode_struct.use_state:
            extra["drawers_out_m"] = self.fixture.qpos
        return extra

    @property
    def _drawer(self) -> Int[Tensor, "b"]:
        """Index of the named drawer."""
        return self._asked[:, -1]

    def _update_events(self) -> None:
        super()._update_events()
        append_order(self._open_order, self.fixture.qpos > OPENED_M)

    def _handles(self) -> list[Link]:
        """The named drawer, until an item has been touched."""
        return [] if self.events.touch_order.any() else [self.drawers[int(self._drawer[0])]]

    def _receptacles(self) -> Int[Tensor, "b 3"]:
        """Which drawer each item is in."""
        positions = self._sensor.positions()
        seen_m = torch.stack([seen_from(drawer, positions) for drawer in self.drawers], dim=2)
        low, high = seen_m.new_tensor(fixtures.DRAWER_INSIDE_M).T
        inside = ((seen_m > low) & (seen_m < high)).all(-1)
        return torch.where(inside.any(-1), inside.int().argmax(-1), -1)

    def _belongs(self, places: Int[Tensor, "b 3"]) -> Bool[Tensor, "b 3"]:
        return places == self._drawer[:, None]

    def _wrong_receptacle(self, i: int) -> bool:
        places, named = self._receptacles()[i], int(self._drawer[i])
        opened = set(self._open_order[i].nonzero()[:, 0].tolist())
        return bool((opened | set(places.tolist())) - {named, -1})

    def expert_target(self, index: int) -> int | None:
        """No item until the drawer is open: there the drawer's name decides, not a size."""
        items = len(self.task.slots)
        per_item = (self.task.keyframes - OPENING_KEYFRAMES) // items
        return None if index < OPENING_KEYFRAMES else (index - OPENING_KEYFRAMES) // per_item

    def _expert_keyframes(self, choice: tuple[int, ...]) -> list[Keyframe]:
        keyframes = self._open_drawer()
        beside_m = (0.0,) if len(choice) == 1 else (-0.055, 0.055)
        inside_m = 0.0
        for k, place_m in zip(choice, beside_m, strict=True):
            keyframes += self._put_in(k, place_m, inside_m)
            inside_m = float(self.sizes_m[k])
        return keyframes

    def _open_drawer(self) -> list[Keyframe]:
        """Grasp the handle from the front, pull, let go and rise above the open drawer."""
        inwards = self._fixture_yaw() + np.pi
        height_m = list(fixtures.HANDLE_HEIGHTS_M.values())[int(self._drawer[0])]
        before, at, pulled, off = (
            self._on_fixture(np.array([fixtures.HANDLE_M + out_m, 0.0, height_m]))
            for out_m in (0.100, 0.0, PULL_M, PULL_M + 0.090)
        )
        over = self._on_fixture(np.array([OPENING_M - DROP_M, 0.0, CARRY_M]))
        return [
            sideways(before, inwards, gripper_open=True, ignore_collisions=False),
            sideways(at, inwards, gripper_open=False, ignore_collisions=True),
            sideways(pulled, inwards, gripper_open=True, ignore_collisions=True),
            sideways(off, inwards, gripper_open=True, ignore_collisions=True),
            downwards(over, self._row_yaw(), gripper_open=True, ignore_collisions=False),
        ]

    def _row_yaw(self) -> float:
        """Gripper yaw that closes along the front: of the two, the one in (-90, 90] degrees."""
        return np.pi / 2 - (np.pi / 2 - self._fixture_yaw()) % np.pi

    def _put_in(self, k: int, beside_m: float, inside_m: float) -> list[Keyframe]:
        """Take item `k` off the cabinet and let it down, `beside_m` off the drawer's middle.

        A small item falls the last bit where the palm would meet one of height `inside_m` that
        is in the drawer already.
        """
        (x, y, _), edge_m = self._start_pose(k)[0], float(self.sizes_m[k])
        grasp_m = grasp_height_m(edge_m)
        yaw, row_yaw = self._roomy_yaw(k), self._row_yaw()
        high, low = np.array([x, y, CARRY_M]), np.array([x, y, fixtures.CABINET_TOP_M + grasp_m])
        over = self._on_fixture(np.array([OPENING_M - DROP_M, beside_m, CARRY_M]))
        floor_m = list(fixtures.HANDLE_HEIGHTS_M.values())[int(self._drawer[0])]
        floor_m += fixtures.DRAWER_FLOOR_M
        down = np.array([*over[:2], floor_m + max(grasp_m + 0.007, inside_m - PALM_CLEAR_M)])
        return [
            downwards(high, yaw, gripper_open=True, ignore_collisions=False),
            downwards(low, yaw, gripper_open=False, ignore_collisions=True),
            downwards(high, yaw, gripper_open=False, ignore_collisions=True),
            downwards(over, row_yaw, gripper_open=False, ignore_collisions=False),
            downwards(down, row_yaw, gripper_open=True, ignore_collisions=False),
            downwards(over, row_yaw, gripper_open=True, ignore_collisions=False),
        ]
