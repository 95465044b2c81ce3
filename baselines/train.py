"""Train an agent on keyframe files: `python -m baselines.train --agent rvt`.

`options.py` reads the command line, `material.py` the data, `trainer.py` takes the steps, `run.py`
keeps their record; here a run is begun, or found in its folder and completed.
"""

import json
import logging
import statistics
import sys
import time
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import torch

from baselines.checkpoint import (
    METRICS,
    STATE,
    TEXT,
    Plan,
    TrainState,
    trained_samples,
)
from baselines.distributed import of_first, process_group, rank, wait_for_all
from baselines.material import Material, sentences_of
from baselines.options import Job, parse, with_samples
from baselines.run import Run, read_rows
from baselines.tensorboard import event_log
from sacil_tasks.errors import UsageError, run_command
from sacil_tasks.files import sole_writer

AFTER_STOP = "The same command with --resume goes on."

CALIBRATION_STEPS = 8
"""Steps that are timed for `--minutes`; the first two, which compile, are left out."""


def start(args: Sequence[str]) -> None:
    """Read the command line and train, alone or as one of the processes of `torchrun`.

    Raises:
        UsageError: whatever a user can set right.
    """
    with process_group():
        main(parse(args))


def main(job: Job) -> None:
    """Train, or complete, the run that `job` describes.

    Raises:
        UsageError: whatever a user can set right.
    """
    options = job.options
    torch.set_num_threads(options.threads)
    if _is_complete(job, _earlier(job)):
        return
    material = Material.load(job)
    with ExitStack() as stack:
        if rank() == 0:
            stack.enter_context(sole_writer(options.folder))
        state = _earlier(job)  # another process may have trained here meanwhile
        wait_for_all()  # no rank may take what another begins for an earlier run
        if _is_complete(job, state):
            return
        run = _begin(material) if state is None else _continue(material, state)
        if options.tensorboard and rank() == 0:
            log = event_log(options.folder, after_step=run.trainer.step)
            run.listeners.append(stack.enter_context(log))
        run.finish(validate_every=options.validate_every)
    if rank() == 0:
        _report(options.folder)


def _earlier(job: Job) -> TrainState | None:
    """What a run in the folder has saved, if the job is to complete that run.

    Raises:
        UsageError: it is another run, or weights are there without what completes them.
    """
    folder = job.options.folder
    state = TrainState.load(folder)
    if state is not None:
        _check_resumable(job, state)
    elif trained_samples(folder):
        raise UsageError(
            f"{folder} holds trained weights but no {STATE} to go on from. "
            "Choose another --out, or move them away."
        )
    return state


def _is_complete(job: Job, state: TrainState | None) -> bool:
    complete = state is not None and state.progress.step == state.plan.steps
    if complete and rank() == 0:
        print(f"nothing to do: {job.options.folder} is complete.")
    return complete


def _begin(material: Material) -> Run:
    """Fix the number of steps and begin, over whatever a run that never got this far has left."""
    plan = Plan(
        steps=_steps(material),
        request=_request(material.job),
        keyframes=_hashes(material),
        text=material.text.spec,
    )
    if rank() == 0:
        (material.job.options.folder / METRICS).unlink(missing_ok=True)
    material = _planned(material, plan)
    run = _run(material, plan)
    _write_down(material)
    run.save()
    return run


def _planned(material: Material, plan: Plan) -> Material:
    """The same material for a run of so many steps."""
    config = with_samples(material.job.config, plan.steps * material.job.config.recipe.batch)
    identity = replace(material.identity, config=config)
    return replace(material, job=Job(material.job.options, config), identity=identity)


def _run(material: Material, plan: Plan) -> Run:
    """The run at its first step."""
    trainer = material.trainer(plan.steps)
    validate = material.validator(trainer.network.sight)
    return Run(trainer, material.job.options.folder, plan, validate=validate)


def _write_down(material: Material) -> None:
    """Write what does not change during a run."""
    if rank() > 0:
        return
    folder = material.job.options.folder
    material.identity.save(folder)
    sentences = set().union(*sentences_of(material.keyframes).values())
    material.text.save(folder / TEXT, sentences)


