"""A Panda at a table with three look-alikes of different size: what all tasks share.

A task adds the candidates' shape, where they rest, what counts as handled, the success predicate
and the expert's keyframes. World frame: table top at z = 0, robot base at x = -0.615.
Scenes are our own, in SAPIEN (D-simulator).
"""

import gc
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
import sapien
import torch
from jaxtyping import Bool, Float, Float32, Float64, Int, Int64
from mani_skill.agents.robots import Panda
from mani_skill.envs.sapien_env import BaseEnv
from mani_skill.sensors.camera import CameraConfig
from mani_skill.utils import sapien_utils
from mani_skill.utils.structs import Actor, Articulation, Link, Pose
from mani_skill.utils.structs.types import DefaultMaterialsConfig, SceneConfig, SimConfig
from torch import Tensor

from sacil_tasks import cameras, instructions, props, scenes, sizes
from sacil_tasks.errors import UsageError, find_name
from sacil_tasks.events import Events
from sacil_tasks.instructions import Slots
from sacil_tasks.interface import Keyframe
from sacil_tasks.outcomes import Outcome
from sacil_tasks.sensing import CandidateSensor
from sacil_tasks.spec import TaskSpec

HOME_QPOS = (0.0, 0.0, 0.0, -1.5, 0.0, 1.5, np.pi / 4, 0.04, 0.04)
"""Arm and fingers at the start: the gripper looks straight down, high above the table."""

BASE_IN_WORLD_M = (-0.615, 0.0, 0.0)


