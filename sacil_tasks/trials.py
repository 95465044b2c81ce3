"""Trials of the audit that need the simulator, a handful of scenes at a time.

`Auditor` is a handler factory for `sacil_tasks.workers.run_jobs`. Results are plain JSON.
"""

import hashlib
from collections.abc import Callable
from typing import Any

import numpy as np

from sacil_tasks.audit import Trial
from sacil_tasks.episode import SceneKey, Stage
from sacil_tasks.instructions import Slots, variations
from sacil_tasks.interface import CAMERAS
from sacil_tasks.scenes import draw_geometry, scene_seed
from sacil_tasks.sizes import LABELS
from sacil_tasks.spec import TaskSpec
from sacil_tasks.table import HOME_QPOS, SizedTableEnv
from sacil_tasks.verdicts import Row

HELD_SEEDS = 500
"""Seeds whose scene is also left alone for a moment."""

_HOLD_STEPS = 5


class Auditor:
    """Runs trials; stages stay open while their task lasts."""

    def __init__(self) -> None:
        """No simulator is started yet."""
        self._stage: Stage | None = None
        self._rendered = False

    def __call__(self, trial: Trial) -> list[Row]:
        """One row a scene."""
        run = _CHECKS[trial.check]
        stage = self._stage_for(trial.task, render=trial.check == "looks")
        scenes = range(trial.start, trial.start + trial.scenes)
        return [run(stage, trial.split, index) for index in scenes]

    def _stage_for(self, task: str, *, render: bool) -> Stage:
        if self._stage is None or (self._stage.task, self._rendered) != (task, render):
            if self._stage is not None:
                self._stage.close()
            self._stage, self._rendered = Stage(task, render=render), render
        return self._stage


def reset_row(stage: Stage, split: str, index: int) -> Row:
    """What a reset shows besides images, without any planning."""
    env, seed = stage.env, scene_seed("train", 0, stage.task, index, 0)
    _, info = env.reset(seed=seed, options={"split": split})
    solved = bool(info["success_lenient"].any())
    xy_m = env.candidate_in_base()[:, :2]
    row = {
        "sentence": env.get_language_instruction()[0],
        "asked": [LABELS.index(word) for word in stage.spec.size_words(env.slots())],
        "targets": list(env.target_order()),
        "xy_m": np.round(xy_m, 6).tolist(),
        "yaw_rad": [round(env._start_pose(k)[1], 6) for k in range(len(xy_m))],  # noqa: SLF001
        "rgb": draw_geometry(seed).rgb.tolist(),
        "ids": [min(numbers) for numbers in _segmentation_ids(env)],
        "shared": _flat(info) + _flat(env._get_obs_extra(info)),  # noqa: SLF001 -- no images here
    }
    if index < HELD_SEEDS:
        for _ in range(_HOLD_STEPS):
            action = np.array([*HOME_QPOS[:7], 1.0], dtype=np.float32)
            solved |= bool(env.step(action)[-1]["success_lenient"].any())
    return row | {"solved": solved}


def look_row(stage: Stage, split: str, index: int) -> Row:
    """Hashes of the images under every word, and pixels of each size in each view."""
    scene = SceneKey(stage.task, "val", 0, index)
    hashes = []
    for number in range(len(variations(stage.spec, split))):
        stage.begin(scene, variation=number, split=split)
        seen = stage.observe()
        hashes.append(hashlib.sha256(seen.rgb.tobytes() + seen.depth_mm.tobytes()).hexdigest())
    return {"images": hashes, "pixels": pixels_by_label(stage.env).tolist()}


def expert_row(stage: Stage, split: str, index: int) -> Row:
    """How the expert fares in one scene, under every word."""
    scene = SceneKey(stage.task, "val", 0, index)
    episodes = []
    for number, slots in enumerate(variations(stage.spec, split)):
        stage.begin(scene, variation=number, split=split)
        refusal = play(stage, stage.expert_keyframe)
        outcome = stage.outcome()
        episodes.append(
            {
                "asked": stage.spec.size_words(slots),
                "clean": refusal is None and outcome.clean,
                "code": refusal or outcome.code,
            }
        )
    return {"rejected": stage.attempt, "episodes": episodes}


