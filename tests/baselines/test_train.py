import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import synthetic
import torch
from tensorboardX.proto import event_pb2

from baselines import agent, material, run, trainer
from baselines.checkpoint import (
    CONFIG,
    METRICS,
    MODEL,
    PROVENANCE,
    STATE,
    TEXT,
    TrainState,
    load,
)
from baselines.options import parse
from baselines.run import Means, read_rows
from baselines.tensorboard import EVENTS
from baselines.train import main
from sacil_tasks.errors import UsageError
from sacil_tasks.files import sole_writer

pytestmark = pytest.mark.usefixtures("tiny")

TIMING = ("samples_per_s", "cpu_s", "share_loading", "share_network", "share_optimiser")


@pytest.fixture(autouse=True)
def log_often(monkeypatch):
    """Every second step is logged and saved, so that short runs have something to resume."""
    monkeypatch.setattr(run, "LOG_EVERY", 2)
    monkeypatch.setattr(run, "SAVE_EVERY_S", 0.0)


def command(data, out, *flags, name="tiny:goals"):
    tasks = ("pick_and_lift", "pick_up_cup")
    return ["--agent", name, "--tasks", *tasks, "--data", str(data), "--out", str(out), *flags]


def train(*args, **options):
    main(parse(command(*args, **options)))


def rows_without_timing(folder):
    return [
        {k: v for k, v in row.items() if k not in TIMING} for row in read_rows(folder / METRICS)
    ]


def stop_at(monkeypatch, step, action):
    """Run `action` in the middle of a step."""
    learn = trainer.Trainer.learn

    def learn_or_stop(self, batch):
        if self.step == step:
            action()
        return learn(self, batch)

    monkeypatch.setattr(trainer.Trainer, "learn", learn_or_stop)


@pytest.fixture(scope="module")
def unbroken(data, tmp_path_factory):
    """A run of twelve steps that nothing stopped."""
    out = tmp_path_factory.mktemp("runs") / "unbroken"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(run, "LOG_EVERY", 2)
        known = {**agent.agent_modules(), "tiny": "synthetic"}
        patch.setattr("baselines.agent.agent_modules", lambda: known)
        torch.set_num_threads(1)
        train(data, out, "--steps", "12", "--validate-every", "4")
    return out


def test_a_run_leaves_a_checkpoint_that_loads(unbroken):
    loaded = load(unbroken, agent="tiny:goals", tasks=["pick_up_cup"])
    assert loaded.identity.config.recipe.samples == 12 * 4
    provenance = json.loads((unbroken / PROVENANCE).read_text())
    assert provenance["complete"]
    assert provenance["samples"] == 48
    assert set(provenance["keyframes_sha256"]) == {"pick_and_lift", "pick_up_cup"}


def test_metrics_have_means_of_what_existed_and_validation(unbroken):
    rows = rows_without_timing(unbroken)
    assert [row["step"] for row in rows if row["kind"] == "train"] == [2, 4, 6, 8, 10, 12]
    assert [row["step"] for row in rows if row["kind"] == "val"] == [4, 8, 12]
    assert {"loss", "position", "goal", "lr"} <= set(rows[0])
    assert "never" not in rows[0]  # a term that was NaN at every step


def test_tensorboard_gets_the_numbers_of_the_metrics(data, tmp_path):
    train(data, tmp_path, "--steps", "4", "--validate-every", "4", "--tensorboard")
    rows = read_rows(tmp_path / METRICS)
    shown = {(name, step): value for name, step, value in events(tmp_path / EVENTS)}
    for row in (row for row in rows if row["kind"] == "train"):
        assert shown["train/loss", row["step"]] == pytest.approx(row["loss"])
    scores = rows[-1]["all"] if rows[-1]["kind"] == "val" else rows[-2]["all"]
    assert shown["val/all/position_mm", 4] == pytest.approx(scores["position_mm"])
    right, of = scores["selected_by_words"]
    assert shown["val/all/selected_by_words", 4] == pytest.approx(right / of)