class SizedTableEnv(BaseEnv):
    """Base of all sized tasks.

    `reset(seed=s, options={"slots": {...}, "template": k, "split": "canon"})` plays scene `s` with
    other words or sizes; what is not given is drawn from the seed. With one environment the scene
    is rebuilt at each reset; with more, sizes and colours stay those of the last rebuild
    (`options={"reconfigure": True}`), while positions and words follow the seeds.
    """

    SUPPORTED_ROBOTS: ClassVar[list[str]] = ["panda"]
    SUPPORTED_REWARD_MODES: ClassVar[tuple[str, ...]] = ("sparse", "none")
    agent: Panda

    task: ClassVar[TaskSpec]
    """Words, sizes and layout of the task (gymnasium owns the name `spec`)."""

    candidates: list[Actor] | list[Articulation]
    """The look-alikes `candidate_0..2`; the index says nothing of the size."""

    def __init__(
        self,
        *args: Any,
        robot_uids: str = "panda",
        num_envs: int = 1,
        camera_rig: str = "aimed",
        reconfiguration_freq: int | None = None,
        enhanced_determinism: bool = True,
        **kwargs: Any,
    ) -> None:
        """Build the first scene; what is not named here goes to ManiSkill.

        Raises:
            UsageError: the camera rig is unknown.
        """
        self._rig = cameras.RIGS[find_name(camera_rig, cameras.RIGS, "camera rig")]
        self._split = "canon"
        if reconfiguration_freq is None:
            reconfiguration_freq = 1 if num_envs == 1 else 0
        _spare_imports_from_collection()
        super().__init__(
            *args,
            robot_uids=robot_uids,
            num_envs=num_envs,
            reconfiguration_freq=reconfiguration_freq,
            enhanced_determinism=enhanced_determinism,
            **kwargs,
        )

    # What a task defines -------------------------------------------------------------------------

    def _build_candidate(self, index: int, name: str, size_m: float, rgb: props.Rgb) -> Any:
        """Build one candidate in the parallel scene `index`."""
        raise NotImplementedError

    def _rest_height_m(self, sizes_m: Float[Tensor, "b 3"]) -> Float[Tensor, "b 3"]:
        """Height of each candidate's origin when it stands on the table."""
        raise NotImplementedError

    def _load_extras(self) -> None:
        """Build what the scene holds besides the candidates."""

    def _place_extras(self, env_idx: Tensor, layouts: list[scenes.Layout]) -> None:
        """Put the extras where the layouts say."""

    def _update_events(self) -> None:
        """Update the latches after a control step: being grasped and carried is handling."""
        self._touch_and_carry()

    def _lenient_success(self, targets: Int[Tensor, "b n"]) -> Bool[Tensor, "b"]:
        """The task's predicate, given the indices of the named candidates."""
        raise NotImplementedError

    def _expert_keyframes(self, choice: tuple[int, ...]) -> list[Keyframe]:
        """All keyframes of the expert in environment 0, handling `choice` in order."""
        raise NotImplementedError

    # What others ask -----------------------------------------------------------------------------

    def get_language_instruction(self) -> list[str]:
        """One sentence per environment."""
        return [
            instructions.render(self.task, self.slots(i), int(self._template[i]))
            for i in range(self.num_envs)
        ]

    def slots(self, i: int = 0) -> Slots:
        """Meaning of the instruction of environment `i`."""
        words = [sizes.LABELS[label] for label in self._asked[i].tolist()]
        return dict(zip(self.task.slots, words, strict=True))

    def target_order(self, i: int = 0) -> tuple[int, ...]:
        """Indices of the named candidates of environment `i`, in the order named."""
        return tuple(self._targets[i].tolist())

    @property
    def candidate_labels(self) -> tuple[str, ...]:
        """Size word of each candidate of environment 0."""
        return tuple(sizes.LABELS[label] for label in self._labels[0].tolist())

    @property
    def sizes_m(self) -> Float32[np.ndarray, "3"]:
        """Size of each candidate of environment 0, in metres."""
        return self._sizes_m[0].cpu().numpy()

    @property
    def base_in_world_m(self) -> Float32[np.ndarray, "3"]:
        """Where the robot stands; base and world axes are parallel."""
        return np.asarray(BASE_IN_WORLD_M, dtype=np.float32)

    def candidate_in_base(self) -> Float32[np.ndarray, "3 3"]:
        """Positions of the candidates of environment 0 now, in the base frame (m)."""
        return self._sensor.positions()[0].cpu().numpy() - self.base_in_world_m

    def tcp_in_base(self) -> Float[Tensor, "b 7"]:
        """Gripper pose: position (m) and quaternion wxyz in the base frame."""
        pose = self.agent.tcp_pose.raw_pose.clone()
        pose[:, :3] -= torch.as_tensor(self.base_in_world_m, device=self.device)
        return pose

    def expert_keyframe(self, index: int, choice: tuple[int, ...]) -> Keyframe:
        """Keyframe `index` of the expert in environment 0, handling candidates `choice` in order.

        A function of the scene as it was reset, so that all can be asked for at once.
        """
        return self._expert_keyframes(choice)[index]

    def expert_target(self, index: int) -> int:
        """Position in `choice` of the candidate that keyframe `index` serves."""
        return index * len(self.task.slots) // self.task.keyframes

    def outcome(self, i: int = 0) -> Outcome:
        """What was asked for and done so far in environment `i`."""
        result = self.evaluate()
        names = [sizes.LABELS[label] for label in self._labels[i].tolist()]
        handled = _in_order(self.events.handle_order[i])
        return Outcome(
            success=bool(result["success_strict"][i]),
            success_lenient=bool(result["success_lenient"][i]),
            asked=tuple(self.slots(i).values()),
            handled=tuple(names[k] for k in handled),
            handled_indices=handled,
            touched=tuple(names[k] for k in _in_order(self.events.touch_order[i])),
            displaced=tuple(names[k] for k in self.events.displaced[i].nonzero()[:, 0].tolist()),
        )

    # ManiSkill's life cycle ----------------------------------------------------------------------

    @property
    def _default_sim_config(self) -> SimConfig:
        return SimConfig(
            sim_freq=100,
            control_freq=20,
            scene_config=SceneConfig(solver_position_iterations=20, contact_offset=0.01),
            default_materials_config=DefaultMaterialsConfig(0.5, 0.5, 0.0),
        )

    @property
    def _default_sensor_configs(self) -> list[CameraConfig]:
        return cameras.sensor_configs(self._rig, self.agent.robot.links_map["panda_hand"])

    @property
    def _default_human_render_camera_configs(self) -> CameraConfig:
        pose = sapien_utils.look_at((0.55, 0.55, 0.55), (-0.1, 0.0, 0.1))
        return CameraConfig("render_camera", pose, 512, 512, 0.9, 0.01, 100, shader_pack="default")

    def reset(
        self, seed: int | list[int] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Start an episode (see the class).

        Raises:
            UsageError: a seed or option does not belong to this task.
        """
        seeds = [] if seed is None else np.atleast_1d(np.asarray(seed)).tolist()
        for one in seeds:
            scenes.partition_of(one)
        self._check_options(options or {})
        gym.Env.reset(self, seed=seeds[0] if seeds else None)  # sets np_random
        return super().reset(seed, options)

    def _check_options(self, options: dict[str, Any]) -> None:
        if "slots" in options:
            instructions.check_slots(self.task, options["slots"])
        if "template" in options:
            instructions.check_template(self.task, options["template"])
        if "split" in options:
            split = find_name(options["split"], self.task.splits, f"split of {self.task.name}")
            if split != self._split and not self._will_rebuild(options):
                raise UsageError(
                    f"this environment was built for the split {self._split}, but {split} came; "
                    'add "reconfigure": True to the options.'
                )

    def _will_rebuild(self, options: dict[str, Any]) -> bool:
        return self.reconfiguration_freq == 1 or options.get("reconfigure", False)

    def _load_agent(self, options: dict[str, Any]) -> None:
        super()._load_agent(options, sapien.Pose(BASE_IN_WORLD_M))

    def _load_scene(self, options: dict[str, Any]) -> None:
        self._split = options.get("split", "canon")
        props.build_table(self.scene)
        geometries = [scenes.draw_geometry(int(seed)) for seed in self._episode_seed]
        sizes_m = np.stack(
            [sizes.sizes_m(self.task.family, self._split, g.labels, g.jitter) for g in geometries]
        )
        self.candidates = [
            self._build_batch(k, sizes_m[:, k], [g.rgb[k] for g in geometries])
            for k in range(sizes.CANDIDATES)
        ]
        self._load_extras()
        self._create_state(np.stack([g.labels for g in geometries]), sizes_m)

    def _build_batch(
        self, k: int, sizes_m: Float64[np.ndarray, "b"], rgbs: list[Float64[np.ndarray, "3"]]
    ) -> Any:
        """Build candidate `k` of every parallel scene."""

        def build(i: int, name: str) -> Any:
            return self._build_candidate(i, name, float(sizes_m[i]), rgbs[i].tolist())

        return props.build_each(self.scene, f"candidate_{k}", build)

    def _create_state(
        self, labels: Int64[np.ndarray, "b 3"], sizes_m: Float64[np.ndarray, "b 3"]
    ) -> None:
        """Allocate what belongs to the task and is not physics."""
        self._labels = torch.as_tensor(labels, device=self.device)
        self._sizes_m = torch.as_tensor(sizes_m, device=self.device, dtype=torch.float32)
        self._yaw_rad = torch.zeros_like(self._sizes_m)
        self._asked = torch.zeros(
            (self.num_envs, len(self.task.slots)), dtype=torch.int64, device=self.device
        )
        self._template = torch.zeros((self.num_envs, 1), dtype=torch.int64, device=self.device)
        self.events = Events.create(self.num_envs, self.device)
        self._sensor = CandidateSensor(self.scene, self.agent, self.candidates, self._touchable())

    def _load_lighting(self, options: dict[str, Any]) -> None:
        """Fixed, shadowless light: part of the benchmark's definition."""
        self.scene.set_ambient_light([0.35, 0.35, 0.35])
        self.scene.add_directional_light([-0.5, -0.35, -1.0], [0.9, 0.9, 0.9])
        self.scene.add_directional_light([0.7, 0.6, -1.0], [0.5, 0.5, 0.5])

    def _initialize_episode(self, env_idx: Tensor, options: dict[str, Any]) -> None:
        self.agent.reset(np.tile(HOME_QPOS, (len(env_idx), 1)))
        self.agent.robot.set_pose(sapien.Pose(BASE_IN_WORLD_M))
        seeds = [int(self._episode_seed[i]) for i in env_idx.tolist()]
        layouts = [scenes.draw_layout(self.task, seed) for seed in seeds]
        self.events.restart(env_idx, self._place_candidates(env_idx, layouts))
        self._place_extras(env_idx, layouts)
        self._say(env_idx, seeds, options)

    def _place_candidates(
        self, env_idx: Tensor, layouts: list[scenes.Layout]
    ) -> Float[Tensor, "n 3 3"]:
        xy_m = self._to_tensor([layout.xy_m for layout in layouts])
        height_m = self._rest_height_m(self._sizes_m)[env_idx]
        position = torch.cat([xy_m, height_m[..., None]], dim=-1)
        self._yaw_rad[env_idx] = self._to_tensor([layout.yaw_rad for layout in layouts])
        half = self._yaw_rad[env_idx] / 2
        nothing = torch.zeros_like(half)
        quaternion = torch.stack([half.cos(), nothing, nothing, half.sin()], dim=-1)
        for k, candidate in enumerate(self.candidates):
            candidate.set_pose(Pose.create_from_pq(position[:, k], quaternion[:, k]))
        return position

    def _say(self, env_idx: Tensor, seeds: list[int], options: dict[str, Any]) -> None:
        """Choose the words: from the instruction stream, unless given."""
        for i, seed in zip(env_idx.tolist(), seeds, strict=True):
            drawn, template = instructions.draw_words(self.task, scenes.stream(seed, "instruction"))
            words = options.get("slots", drawn)
            asked = [sizes.LABELS.index(words[name]) for name in self.task.slots]
            self._asked[i] = torch.tensor(asked, device=self.device)
            self._template[i] = options.get("template", template)
        self._find_targets()

    def _after_control_step(self) -> None:
        self._update_events()

    def _touch_and_carry(self) -> None:
        forces_n = self._sensor.forces_n()
        if forces_n is None:
            self.events.release()
        else:
            self.events.touch(forces_n, self._sensor.closing())
        self.events.carry(self._sensor.positions(), skip_resting=not self._sensor.batched)

    def evaluate(self) -> dict[str, Tensor]:
        """Success now, strict and lenient, and the latches. Nothing here tells the target."""
        lenient = self._lenient_success(self._targets)
        spoilt = (self.events.handle_order > 0) | self.events.displaced
        strict = lenient & ~(spoilt & self._unnamed).any(-1)
        return {
            "success": strict,
            "success_strict": strict.clone(),
            "success_lenient": lenient,
            "touch_order": self.events.touch_order.clone(),
            "handle_order": self.events.handle_order.clone(),
            "displaced": self.events.displaced.clone(),
        }

    def compute_sparse_reward(self, obs: Any, action: Tensor, info: dict) -> Float[Tensor, "b"]:
        """1 on strict success, else 0."""
        return info["success"].float()

    def _get_obs_extra(self, info: dict) -> dict[str, Tensor]:
        extra = {"tcp_pose": self.agent.tcp_pose.raw_pose}
        if self.obs_mode_struct.use_state:
            extra["candidate_pose"] = torch.cat(
                [candidate.pose.raw_pose for candidate in self.candidates], dim=-1
            )
            extra["candidate_size"] = self._sizes_m
            extra["asked"] = self._asked
        return extra

    def get_state_dict(self) -> dict[str, Any]:
        """Physics, plus the task's own state as ints and floats, each "b n"."""
        task = {"asked": self._asked.clone(), "template": self._template.clone()}
        return super().get_state_dict() | {"task": task | self.events.state()}

    def set_state_dict(self, state: dict[str, Any], env_idx: Tensor | None = None) -> None:
        """Restore what `get_state_dict` gave; flat states carry no task state and leave it."""
        super().set_state_dict(state, env_idx)
        if "task" in state:
            if env_idx is None:
                env_idx = torch.arange(self.num_envs, device=self.device)
            for name, own in (("asked", self._asked), ("template", self._template)):
                saved = torch.as_tensor(state["task"][name], dtype=own.dtype, device=self.device)
                own[env_idx] = saved.view(-1, own.shape[1])
            self.events.set_state(state["task"], env_idx)
            self._find_targets()

    # Helpers -------------------------------------------------------------------------------------

    @contextmanager
    def _writing_state(self) -> Iterator[None]:
        """Between two control steps: on the GPU, poses and targets are written in bulk."""
        if self.gpu_sim_enabled:
            self.scene._gpu_fetch_all()  # noqa: SLF001 -- as ManiSkill's own tasks do
        yield
        if self.gpu_sim_enabled:
            self.scene._gpu_apply_all()  # noqa: SLF001
            self.scene._gpu_fetch_all()  # noqa: SLF001

    def _to_tensor(self, rows: list[np.ndarray]) -> Float[Tensor, "n ..."]:
        """Stack rows drawn by numpy."""
        return torch.as_tensor(np.stack(rows), dtype=torch.float32, device=self.device)

    def _find_targets(self) -> None:
        """Resolve the words into candidates; called when words change."""
        named = self._labels[:, None] == self._asked[..., None]
        self._targets = named.int().argmax(-1)
        self._unnamed = ~named.any(1)

    def _touchable(self) -> list[Actor | Link]:
        """The body of each candidate that fingers act on."""
        return list(self.candidates)

    def _pick(self, values: Tensor, targets: Int[Tensor, "b n"]) -> Tensor:
        """Rows of `values` ("b 3 ...") of the first target."""
        return values[torch.arange(len(values), device=self.device), targets[:, 0]]

    def _start_pose(self, k: int) -> tuple[Float64[np.ndarray, "3"], float]:
        """Position (world, m) and heading (rad) of candidate `k` of environment 0 at reset."""
        position = self.events.start[0, k].cpu().numpy().astype(np.float64)
        return position, float(self._yaw_rad[0, k])

    def _downwards(
        self,
        xyz_in_world_m: np.ndarray,
        yaw_rad: float,
        *,
        gripper_open: bool,
        ignore_collisions: bool,
    ) -> Keyframe:
        """Keyframe with the gripper pointing down and its closing axis turned by `yaw_rad`."""
        return Keyframe(
            position_m=np.asarray(xyz_in_world_m, dtype=np.float64) - BASE_IN_WORLD_M,
            quaternion_wxyz=np.array([0.0, np.cos(yaw_rad / 2), np.sin(yaw_rad / 2), 0.0]),
            gripper_open=gripper_open,
            ignore_collisions=ignore_collisions,
        )


def _in_order(order: Int[Tensor, "3"]) -> tuple[int, ...]:
    happened = [(rank, k) for k, rank in enumerate(order.tolist()) if rank > 0]
    return tuple(k for _, k in sorted(happened))


@cache
def _spare_imports_from_collection() -> None:
    """Keep libraries out of garbage collection, once per process.

    ManiSkill collects garbage at each rebuild, and walking through the modules of torch would take
    most of a reset.
    """
    gc.collect()
    gc.freeze()
