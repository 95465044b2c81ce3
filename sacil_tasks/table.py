"""A Panda at a table with three look-alikes of different size: what all tasks share.

A task adds the candidates' shape, where they rest, what counts as handled, the success predicate
and the expert's keyframes. World frame: table top at z = 0, robot base at x = -0.615.
Scenes are our own, in SAPIEN (D-simulator).
"""

from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
import sapien
import torch
from jaxtyping import Bool, Float, Float32, Float64, Int, Int64
from mani_skill.agents.robots import Panda
from mani_skill.envs.sapien_env import BaseEnv
from mani_skill.sensors.camera import CameraConfig
from mani_skill.utils.structs import Actor, Articulation, Link, Pose
from mani_skill.utils.structs.types import SimConfig
from torch import Tensor

from sacil_tasks import cameras, instructions, props, scenes, simulation, sizes, wording
from sacil_tasks.contacts import ContactLog
from sacil_tasks.errors import UsageError, find_name
from sacil_tasks.events import Events
from sacil_tasks.instructions import Slots
from sacil_tasks.interface import Keyframe
from sacil_tasks.outcomes import Outcome
from sacil_tasks.poses import BASE_IN_WORLD_M, upright
from sacil_tasks.robot_looks import lighten
from sacil_tasks.sensing import CandidateSensor
from sacil_tasks.spec import TaskSpec
from sacil_tasks.variant import AWAY_M, Variant

HOME_QPOS = (0.0, 0.0, 0.0, -1.5, 0.0, 1.5, np.pi / 4, 0.04, 0.04)
"""Arm and fingers at the start: the gripper looks straight down, high above the table."""


