"""The four cameras, and what a policy sees through them.

Nothing is rendered while the arm moves: `observe` renders once, when a policy is about to choose.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import sapien
from jaxtyping import Float32
from mani_skill.sensors.camera import CameraConfig
from mani_skill.utils import sapien_utils
from mani_skill.utils.structs import Link

from sacil_tasks.interface import CAMERAS, IMAGE_PIXELS, Observation

if TYPE_CHECKING:
    from sacil_tasks.table import SizedTableEnv

SHADER = "minimal"
"""Renderer of observations: fastest, and its pixels are part of the benchmark's definition."""

Point = tuple[float, float, float]


@dataclass(frozen=True)
class FixedCamera:
    """A camera standing in the world (table) frame."""

    eye_m: Point
    target_m: Point
    fov_deg: float


AIMED = {
    "front": FixedCamera((1.3, 0.0, 1.0), (-0.04, 0.0, 0.255), 24.5),
    "left_shoulder": FixedCamera((-0.70, 0.95, 1.05), (-0.055, 0.0, 0.135), 28.5),
    "right_shoulder": FixedCamera((-0.70, -0.95, 1.05), (-0.055, 0.0, 0.135), 28.5),
}
"""Aimed so that the task region fills each view and the arm at home hides no candidate in more
than one. D-cameras."""

RLBENCH = {
    "front": FixedCamera((1.044, 0.0, 0.828), (0.138, 0.0, 0.405), 40.0),
    "left_shoulder": FixedCamera((-0.481, 0.2, 1.228), (-0.065, 0.127, 0.322), 40.0),
    "right_shoulder": FixedCamera((-0.481, -0.2, 1.228), (-0.065, -0.127, 0.322), 40.0),
}
"""RLBench's own poses, moved into this frame: objects are 5 to 11 pixels wide."""

RIGS = {"aimed": AIMED, "rlbench": RLBENCH}

_WRIST_POSE = sapien.Pose([0.05, 0, 0], [np.sqrt(0.5), 0, -np.sqrt(0.5), 0])
"""In front of `panda_hand`, looking along its fingers."""

_WRIST_FOV_DEG = 60.0


def sensor_configs(rig: dict[str, FixedCamera], hand: Link) -> list[CameraConfig]:
    """ManiSkill's configuration of the four cameras, in the order of the contract."""
    poses = {name: sapien_utils.look_at(cam.eye_m, cam.target_m) for name, cam in rig.items()}
    fovs_deg = {name: cam.fov_deg for name, cam in rig.items()}
    return [
        CameraConfig(
            uid=name,
            pose=poses.get(name, _WRIST_POSE),
            width=IMAGE_PIXELS,
            height=IMAGE_PIXELS,
            fov=np.deg2rad(fovs_deg.get(name, _WRIST_FOV_DEG)),
            near=0.01,
            far=10.0,
            mount=None if name in rig else hand,
            shader_pack=SHADER,
        )
        for name in CAMERAS
    ]


def observe(env: "SizedTableEnv", *, step: int, max_steps: int, gripper_open: bool) -> Observation:
    """Render all four cameras of the first environment now."""
    env.scene.update_render(update_sensors=True, update_human_render_cameras=False)
    sensors = [env.scene.sensors[name] for name in CAMERAS]
    for sensor in sensors:
        sensor.capture()
    images = [sensor.get_obs(position=False, segmentation=False) for sensor in sensors]
    params = [sensor.get_params() for sensor in sensors]
    return Observation(
        rgb=np.stack([image["rgb"][0].cpu().numpy() for image in images]),
        depth_mm=np.stack([image["depth"][0, ..., 0].cpu().numpy() for image in images]).astype(
            np.uint16
        ),
        intrinsics=np.stack([p["intrinsic_cv"][0].cpu().numpy() for p in params]),
        camera_in_base=np.stack(
            [_camera_in_base(p["extrinsic_cv"][0].cpu().numpy(), env) for p in params]
        ),
        tcp_in_base=env.tcp_in_base()[0].cpu().numpy(),
        gripper_open=gripper_open,
        step=step,
        max_steps=max_steps,
    )


def _camera_in_base(
    world_to_camera: Float32[np.ndarray, "3 4"], env: "SizedTableEnv"
) -> Float32[np.ndarray, "4 4"]:
    rotation, shift = world_to_camera[:, :3], world_to_camera[:, 3]
    camera_in_base = np.eye(4, dtype=np.float32)
    camera_in_base[:3, :3] = rotation.T
    camera_in_base[:3, 3] = -rotation.T @ shift - env.base_in_world_m
    return camera_in_base