def events(folder):
    """Name, step and value of every scalar in the event files: records of length, two checksums."""
    (path,) = folder.iterdir()
    content, at = path.read_bytes(), 0
    while at < len(content):
        size = int.from_bytes(content[at : at + 8], "little")
        event = event_pb2.Event.FromString(content[at + 12 : at + 12 + size])
        yield from ((value.tag, event.step, value.simple_value) for value in event.summary.value)
        at += size + 16


def test_official_sentences_need_no_encoder(unbroken, monkeypatch):
    monkeypatch.setattr("baselines.text.load_encoder", lambda name: pytest.fail("encoder loaded"))
    table = load(unbroken, agent="tiny:goals").text
    assert table["lift the medium block please"].shape[1] == 384


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupted_run_saves_and_ends_in_the_same_bits(
    data, tmp_path, unbroken, monkeypatch, number
):
    flags = (data, tmp_path / "run", "--steps", "12", "--validate-every", "4")
    with monkeypatch.context() as patch:
        stop_at(patch, 6, lambda: signal.raise_signal(number))
        with pytest.raises(KeyboardInterrupt):
            train(*flags)
    train(*flags, "--resume")
    for name in (MODEL, CONFIG):
        assert (tmp_path / "run" / name).read_bytes() == (unbroken / name).read_bytes()


def test_a_run_that_died_ends_in_the_same_bits_and_lines(data, tmp_path, unbroken, monkeypatch):
    flags = (data, tmp_path / "run", "--steps", "12", "--validate-every", "4")

    def die():
        raise SystemExit

    with monkeypatch.context() as patch:
        stop_at(patch, 7, die)  # after the state of step 6
        with pytest.raises(SystemExit):
            train(*flags)
    with (tmp_path / "run" / METRICS).open("a") as file:
        file.write('{"kind": "train", "st')  # a line cut off
    train(*flags, "--resume")
    assert (tmp_path / "run" / MODEL).read_bytes() == (unbroken / MODEL).read_bytes()
    assert rows_without_timing(tmp_path / "run") == rows_without_timing(unbroken)


@pytest.mark.parametrize("name", [CONFIG, TEXT])
def test_what_does_not_change_is_there_again_after_a_resumption(
    data, tmp_path, unbroken, monkeypatch, name
):
    flags = (data, tmp_path / "run", "--steps", "12", "--validate-every", "4")
    with monkeypatch.context() as patch:
        stop_at(patch, 6, lambda: signal.raise_signal(signal.SIGINT))
        with pytest.raises(KeyboardInterrupt):
            train(*flags)
    (tmp_path / "run" / name).unlink()
    train(*flags, "--resume")
    found, expected = (load(run, agent="tiny:goals") for run in (tmp_path / "run", unbroken))
    assert found.identity == expected.identity
    sentence = "lift the medium block please"
    assert np.array_equal(found.text[sentence], expected.text[sentence])


def interrupt(monkeypatch, flags):
    """Begin a run that is stopped at its sixth step."""
    with monkeypatch.context() as patch:
        stop_at(patch, 6, lambda: signal.raise_signal(signal.SIGINT))
        with pytest.raises(KeyboardInterrupt):
            train(*flags)


def test_a_run_is_not_resumed_with_another_text_encoder(data, tmp_path, monkeypatch):
    flags = (data, tmp_path / "run", "--steps", "12")
    interrupt(monkeypatch, flags)
    state = TrainState.load(tmp_path / "run")
    text = replace(state.plan.text, fingerprint="0" * 64)
    replace(state, plan=replace(state.plan, text=text)).save(tmp_path / "run")
    (tmp_path / "run" / CONFIG).unlink()
    with pytest.raises(UsageError, match=r"words by minilm \(0000.*but what this machine has"):
        train(*flags, "--resume")
    assert not (tmp_path / "run" / CONFIG).exists()