class SizedTableEnv(BaseEnv):
    """Base of all sized tasks.

    `reset(seed=s, options={"slots": {...}, "template": k, "split": "canon"})` plays scene `s` with
    other words or sizes; what is not given is drawn from the seed. With one environment the scene
    is rebuilt at each reset; with more, sizes and colours stay those of the last rebuild
    (`options={"reconfigure": True}`), while positions and words follow the seeds.
    """

    SUPPORTED_ROBOTS: ClassVar[list[str]] = ["panda"]
    SUPPORTED_REWARD_MODES: ClassVar[tuple[str, ...]] = ("sparse", "none")
    RESET_OPTIONS: ClassVar[tuple[str, ...]] = wording.RESET_OPTIONS
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
        reward_mode: str | None = None,
        camera_rig: str = "aimed",
        reconfiguration_freq: int | None = None,
        enhanced_determinism: bool = True,
        **kwargs: Any,
    ) -> None:
        """Build the first scene; what is not named here goes to ManiSkill.

        Raises:
            UsageError: the camera rig or reward mode is unknown, or this machine cannot simulate
                several environments at once.
        """
        simulation.check_parallel(num_envs, kwargs.get("sim_backend", "auto"))
        find_name(reward_mode or "none", self.SUPPORTED_REWARD_MODES, "reward mode")
        self._rig = cameras.RIGS[find_name(camera_rig, cameras.RIGS, "camera rig")]
        self._split = "canon"
        if reconfiguration_freq is None:
            reconfiguration_freq = 1 if num_envs == 1 else 0
        simulation.spare_imports_from_collection()
        super().__init__(
            *args,
            robot_uids=robot_uids,
            num_envs=num_envs,
            reward_mode=reward_mode,
            reconfiguration_freq=reconfiguration_freq,
            enhanced_determinism=enhanced_determinism,
            **kwargs,
        )

    # What a task defines -------------------------------------------------------------------------

    def _build_candidate(self, index: int, name: str, size_m: float, rgb: props.Rgb) -> Any:
        """Build one candidate in the parallel scene `index`."""
        raise NotImplementedError

    def _rest_height_m(self, sizes_m: Float[Tensor, "b 3"]) -> Float[Tensor, "b 3"]:
        """Height of each candidate's origin where it stands at the start."""
        raise NotImplementedError

    def _rest_quaternions(self, yaw_rad: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3 4"]:
        """Orientation of each candidate (wxyz) at the start, given its heading."""
        return upright(yaw_rad)

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

    def _receptacles(self) -> Int[Tensor, "b 3"]:
        """Index of the place that each candidate was put into, or -1."""
        return torch.full_like(self._labels, -1)

    def _wrong_receptacle(self, i: int) -> bool:
        """Whether a place that was not named has been opened or filled in environment `i`."""
        return False

    def _handles(self) -> list[Link]:
        """What else the fingers may touch now, besides the candidates."""
        return []

    def _task_state(self) -> dict[str, Tensor]:
        """What an episode is besides physics and events, each "b n"; restored in place."""
        return {"asked": self._asked, "template": self._template}

    def _expert_keyframes(self, choice: tuple[int, ...]) -> list[Keyframe]:
        """All keyframes of the expert in environment 0, handling `choice` in order."""
        raise NotImplementedError

    # What others ask -----------------------------------------------------------------------------

    def get_language_instruction(self) -> list[str]:
        """One sentence per environment."""
        return [
            self._variant.say(i, self.slots(i), int(self._template[i]), int(seed))
            for i, seed in enumerate(self._episode_seed)
        ]

    def slots(self, i: int = 0) -> Slots:
        """Meaning of the instruction of environment `i`."""
        asked = zip(self.task.blanks.items(), self._asked[i].tolist(), strict=True)
        return {name: words[word] for (name, words), word in asked}

    def ask(self, slots: Slots) -> None:
        """Change what the instruction means, and nothing else.

        Raises:
            UsageError: the slots do not belong to the task.
        """
        instructions.check_slots(self.task, slots, self._split)
        words = [known.index(slots[name]) for name, known in self.task.blanks.items()]
        self._asked[:] = torch.tensor(words, device=self.device)
        self._find_targets()

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

    def clutter_in_base(self) -> Float32[np.ndarray, "n 3"]:
        """Positions of objects that are no candidates in environment 0 now, in the base frame."""
        return self._variant.clutter_in_world() - self.base_in_world_m

    def tcp_in_base(self) -> Float[Tensor, "b 7"]:
        """Gripper pose: position (m) and quaternion wxyz in the base frame."""
        pose = self.agent.tcp_pose.raw_pose.clone()
        pose[:, :3] -= torch.as_tensor(self.base_in_world_m, device=self.device)
        return pose

    def expert_keyframe(self, index: int, choice: tuple[int, ...]) -> Keyframe:
        """Keyframe `index` of the expert in environment 0, handling candidates `choice` in order.

        A function of the scene as it was reset, so that all can be asked for at once.
        """
        if choice not in self._expert_plans:
            self._expert_plans[choice] = self._expert_keyframes(choice)
        return self._expert_plans[choice][index]

    def expert_target(self, index: int) -> int | None:
        """Position in `choice` of the candidate that keyframe `index` serves, if it serves one."""
        return index * len(self.task.slots) // self.task.keyframes

    def outcome(self, i: int = 0) -> Outcome:
        """What was asked for and done so far in environment `i`."""
        result = self.evaluate()
        names = [sizes.LABELS[label] for label in self._labels[i].tolist()]
        handled = _in_order(self.events.handle_order[i])
        return Outcome(
            success=bool(result["success_strict"][i]),
            success_lenient=bool(result["success_lenient"][i]),
            asked=self.task.size_words(self.slots(i)),
            handled=tuple(names[k] for k in handled),
            placed=tuple(names[k] for k in (self._receptacles()[i] >= 0).nonzero()[:, 0].tolist()),
            handled_indices=handled,
            touched=tuple(names[k] for k in _in_order(self.events.touch_order[i])),
            displaced=tuple(names[k] for k in self.events.displaced[i].nonzero()[:, 0].tolist()),
            wrong_receptacle=self._wrong_receptacle(i),
            robot_contact_n=max(self.contacts.forces_n.values(), default=0.0),
        )

    # ManiSkill's life cycle ----------------------------------------------------------------------

    @property
    def _default_sim_config(self) -> SimConfig:
        return simulation.sim_config()

    @property
    def _default_sensor_configs(self) -> list[CameraConfig]:
        return cameras.sensor_configs(self._rig, self.agent.robot.links_map["panda_hand"])

    @property
    def _default_human_render_camera_configs(self) -> CameraConfig:
        return simulation.spectator()

    def reset(
        self, seed: int | list[int] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Start an episode (see the class).

        Raises:
            UsageError: a seed or option does not belong to this task.
        """
        seeds = [] if seed is None else np.atleast_1d(seed).tolist()
        scenes.check_seeds(seeds, self.num_envs)
        self._check_options(options or {})
        gym.Env.reset(self, seed=seeds[0] if seeds else None)  # sets np_random
        # Far from the scene's own streams: the first numbers after the seed tell the sizes.
        self._np_random = np.random.Generator(self.np_random.bit_generator.jumped())
        return super().reset(seed if seeds else None, options)

    def _check_options(self, options: dict[str, Any]) -> None:
        wording.check_names(options, self.RESET_OPTIONS)
        due = self.reconfiguration_freq != 0 and self._reconfig_counter == 0
        rebuild = due or options.get("reconfigure", False)
        split = options.get("split", "canon" if rebuild else self._split)
        wording.check_options(self.task, split, options)
        if split != self._split and not rebuild:
            raise UsageError(
                f"this environment was built for the split {self._split}, but {split} came; "
                'add "reconfigure": True to the options.'
            )

    def _load_agent(self, options: dict[str, Any]) -> None:
        super()._load_agent(options, sapien.Pose(BASE_IN_WORLD_M))
        if self.scene.can_render():
            lighten(self.agent.robot)

    def _load_scene(self, options: dict[str, Any]) -> None:
        self._split = options.get("split", "canon")
        props.build_table(self.scene)
        self._variant = Variant(self.task, self._split, self._episode_seed)
        sizes_m = self._variant.sizes_m
        self.candidates = [
            self._build_batch(k, sizes_m[:, k], self._variant.rgb(k))
            for k in range(sizes.CANDIDATES)
        ]
        self._load_extras()
        self._variant.build(self.scene)
        self._create_state(self._variant.labels, sizes_m)

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
            (self.num_envs, len(self.task.blanks)), dtype=torch.int64, device=self.device
        )
        self._template = torch.zeros((self.num_envs, 1), dtype=torch.int64, device=self.device)
        self.events = Events.create(self.num_envs, self.device)
        self._sensor = CandidateSensor(self.scene, self.agent, self.candidates, self._touchable())
        self.contacts = ContactLog(self.scene, self.agent, self._touchable())

    def _load_lighting(self, options: dict[str, Any]) -> None:
        simulation.add_light(self.scene)

    def _initialize_episode(self, env_idx: Tensor, options: dict[str, Any]) -> None:
        env_idx = torch.as_tensor(env_idx, device=self.device)
        self.agent.reset(np.tile(HOME_QPOS, (len(env_idx), 1)))
        self.agent.robot.set_pose(sapien.Pose(BASE_IN_WORLD_M))
        seeds = [int(self._episode_seed[i]) for i in env_idx.tolist()]
        layouts = [scenes.draw_layout(self.task, seed) for seed in seeds]
        self._say(env_idx, seeds, options)
        self.events.restart(env_idx, self._place_candidates(env_idx, layouts))
        self.contacts.restart()
        self._place_extras(env_idx, layouts)
        self._variant.place(env_idx, layouts, seeds)

    def _place_candidates(
        self, env_idx: Tensor, layouts: list[scenes.Layout]
    ) -> Float[Tensor, "n 3 3"]:
        xy_m = self._to_tensor([layout.xy_m for layout in layouts])
        height_m = self._rest_height_m(self._sizes_m)[env_idx]
        position = torch.cat([xy_m, height_m[..., None]], dim=-1)
        position[~self._present[env_idx]] += torch.tensor(AWAY_M, device=self.device)
        self._yaw_rad[env_idx] = self._to_tensor([layout.yaw_rad for layout in layouts])
        quaternion = self._rest_quaternions(self._yaw_rad[env_idx])
        for k, candidate in enumerate(self.candidates):
            candidate.set_pose(Pose.create_from_pq(position[:, k], quaternion[:, k]))
        return position

    def _say(self, env_idx: Tensor, seeds: list[int], options: dict[str, Any]) -> None:
        """Choose the words: from the instruction stream, unless given."""
        for i, seed in zip(env_idx.tolist(), seeds, strict=True):
            drawn, template = wording.draw_meaning(self.task, self._split, seed)
            words = options.get("slots", drawn)
            asked = [known.index(words[name]) for name, known in self.task.blanks.items()]
            self._asked[i] = torch.tensor(asked, device=self.device)
            self._template[i] = options.get("template", template)
        self._find_targets()

    def _after_control_step(self) -> None:
        if self.scene.gpu_sim_enabled:
            self.scene._gpu_fetch_all()  # noqa: SLF001 -- ManiSkill would, but after this
        self._update_events()

    def _after_simulation_step(self) -> None:
        self.contacts.look(self._handles)

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
            extra["candidate_size"] = self._sizes_m.clone()
            extra["asked"] = self._asked.clone()
            extra["handle_order"] = self.events.handle_order.clone()
        return extra

    def get_sensor_params(self) -> dict[str, dict[str, Tensor]]:
        """ManiSkill's, as copies: it hands out the same objects at every step."""
        shared = super().get_sensor_params()
        return {name: {k: v.clone() for k, v in it.items()} for name, it in shared.items()}

    def get_state_dict(self) -> dict[str, Any]:
        """Physics, plus the task's own state as ints and floats, each "b n"."""
        task = {name: value.clone() for name, value in self._task_state().items()}
        return super().get_state_dict() | {"task": task | self.events.state()}

    def set_state_dict(self, state: dict[str, Any], env_idx: Tensor | None = None) -> None:
        """Restore what `get_state_dict` gave; flat states carry no task state and leave it."""
        super().set_state_dict(state, env_idx)
        if "task" in state:
            if env_idx is None:
                env_idx = torch.arange(self.num_envs, device=self.device)
            for name, own in self._task_state().items():
                saved = torch.as_tensor(state["task"][name], dtype=own.dtype, device=self.device)
                own[env_idx] = saved.view(-1, own.shape[1])
            self.events.set_state(state["task"], env_idx)
            self._find_targets()

    def _to_tensor(self, rows: list[np.ndarray]) -> Float[Tensor, "n ..."]:
        """Stack rows drawn by numpy."""
        return torch.as_tensor(np.stack(rows), dtype=torch.float32, device=self.device)

    def _find_targets(self) -> None:
        """Resolve the words into candidates; called when words change."""
        sizes_asked = self._asked[:, : len(self.task.slots)]
        named = self._labels[:, None] == sizes_asked[..., None]
        self._targets = named.int().argmax(-1)
        self._expert_plans: dict[tuple[int, ...], list[Keyframe]] = {}  # depend on the words
        self._present = self._variant.present(named.any(1))
        self._unnamed = ~named.any(1) & self._present

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


def _in_order(order: Int[Tensor, "3"]) -> tuple[int, ...]:
    happened = [(rank, k) for k, rank in enumerate(order.tolist()) if rank > 0]
    return tuple(k for _, k in sorted(happened))
