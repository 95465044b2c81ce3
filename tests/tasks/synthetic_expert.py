"""An expert without a simulator: random demos of the right shape, some failures, some crashes."""

import os
import signal
import time
from collections.abc import Callable

import numpy as np

from sacil_tasks.catalog import task_spec
from sacil_tasks.demos import MAX_FAILURES, DemoJob, ExpertFailure, Trajectory, save_part
from sacil_tasks.instructions import render, variations
from sacil_tasks.interface import MAX_KEYFRAMES, Keyframe, Observation
from sacil_tasks.keyframes import Episode, KeyframeDemo


def make_expert() -> Callable[[DemoJob], tuple[ExpertFailure, ...]]:
    return work


def make_slow_expert() -> Callable[[DemoJob], tuple[ExpertFailure, ...]]:
    def slowly(job: DemoJob) -> tuple[ExpertFailure, ...]:
        time.sleep(0.05)
        return work(job)

    return slowly


def make_fragile_expert() -> Callable[[DemoJob], tuple[ExpertFailure, ...]]:
    """Crash at demo 1 always, at demo 2 once; never succeed at demo 3 in its first two scenes."""

    def handle(job: DemoJob) -> tuple[ExpertFailure, ...]:
        if (job.index == 1 and not job.failures) or (job.index == 2 and not job.retried):
            os.kill(os.getpid(), signal.SIGSEGV)
        if job.index == 3:
            failures = tuple(
                ExpertFailure(job.scene_index(redraw=r), "MOTOR_FAIL")
                for r in range(len(job.failures), 2)
            )
            return work(job, job.failures + failures)
        return work(job)

    return handle


def make_hopeless_expert() -> Callable[[DemoJob], tuple[ExpertFailure, ...]]:
    def handle(job: DemoJob) -> tuple[ExpertFailure, ...]:
        if job.index != 1:
            return work(job)
        return tuple(
            ExpertFailure(job.scene_index(redraw=r), "MOTOR_FAIL") for r in range(MAX_FAILURES)
        )

    return handle


def work(
    job: DemoJob, failures: tuple[ExpertFailure, ...] | None = None
) -> tuple[ExpertFailure, ...]:
    failures = job.failures if failures is None else failures
    scene_index = job.scene_index(redraw=len(failures))
    demo = make_demo(job, scene_index)
    rng = np.random.default_rng(scene_index)
    steps = int(rng.integers(3, 6))
    trajectory = Trajectory(
        actions=rng.random((steps, 8), dtype=np.float32),
        success=np.arange(steps) == steps - 1,
        states={"actors": {"candidate_0": rng.random((steps + 1, 13), dtype=np.float32)}},
    )
    record = {
        "episode_seed": scene_index,
        "elapsed_steps": steps,
        "slots": dict(demo.episode.slots),
        "attempt": 0,
        "failures": [vars(failure) for failure in failures],
    }
    save_part(job.demos, job.index, demo, trajectory, record)
    return failures


def make_demo(job: DemoJob, scene_index: int) -> KeyframeDemo:
    spec = task_spec(job.demos.task)
    rng = np.random.default_rng([scene_index, job.variation])
    slots = variations(spec)[job.variation]
    return KeyframeDemo(
        episode=Episode(
            instruction=render(spec, slots, 0),
            slots=slots,
            variation=job.variation,
            template=0,
            scene_index=scene_index,
            env_seed=scene_index,
            sizes_m=rng.random(3, dtype=np.float32),
        ),
        observations=[_observation(rng, step) for step in range(spec.keyframes + 1)],
        keyframes=[_keyframe(rng) for _ in range(spec.keyframes)],
        targets=[0] * spec.keyframes,
        candidate_in_base=rng.random((spec.keyframes + 1, 3, 3), dtype=np.float32),
    )


def _observation(rng: np.random.Generator, step: int) -> Observation:
    return Observation(
        rgb=np.full((4, 128, 128, 3), rng.integers(256), dtype=np.uint8),
        depth_mm=np.full((4, 128, 128), rng.integers(2000), dtype=np.uint16),
        intrinsics=rng.random((4, 3, 3), dtype=np.float32),
        camera_in_base=rng.random((4, 4, 4), dtype=np.float32),
        tcp_in_base=rng.random(7, dtype=np.float32),
        gripper_open=True,
        step=step,
        max_steps=MAX_KEYFRAMES,
    )


def _keyframe(rng: np.random.Generator) -> Keyframe:
    return Keyframe(
        position_m=rng.random(3),
        quaternion_wxyz=rng.random(4),
        gripper_open=False,
        ignore_collisions=False,
    )