@pytest.mark.parametrize(
    "change",
    [
        lambda tensors: tensors | {"weights/position.weight": torch.ones(1)},
        lambda tensors: {name: tensor.long() for name, tensor in tensors.items()},
        lambda tensors: tensors | {"weights/other": torch.ones(1)},
        lambda tensors: {name: tensors[name] for name in sorted(tensors)[1:]},
    ],
)
def test_a_run_is_not_resumed_with_the_state_of_another_network(
    data, tmp_path, monkeypatch, change
):
    flags = (data, tmp_path / "run", "--steps", "12")
    interrupt(monkeypatch, flags)
    state = TrainState.load(tmp_path / "run")
    replace(state, tensors=change(state.tensors)).save(tmp_path / "run")
    with pytest.raises(UsageError, match="the state of another network"):
        train(*flags, "--resume")


@pytest.mark.parametrize("samples", ['"many"', "1e999", "[1]"])
def test_a_foreign_provenance_beside_weights_is_named(data, tmp_path, unbroken, samples):
    shutil.copy(unbroken / MODEL, tmp_path / MODEL)
    (tmp_path / PROVENANCE).write_text(f'{{"samples": {samples}}}')
    with pytest.raises(UsageError, match=r"provenance\.json is truncated or foreign"):
        train(data, tmp_path)


@pytest.mark.parametrize(
    "line",
    [
        "[]",
        "{}",
        '{"kind": "val", "step": 1, "all": 5}',
        '{"kind": "nap", "step": 1}',
        '{"kind": "train", "step": 1, "loss": "?"}',
    ],
)
def test_a_foreign_metrics_file_is_named(tmp_path, line):
    good = '{"kind": "val", "step": 1, "all": {"position_mm": 3, "selected_by_words": [1, 2]}}'
    (tmp_path / METRICS).write_text(f"{good}\n{line}\n{line[:2]}")
    with pytest.raises(UsageError, match=r"metrics\.jsonl line 2 is not a line of training"):
        read_rows(tmp_path / METRICS)


@pytest.mark.slow
def test_kill_9_in_a_real_process_loses_nothing(data, tmp_path, unbroken):
    here = Path(__file__).parent
    script = (
        "import sys\n"
        "from baselines import agent, run, trainer\n"
        "known = {**agent.agent_modules(), 'tiny': 'synthetic'}\n"
        "agent.agent_modules = lambda: known\n"
        "run.LOG_EVERY, run.SAVE_EVERY_S = 2, 0.0\n"
        "from baselines.options import parse\n"
        "from baselines.train import main\n"
        "main(parse(sys.argv[1:]))\n"
    )
    out = tmp_path / "run"
    args = command(data, out, "--steps", "12", "--validate-every", "4")
    environment = os.environ | {"PYTHONPATH": f"{here.parent}{os.pathsep}{here.parents[1]}"}

    def start(*flags):
        return subprocess.Popen([sys.executable, "-c", script, *args, *flags], env=environment)

    process = start()
    while not (out / METRICS).is_file() and process.poll() is None:
        time.sleep(0.01)
    process.kill()
    process.wait()
    assert start("--resume").wait() == 0
    assert (out / MODEL).read_bytes() == (unbroken / MODEL).read_bytes()


def test_a_complete_run_has_nothing_to_do(data, unbroken, capsys):
    before = (unbroken / STATE).stat().st_mtime_ns
    train(data, unbroken, "--resume", "--minutes", "1")
    assert "nothing to do" in capsys.readouterr().out
    assert (unbroken / STATE).stat().st_mtime_ns == before


def test_provenance_tells_a_changed_config_from_the_preset(data, tmp_path):
    presets = []
    for number, flags in enumerate([(), ("--seed", "1"), ("--recipe.lr", "0.001")]):
        train(data, tmp_path / str(number), "--steps", "1", "--validate-every", "0", *flags)
        provenance = json.loads((tmp_path / str(number) / PROVENANCE).read_text())
        presets.append(provenance["preset"])
    assert presets[:2] == ["cpu", "cpu"]
    assert re.fullmatch(r"cpu\+[0-9a-f]{8}", presets[2])


