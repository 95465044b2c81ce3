"""What fixes a scene, its pixels and its verdict, as one value with a hash.

Records of different hashes are never mixed. Words, sizes and layout are read from the pure modules
of `sacil_tasks`; what lives in the simulator is declared here, and a test compares it with a
running environment. Beside the hash, every record carries what was really drawn: the scene's
fingerprint and the hash of its first images.
"""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

from sacil_tasks.catalog import env_id, task_spec
from sacil_tasks.files import content_hash
from sacil_tasks.interface import CAMERAS, IMAGE_PIXELS, MAX_KEYFRAMES, SCENE_BOUNDS, SceneBounds
from sacil_tasks.scenes import ATTEMPTS, REGION_M
from sacil_tasks.sizes import FAMILIES
from sacil_tasks.splits import SPLITS

HASH_LENGTH = 12

UNRULED = ("canon", "shift_down", "shift_up")
"""Splits that the size ladder alone defines; one protocol holds for all three."""

Point = tuple[float, float, float]


@dataclass(frozen=True, kw_only=True)
class CameraPlace:
    """Where a fixed camera stands and looks, in the world (table) frame."""

    eye_m: Point
    target_m: Point
    fov_deg: float


@dataclass(frozen=True, kw_only=True)
class EvalProtocol:
    """The rules under which one task of one partition and scene set is evaluated."""

    version: int = 2
    """Raised by hand when something changes that no other field shows; 2: the arm no longer dips
    at the end of a move, and its visual meshes are lighter."""

    env_id: str
    """Gymnasium id; its version changes with the task's scene or success predicate."""

    partition: str
    """`val` for every decision, `test` once per released checkpoint."""

    scene_set: int
    """0 is the official draw."""

    templates: tuple[str, ...]
    """Sentences that are drawn from."""

    rungs_m: tuple[float, ...]
    """Size ladder of the task's family."""

    seed_scheme: str = "partition ranges of 32 bits; sha256(scene set/task) + 64 index + attempt"
    """How (partition, scene set, task, index, attempt) becomes the environment's seed."""

    attempts: int = ATTEMPTS
    """Seeds of a scene, in order; the first whose every variation the expert can plan is used."""

    region_m: tuple[tuple[float, float], ...] = REGION_M
    """Range of candidate centres in the world frame."""

    camera_names: tuple[str, ...] = CAMERAS
    image_pixels: int = IMAGE_PIXELS
    cameras: Mapping[str, CameraPlace] = field(
        default_factory=lambda: {
            "front": CameraPlace(eye_m=(1.3, 0.0, 1.0), target_m=(-0.04, 0.0, 0.255), fov_deg=24.5),
            "left_shoulder": CameraPlace(
                eye_m=(-0.70, 0.95, 1.05), target_m=(-0.055, 0.0, 0.135), fov_deg=28.5
            ),
            "right_shoulder": CameraPlace(
                eye_m=(-0.70, -0.95, 1.05), target_m=(-0.055, 0.0, 0.135), fov_deg=28.5
            ),
        }
    )
    """The fixed cameras. D-cameras."""

    wrist_fov_deg: float = 60.0
    shader: str = "minimal"
    """ManiSkill's shader pack of the observations."""

    simulator: str = "physx_cpu"
    robot: str = "panda"
    controller: str = "pd_joint_pos"
    sim_freq_hz: int = 100
    control_freq_hz: int = 20
    solver_position_iterations: int = 20
    contact_offset_m: float = 0.01

    scene_bounds: SceneBounds = SCENE_BOUNDS
    """Cube that agents may render; probes draw in it."""

    max_keyframes: int = MAX_KEYFRAMES
    """Budget of an episode."""

    success_rule: str = (
        "after each executed keyframe has settled: lenient is the task's predicate, strict also "
        "needs every unnamed candidate neither handled nor displaced; the first lenient success, "
        "a refused keyframe or the budget ends the episode; strict counts"
    )

    split_rules: Mapping[str, Any] = field(default_factory=dict)
    """What a split changes in objects, sizes or words; empty where the ladder says it all."""

    @property
    def hash(self) -> str:
        """Short SHA-256 of all fields."""
        return content_hash(asdict(self))[:HASH_LENGTH]

    def described(self) -> dict[str, Any]:
        """All fields and the hash, for the manifest."""
        return {"hash": self.hash} | asdict(self)


def protocol_name(task: str, split: str) -> str:
    """Key of the protocol in a manifest: splits without rules of their own share the task's."""
    return task if split in UNRULED else f"{task}/{split}"


def protocol_of(task: str, partition: str, scene_set: int, split: str = "canon") -> EvalProtocol:
    """The current protocol of a known task and split."""
    spec, rules = task_spec(task), SPLITS[split]
    return EvalProtocol(
        env_id=env_id(task),
        partition=partition,
        scene_set=scene_set,
        templates=spec.held_out_templates if rules.held_out_templates else spec.templates,
        rungs_m=FAMILIES[spec.family].rungs_m,
        split_rules={} if split in UNRULED else rules.rules(),
    )