def script_row(stage: Stage, split: str, index: int) -> Row:
    """Outcome codes of mistakes made on purpose: the expert obeys other words than those said.

    Which words it obeys instead goes around with the scene, so that enough scenes show all pairs.
    """
    scene, choices = SceneKey(stage.task, "val", 0, index), variations(stage.spec, split)
    episodes = []
    for number, asked in enumerate(choices):
        other = (number + index) % len(choices)
        stage.begin(scene, variation=other, split=split)
        keyframes = [stage.expert_keyframe(k) for k in range(stage.spec.keyframes)]
        for played in (len(keyframes), -(-len(keyframes) // 2), 0):
            stage.begin(scene, variation=number, split=split)
            refusal = play(stage, keyframes[:played].__getitem__, played)
            episodes.append(
                {
                    "expected": expected_codes(stage.spec, asked, choices[other], played),
                    "code": "REFUSED" if refusal else stage.outcome().code,
                }
            )
    return {"episodes": episodes}


def expected_codes(spec: TaskSpec, asked: Slots, obeyed: Slots, played: int) -> list[str]:
    """Outcome codes that fit: what is `asked` when the expert plays that for `obeyed`."""
    if played == 0:
        return ["NO_INTERACTION"]
    wanted, done = spec.size_words(asked), spec.size_words(obeyed)
    if played == spec.keyframes:
        if obeyed == asked:
            return ["SUCCESS"]
        if set(done) - set(wanted):
            return ["SIZE_CONFUSION"]
        return ["ORDER_ERROR" if done != wanted else "RECEPTACLE_ERROR"]
    unfinished = ["MOTOR_FAIL", "NO_INTERACTION"]
    if any(asked[name] != obeyed[name] for name in spec.receptacles):
        unfinished.append("RECEPTACLE_ERROR")
    if done[0] not in wanted:
        return [*unfinished, "SIZE_CONFUSION"]
    return [*unfinished, "ORDER_ERROR"] if done[0] != wanted[0] else unfinished


def play(stage: Stage, keyframe: Callable[[int], Any], count: int | None = None) -> str | None:
    """Execute keyframes 0 to `count` (all); the reason of the first refusal, if there is one."""
    for number in range(stage.spec.keyframes if count is None else count):
        refusal = stage.execute(keyframe(number)).refusal
        if refusal is not None:
            return refusal
    return None


def pixels_by_label(env: SizedTableEnv) -> np.ndarray:
    """Visible pixels of the small, medium and large candidate in each view (views x labels)."""
    env.scene.update_render(update_sensors=True, update_human_render_cameras=False)
    ids = _segmentation_ids(env)
    counts = np.zeros((len(CAMERAS), len(LABELS)), dtype=int)
    for view, name in enumerate(CAMERAS):
        sensor = env.scene.sensors[name]
        sensor.capture()
        seen = sensor.get_obs(rgb=False, depth=False, position=False)["segmentation"].numpy()
        for k, size_word in enumerate(env.candidate_labels):
            label = LABELS.index(size_word)
            counts[view, label] = np.isin(seen, ids[k]).sum()
    return counts


def _segmentation_ids(env: SizedTableEnv) -> list[list[int]]:
    """Segmentation ids of each candidate's bodies."""
    ids: dict[str, list[int]] = {}
    for number, thing in env.segmentation_id_map.items():
        owner = getattr(thing, "articulation", None) or thing
        ids.setdefault(owner.name, []).append(number)
    return [ids[candidate.name] for candidate in env.candidates]


def _flat(numbers: dict[str, Any]) -> list[float]:
    flat = [np.ravel(np.asarray(value)).astype(float) for _, value in sorted(numbers.items())]
    return np.round(np.concatenate(flat), 6).tolist()


_CHECKS: dict[str, Callable[[Stage, str, int], Row]] = {
    "shortcuts": reset_row,
    "looks": look_row,
    "expert": expert_row,
    "scripts": script_row,
}