def test_trained_weights_without_a_state_are_not_overwritten(data, tmp_path, unbroken):
    for name in (CONFIG, MODEL, PROVENANCE, METRICS):
        shutil.copyfile(unbroken / name, tmp_path / name)
    before = (tmp_path / MODEL).read_bytes()
    for flags in ((), ("--resume",)):
        with pytest.raises(UsageError, match="holds trained weights but no train_state"):
            train(data, tmp_path, "--steps", "2", *flags)
    assert (tmp_path / MODEL).read_bytes() == before
    assert read_rows(tmp_path / METRICS)


def test_a_run_that_another_process_finished_meanwhile_is_not_begun_anew(
    data, tmp_path, unbroken, monkeypatch, capsys
):
    loads = material.Material.load

    def load_slowly(job):
        shutil.copytree(unbroken, tmp_path / "run")
        return loads(job)

    monkeypatch.setattr(material.Material, "load", load_slowly)
    train(data, tmp_path / "run", "--validate-every", "4")
    assert "nothing to do" in capsys.readouterr().out


def test_an_unfinished_run_is_neither_overwritten_nor_changed(data, tmp_path, monkeypatch):
    out = tmp_path / "run"
    with monkeypatch.context() as patch:
        stop_at(patch, 3, lambda: signal.raise_signal(signal.SIGINT))
        with pytest.raises(KeyboardInterrupt):
            train(data, out, "--steps", "12")
    with pytest.raises(UsageError, match=r"stopped at step 4 of 12\. Add --resume"):
        train(data, out)
    with pytest.raises(UsageError, match="seed 0, but 1 is asked for"):
        train(data, out, "--resume", "--seed", "1")
    with pytest.raises(UsageError, match=r"config.recipe.lr 0\.\d+, but 0.1 is asked for"):
        train(data, out, "--resume", "--recipe.lr", "0.1")
    with pytest.raises(UsageError, match="agent tiny:goals, but tiny is asked for"):
        train(data, out, "--resume", name="tiny")
    with pytest.raises(UsageError, match="a run of 12 steps, but 13 are asked for"):
        train(data, out, "--resume", "--steps", "13")
    other = tmp_path / "other"
    synthetic.write_file(other, "pick_and_lift", seed=8)
    synthetic.write_file(other, "pick_up_cup", seed=1)
    with pytest.raises(UsageError, match=r"keyframes of pick_and_lift in .* are not those"):
        train(other, out, "--resume")


def test_a_loss_that_is_not_finite_keeps_the_last_good_state(data, tmp_path, monkeypatch):
    loss = synthetic.Tiny.loss

    def diverge(self, batch):
        value, terms = loss(self, batch)
        diverge.step += 1
        return (value * torch.nan, terms) if diverge.step > 5 else (value, terms)

    diverge.step = 0
    monkeypatch.setattr(synthetic.Tiny, "loss", diverge)
    with pytest.raises(UsageError, match=r"no longer finite at step 5.*lower --recipe\.lr"):
        train(data, tmp_path / "run", "--steps", "12")
    weights = load(tmp_path / "run", agent="tiny:goals").network.state_dict()
    assert all(tensor.isfinite().all() for tensor in weights.values())


def test_weights_that_a_step_has_spoilt_are_not_saved(data, tmp_path, monkeypatch):
    def spoil(optimiser, lr):
        spoil.step += 1
        if spoil.step == 4:  # step 4 is saved, its loss was still finite
            with torch.no_grad():
                optimiser.parameters["position.weight"].fill_(torch.inf)

    spoil.step = 0
    monkeypatch.setattr(trainer.Lamb, "step", spoil)
    with pytest.raises(UsageError, match="a weight is no longer finite at step 4"):
        train(data, tmp_path / "run", "--steps", "12")
    assert TrainState.load(tmp_path / "run").progress.step == 2


def test_minutes_become_steps_that_are_kept(data, tmp_path, capsys):
    train(data, tmp_path / "timed", "--minutes", "0.01", "--validate-every", "0")
    steps = json.loads((tmp_path / "timed" / PROVENANCE).read_text())["steps"]
    assert f"minutes are {steps} steps" in capsys.readouterr().out
    train(data, tmp_path / "counted", "--steps", str(steps), "--validate-every", "0")
    timed, counted = (load(tmp_path / name, agent="tiny:goals") for name in ("timed", "counted"))
    assert timed.sha256 == counted.sha256  # timing the first steps leaves no trace


