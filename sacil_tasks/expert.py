"""A demo to make -> its part file: the expert at work inside a generation worker."""

from dataclasses import asdict

import numpy as np

from sacil_tasks.demos import MAX_FAILURES, DemoJob, ExpertFailure, Trajectory, save_part
from sacil_tasks.episode import SceneKey, Stage
from sacil_tasks.keyframes import NO_ROW, Episode, KeyframeDemo


class Demonstrator:
    """Makes demos one after another; its stages stay open, since a renderer starts slowly."""

    def __init__(self) -> None:
        """Start with no stage open."""
        self._stages: dict[str, Stage] = {}

    def __call__(self, job: DemoJob) -> tuple[ExpertFailure, ...]:
        """Save the part of `job` and return the failures before; MAX_FAILURES: nothing saved."""
        task = job.demos.task
        if task not in self._stages:
            self._stages[task] = Stage(task)
            self._stages[task].recorder.keep_states = True
        stage, failures = self._stages[task], job.failures
        while len(failures) < MAX_FAILURES:
            scene_index = job.scene_index(redraw=len(failures))
            made = demonstrate(stage, job, scene_index)
            if not isinstance(made, str):
                save_part(job.demos, job.index, *made, _record(stage, made[0], failures))
                break
            failures += (ExpertFailure(scene_index, made),)
        return failures


def demonstrate(
    stage: Stage, job: DemoJob, scene_index: int
) -> tuple[KeyframeDemo, Trajectory] | str:
    """Act as the expert; return the recording, or why there is none worth keeping."""
    demos = job.demos
    scene = SceneKey(demos.task, demos.partition, demos.scene_set, scene_index)
    instruction = stage.begin(scene, variation=job.variation, split=demos.split)
    observations, candidates, keyframes = [stage.observe()], [stage.env.candidate_in_base()], []
    for number in range(stage.spec.keyframes):
        keyframe = stage.expert_keyframe(number)
        result = stage.execute(keyframe)
        if result.refusal:
            return f"keyframe {number} refused: {result.refusal}"
        keyframes.append(keyframe)
        observations.append(stage.observe())
        candidates.append(stage.env.candidate_in_base())
    if not result.success:
        return stage.outcome().code
    made = KeyframeDemo(
        episode=Episode(
            instruction=instruction,
            slots=stage.options["slots"],
            variation=job.variation,
            template=stage.options["template"],
            scene_index=scene_index,
            env_seed=stage.seed,
            sizes_m=stage.env.sizes_m,
        ),
        observations=observations,
        keyframes=keyframes,
        targets=[_target(stage, number) for number in range(stage.spec.keyframes)],
        candidate_in_base=np.stack(candidates),
    )
    return made, stage.recorder.trajectory()


def _target(stage: Stage, number: int) -> int:
    """The candidate that a keyframe serves, if it serves one."""
    position = stage.env.expert_target(number)
    return NO_ROW if position is None else stage.env.target_order()[position]


def _record(stage: Stage, made: KeyframeDemo, failures: tuple[ExpertFailure, ...]) -> dict:
    """Entry of `trajectory.json`: what ManiSkill's replay needs, then what it ignores."""
    episode = asdict(made.episode)
    del episode["sizes_m"]
    return {
        "episode_seed": stage.seed,
        "control_mode": stage.env.control_mode,
        "elapsed_steps": len(stage.recorder.trajectory().actions),
        "reset_kwargs": {"seed": stage.seed, "options": stage.options},
        "success": True,
        "fail": False,
        **episode,
        "attempt": stage.attempt,
        "failures": [asdict(failure) for failure in failures],
    }
