"""How ManiSkill is run here: physics, light, the spectator's camera, memory."""

import gc
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache

import torch
from mani_skill.envs.scene import ManiSkillScene
from mani_skill.sensors.camera import CameraConfig
from mani_skill.utils import sapien_utils
from mani_skill.utils.structs.types import DefaultMaterialsConfig, SceneConfig, SimConfig

from sacil_tasks.errors import UsageError


def check_parallel(num_envs: int, sim_backend: str) -> None:
    """Accept a number of environments in one process.

    Raises:
        UsageError: there are several, but no GPU to simulate them on.
    """
    if num_envs > 1 and (sim_backend in {"cpu", "physx_cpu"} or not torch.cuda.is_available()):
        raise UsageError(
            f"num_envs={num_envs} needs physics on an NVIDIA GPU, but sim_backend='{sim_backend}' "
            "means the CPU here; make one environment per process, for example with gymnasium's "
            "AsyncVectorEnv."
        )


def sim_config() -> SimConfig:
    """Rates, solver and friction: part of the benchmark's definition."""
    return SimConfig(
        sim_freq=100,
        control_freq=20,
        scene_config=SceneConfig(solver_position_iterations=20, contact_offset=0.01),
        default_materials_config=DefaultMaterialsConfig(0.5, 0.5, 0.0),
    )


def add_light(scene: ManiSkillScene) -> None:
    """Fixed, shadowless light: part of the benchmark's definition."""
    scene.set_ambient_light([0.35, 0.35, 0.35])
    scene.add_directional_light([-0.5, -0.35, -1.0], [0.9, 0.9, 0.9])
    scene.add_directional_light([0.7, 0.6, -1.0], [0.5, 0.5, 0.5])


def spectator() -> CameraConfig:
    """Camera of `render`, for people."""
    pose = sapien_utils.look_at((0.55, 0.55, 0.55), (-0.1, 0.0, 0.1))
    return CameraConfig("render_camera", pose, 512, 512, 0.9, 0.01, 100, shader_pack="default")


@contextmanager
def writing_state(scene: ManiSkillScene) -> Iterator[None]:
    """Between two control steps: on the GPU, poses and targets are written in bulk."""
    if scene.gpu_sim_enabled:
        scene._gpu_fetch_all()  # noqa: SLF001 -- as ManiSkill's own tasks do
    yield
    if scene.gpu_sim_enabled:
        scene._gpu_apply_all()  # noqa: SLF001
        scene._gpu_fetch_all()  # noqa: SLF001


@cache
def spare_imports_from_collection() -> None:
    """Keep libraries out of garbage collection, once per process.

    ManiSkill collects garbage at each rebuild, and walking through the modules of torch would take
    most of a reset.
    """
    gc.collect()
    gc.freeze()