def _continue(material: Material, state: TrainState) -> Run:
    """Take up a run where it was saved; files that were lost meanwhile are written again."""
    material = _planned(material, state.plan)
    folder, before, encoder = material.job.options.folder, state.plan.text, material.text.spec
    if before != encoder:
        raise UsageError(
            f"{folder} holds a run that reads words by {before.short}, but what this machine has "
            f"under that name is {encoder.short}. Bring back its files, or choose another --out."
        )
    different = _hashes(material).items() ^ state.plan.keyframes.items()
    if changed := sorted(task for task, _ in different):
        raise UsageError(
            f"the keyframes of {changed[0]} in {material.job.options.data} are not those the run "
            "began with. Give their folder with --data, or choose another --out."
        )
    run = _run(material, state.plan)
    run.resume(state)
    _write_down(material)
    return run


def _hashes(material: Material) -> dict[str, str]:
    """Task -> content hash of its keyframes."""
    return {shard.task: shard.content_sha256 for shard in material.keyframes.shards}


def _check_resumable(job: Job, state: TrainState) -> None:
    options, step, steps = job.options, state.progress.step, state.plan.steps
    if not options.resume and step < steps:
        raise UsageError(
            f"{options.folder} holds a run that stopped at step {step} of {steps}. "
            "Add --resume to complete it, or choose another --out."
        )
    asked = options.steps or (options.samples or 0) // job.config.recipe.batch or steps
    if asked != steps:
        raise UsageError(
            f"{options.folder} holds a run of {steps} steps, but {asked} are asked for. "
            "Leave the budget out to complete it, or choose another --out."
        )
    before, now = _flat(state.plan.request), _flat(_request(job))
    for name in sorted(before.keys() | now.keys()):
        if before.get(name) != now.get(name):
            raise UsageError(
                f"{options.folder} holds a run with {name} {before.get(name)}, but "
                f"{now.get(name)} is asked for. Repeat its flags, or choose another --out."
            )


def _request(job: Job) -> dict[str, Any]:
    """What a run is, apart from its budget: a resumed one must agree."""
    options = job.options
    config = asdict(job.config)
    del config["recipe"]["samples"]
    request = {"agent": options.agent, "preset": options.preset, "seed": options.seed}
    tasks = list(options.chosen_tasks)
    return json.loads(json.dumps({**request, "tasks": tasks, "config": config}))


def _flat(tree: Any, prefix: str = "") -> dict[str, Any]:
    if not isinstance(tree, dict):
        return {prefix: tree}
    nested = (_flat(branch, f"{prefix}.{name}") for name, branch in tree.items())
    return {name.lstrip("."): leaf for branch in nested for name, leaf in branch.items()}


def _steps(material: Material) -> int:
    """The budget in steps."""
    options, recipe = material.job.options, material.job.config.recipe
    if options.minutes is None:
        return options.steps or recipe.samples // recipe.batch
    trainer = material.trainer(sys.maxsize)
    seconds = []
    for _ in range(CALIBRATION_STEPS):
        start = time.perf_counter()
        trainer.advance()
        seconds.append(time.perf_counter() - start)
    pace = statistics.median(seconds[2:])
    steps = of_first(max(1, round(60 * options.minutes / pace)))
    print(f"{pace:.2f} s a step: {options.minutes:g} minutes are {steps} steps.")
    return steps


def _report(folder: Path) -> None:
    """Print what the run came to."""
    rows = read_rows(folder / METRICS)
    last = {row["kind"]: row for row in rows}
    for name, scores in last.get("val", {}).items():
        if isinstance(scores, dict):
            print(_score_line(name, scores))
    train = last["train"]
    pace = statistics.median(row["samples_per_s"] for row in rows if row["kind"] == "train")
    print(f"loss {train['loss']:.3f} after {train['step']} steps, {pace:.1f} samples/s: {folder}")


def _score_line(name: str, scores: dict[str, Any]) -> str:
    total = scores["keyframes"]
    words, hand = (scores[f"selected_by_{what}"] for what in ("words", "hand"))
    return (
        f"{name:<32} position {scores['position_mm']:6.1f} mm  "
        f"rotation {scores['rotation_within_5deg'] / total:4.0%}  "
        f"gripper {scores['gripper_right'] / total:4.0%}  "
        f"selected {words[0]}/{words[1]} by words, {hand[0]}/{hand[1]} by hand"
    )


if __name__ == "__main__":
    logging.basicConfig(format="%(message)s", level=logging.INFO)
    run_command(lambda: start(sys.argv[1:]), after_stop=AFTER_STOP)