def test_training_lowers_the_loss(data, tmp_path, monkeypatch):
    monkeypatch.setattr(run, "SAVE_EVERY_S", 60.0)
    train(data, tmp_path / "run", "--steps", "40", "--recipe.lr", "0.1", "--validate-every", "0")
    losses = [row["loss"] for row in read_rows(tmp_path / "run" / METRICS)]
    assert np.mean(losses[-5:]) < 0.7 * np.mean(losses[:5])


def test_the_preset_fills_in_what_flags_do_not_say(data):
    job = parse(["--preset", "paper", "--recipe.batch", "5", "--agent", "tiny", "--samples", "50"])
    assert (job.config.pixels, job.config.recipe.batch, job.config.recipe.samples) == (24, 5, 50)
    assert not job.config.goals
    assert parse(["--agent", "tiny:goals"]).config.goals
    assert parse(["--agent", "tiny"]).options.folder == Path("runs/train/tiny-slice-cpu-seed0")


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--agent", "tyny"], "Did you mean tiny"),
        (["--agent", "tiny:goal"], "no variant of tiny called 'goal'. Did you mean goals"),
        (["--agent", "tiny:"], "names no variant"),
        (["--agent", "tiny", "--preset", "papr"], "Did you mean paper"),
        (["--agent", "tiny", "--steps", "3", "--minutes", "1"], "exclude each other"),
        (["--agent", "tiny", "--steps", "0"], "above 0"),
        (["--agent", "tiny", "--suite", "slice", "--tasks", "pick_up_cup"], "exclude each other"),
        (["--agent", "tiny", "--recipe.batch", "1"], "at least 2"),
    ],
)
def test_a_command_line_that_cannot_work_is_refused_at_once(flags, message):
    with pytest.raises(UsageError, match=message):
        parse(flags)


def test_missing_data_and_unknown_names_are_refused_before_anything_is_written(tmp_path):
    out = tmp_path / "run"
    with pytest.raises(UsageError, match="gen_demos --tasks pick_and_lift pick_up_cup"):
        train(tmp_path, out)
    with pytest.raises(UsageError, match=r"no task called 'pick_and_lft'\. Did you mean pick"):
        main(parse(["--agent", "tiny", "--tasks", "pick_and_lft", "--out", str(out)]))
    with pytest.raises(UsageError, match="no suite called 'slyce'"):
        main(parse(["--agent", "tiny", "--suite", "slyce", "--out", str(out)]))
    assert not out.exists()


def test_a_folder_that_cannot_be_written_is_named(data):
    with pytest.raises(UsageError, match=r"cannot write /proc/run"):
        train(data, Path("/proc/run"), "--steps", "2")


def test_two_runs_on_one_folder_do_not_mix(data, tmp_path):
    out = tmp_path / "run"
    with sole_writer(out), pytest.raises(UsageError, match="another run is writing"):
        train(data, out, "--steps", "2")
    assert list(out.iterdir()) == []


def test_a_full_disk_is_one_sentence_and_the_run_resumes(data, tmp_path, unbroken, monkeypatch):
    flags = (data, tmp_path / "run", "--steps", "12", "--validate-every", "4")
    with monkeypatch.context() as patch:
        stop_at(patch, 7, lambda: patch.setattr(run, "METRICS", "/dev/full"))
        with pytest.raises(UsageError, match="cannot write /dev/full: No space left"):
            train(*flags)
    train(*flags, "--resume")
    assert (tmp_path / "run" / MODEL).read_bytes() == (unbroken / MODEL).read_bytes()


def test_terms_that_do_not_exist_are_left_out_of_the_mean():
    means = Means()
    for value in (1.0, float("nan"), 3.0):
        means.add({"some": value, "never": float("nan")})
    assert means.take() == {"some": 2.0}
    assert means.take() == {}
