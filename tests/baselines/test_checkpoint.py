import json
from dataclasses import asdict, replace

import numpy as np
import pytest
import synthetic
import torch
from safetensors.torch import load_file, save

from baselines import agent, checkpoint, release
from baselines.agent import Recipe, find_agent
from baselines.batch import Inputs
from baselines.checkpoint import (
    CONFIG,
    MODEL,
    PROVENANCE,
    STATE,
    TEXT,
    Identity,
    Plan,
    Progress,
    TrainState,
)
from baselines.configs import restore
from baselines.release import ReleaseConfig
from baselines.scene.augment import AugmentConfig
from baselines.scene.sight import Views
from baselines.text import SentenceTable, TextSpec
from sacil_tasks.catalog import suite_tasks
from sacil_tasks.errors import UsageError

TEXT_SPEC = TextSpec("fake", 8, 32, "0" * 64)
TASKS = ("pick_and_lift", "pick_up_cup")

pytestmark = pytest.mark.usefixtures("tiny")


@pytest.fixture
def identity():
    return Identity(
        agent="tiny", variant=None, preset="cpu", tasks=TASKS, text=TEXT_SPEC,
        config=synthetic.TinyConfig(),
    )  # fmt: skip


@pytest.fixture
def folder(tmp_path, identity):
    """A finished run."""
    path = tmp_path / "run"
    identity.save(path)
    save_weights(path, identity)
    known = {"lift it": np.ones((3, 8), np.float16)}
    SentenceTable(TEXT_SPEC, known).save(path / TEXT, known)
    (path / PROVENANCE).write_text('{"complete": true}')
    plan = Plan(steps=5, request={}, keyframes={}, text=TEXT_SPEC)
    TrainState(tensors={}, progress=Progress(step=5, wall_s=0, cpu_s=0), plan=plan).save(path)
    return path


def save_weights(path, identity):
    network = identity.create()
    checkpoint.save_weights(path, network.state_dict())
    return network


def inputs():
    generator = torch.Generator().manual_seed(0)
    return Inputs(
        scene=Views(torch.rand(2, 5, 7, 16, 16, generator=generator)),
        gripper_in_cube=torch.zeros(2, 7),
        step=torch.zeros(2, dtype=torch.int64),
        proprio=torch.rand(2, 2, generator=generator),
        text=torch.rand(2, 4, 8, generator=generator),
        text_mask=torch.ones(2, 4, dtype=torch.bool),
    )


def edit_config(folder, **changes):
    content = json.loads((folder / CONFIG).read_text())
    (folder / CONFIG).write_text(json.dumps(content | changes))


def test_a_loaded_network_predicts_what_the_saved_one_did(folder, identity):
    network = save_weights(folder, identity).eval()
    loaded = checkpoint.load(folder, agent="tiny", tasks=["pick_and_lift"])
    assert not loaded.network.training
    assert loaded.identity == identity
    assert loaded.text["lift it"].shape == (3, 8)
    expected = network.act(inputs()).position_in_cube
    assert torch.equal(loaded.network.act(inputs()).position_in_cube, expected)


@pytest.mark.parametrize("name", sorted(agent.agent_modules()))
@pytest.mark.parametrize("preset", ["cpu", "paper"])
def test_every_agents_config_survives_json(name, preset):
    spec, _ = find_agent(name)
    for variant in (None, *spec.variants):
        config = spec.config(preset, variant)
        content = json.loads(json.dumps(asdict(config)))
        assert restore(type(config), content, "here") == config


@pytest.mark.parametrize(
    ("break_it", "message"),
    [
        (lambda f: (f / CONFIG).unlink(), "no checkpoint in"),
        (lambda f: (f / CONFIG).write_text("{"), "config.json is truncated or foreign"),
        (lambda f: (f / CONFIG).write_text("[]"), "config.json is truncated or foreign"),
        (lambda f: (f / CONFIG).write_text("{}"), "not the config of a checkpoint"),
        (lambda f: edit_config(f, schema_version=99), "version 99"),
        (lambda f: edit_config(f, agent="tyny"), "Did you mean tiny"),
        (lambda f: edit_config(f, colour="red"), "fields colour are not those"),
        (lambda f: edit_config(f, config={"pixels": 16}), "goals, recipe are not those"),
        (lambda f: edit_config(f, preset=3), "preset cannot be 3"),
        (lambda f: (f / MODEL).unlink(), "model.safetensors is missing"),
        (lambda f: (f / MODEL).write_bytes(b""), "model.safetensors is truncated"),
        (lambda f: (f / MODEL).write_bytes((f / MODEL).read_bytes()[:-9]), "truncated"),
        (lambda f: (f / MODEL).write_bytes(save({"a": torch.ones(1)})), "does not fit its config"),
        (lambda f: (f / TEXT).unlink(), "text.safetensors holds no sentence"),
        (
            lambda f: SentenceTable(replace(TEXT_SPEC, name="b"), {"a": np.ones((1, 8))}).save(
                f / TEXT, ["a"]
            ),
            "made by the text encoder b",
        ),
    ],
)
def test_a_damaged_checkpoint_is_one_clear_sentence(folder, break_it, message):
    break_it(folder)
    with pytest.raises(UsageError, match=message):
        checkpoint.load(folder, agent="tiny")


def test_another_agent_variant_or_task_is_refused(folder):
    with pytest.raises(UsageError, match="a checkpoint of tiny, not of rvt"):
        checkpoint.load(folder, agent="rvt")
    with pytest.raises(UsageError, match="not of tiny:goals"):
        checkpoint.load(folder, agent="tiny:goals")
    with pytest.raises(UsageError, match="not on push_buttons"):
        checkpoint.load(folder, agent="tiny", tasks=["pick_up_cup", "push_buttons"])


def test_a_config_of_other_sizes_does_not_fit_the_weights(folder, identity):
    replace(identity, text=replace(TEXT_SPEC, dim=9)).save(folder)
    known = {"lift it": np.ones((3, 9), np.float16)}
    SentenceTable(replace(TEXT_SPEC, dim=9), known).save(folder / TEXT, known)
    with pytest.raises(UsageError, match=r"position\.weight"):
        checkpoint.load(folder, agent="tiny")


def test_a_state_comes_back_bit_for_bit(tmp_path):
    tensors = {"weights/a": torch.randn(3), "average/n": torch.tensor(7)}
    progress = Progress(step=9, wall_s=1.5, cpu_s=1.0)
    plan = Plan(steps=10, request={"seed": 0}, keyframes={"pick_and_lift": "a1"}, text=TEXT_SPEC)
    TrainState(tensors=tensors, progress=progress, plan=plan).save(tmp_path)
    loaded = TrainState.load(tmp_path)
    assert (loaded.progress, loaded.plan) == (progress, plan)
    assert all(torch.equal(loaded.tensors[name], tensors[name]) for name in tensors)


def test_no_state_is_none_and_a_damaged_one_is_named(tmp_path):
    assert TrainState.load(tmp_path) is None
    (tmp_path / STATE).write_bytes(b"1234")
    with pytest.raises(UsageError, match=r"train_state\.safetensors is truncated"):
        TrainState.load(tmp_path)
    known = {"request": {}, "keyframes": {}, "text": asdict(TEXT_SPEC)}
    plan, none = (json.dumps({"steps": steps} | known) for steps in (10, 0))
    for metadata in (
        None,
        {"progress": "5", "plan": plan},
        {"progress": '{"step": "5", "wall_s": 1, "cpu_s": 1}', "plan": plan},
        {"progress": '{"step": 11, "wall_s": 1, "cpu_s": 1}', "plan": plan},
        {"progress": '{"step": 5, "wall_s": -1, "cpu_s": 1}', "plan": plan},
        {"progress": '{"step": 5, "wall_s": 1, "cpu_s": NaN}', "plan": plan},
        {"progress": '{"step": 0, "wall_s": 1, "cpu_s": 1}', "plan": none},
        {"progress": '{"step": 5, "wall_s": 1, "cpu_s": 1}', "plan": "{}"},
    ):
        (tmp_path / STATE).write_bytes(save({"a": torch.ones(1)}, metadata))
        with pytest.raises(UsageError, match="truncated or foreign"):
            TrainState.load(tmp_path)


def test_a_release_is_half_as_large_and_loads_alone(folder, tmp_path):
    target = tmp_path / "released"
    checkpoint.export_release(folder, target)
    assert {path.name for path in target.iterdir()} == {MODEL, CONFIG, TEXT, PROVENANCE}
    full, half = load_file(folder / MODEL), load_file(target / MODEL)
    assert {tensor.dtype for tensor in half.values()} == {torch.float16}
    loaded = checkpoint.load(target, agent="tiny").network.state_dict()
    for name, tensor in loaded.items():
        assert torch.equal(tensor, full[name].half().float())


def test_a_run_that_does_not_load_replaces_no_release(folder, tmp_path):
    target = tmp_path / "released"
    checkpoint.export_release(folder, target)
    before = {path.name: path.read_bytes() for path in target.iterdir()}
    weights = load_file(folder / MODEL)
    checkpoint.save_weights(folder, {name: tensor + 1e6 for name, tensor in weights.items()})
    with pytest.raises(UsageError, match="too large for half precision"):
        checkpoint.export_release(folder, target)
    (folder / TEXT).unlink()
    with pytest.raises(UsageError, match=TEXT):
        checkpoint.export_release(folder, target)
    assert before == {path.name: path.read_bytes() for path in target.iterdir()}


def test_a_config_that_is_not_its_variants_is_refused(folder):
    edit_config(folder, variant="goals")
    with pytest.raises(UsageError, match="tiny:goals means goals True, not False"):
        checkpoint.load(folder, agent="tiny:goals")
    edit_config(folder, variant="../../x")
    with pytest.raises(UsageError, match="variant of tiny"):
        checkpoint.load(folder, agent="tiny")


def test_an_unfinished_run_is_not_released(folder, tmp_path):
    (folder / PROVENANCE).write_text('{"complete": false}')
    with pytest.raises(UsageError, match="not finished"):
        checkpoint.export_release(folder, tmp_path / "released")
    assert not (tmp_path / "released").exists()


def test_a_release_is_named_after_the_suite_it_was_trained_on(folder, tmp_path, monkeypatch):
    monkeypatch.setattr(release, "released_folder", lambda agent: tmp_path / agent)
    with pytest.raises(UsageError, match="no suite called 'slyce'"):
        release.main(ReleaseConfig(run=folder, suite="slyce"))
    with pytest.raises(UsageError, match="trained on pick_and_lift, pick_up_cup, but the suite"):
        release.main(ReleaseConfig(run=folder))
    assert not (tmp_path / "tiny").exists()
    edit_config(folder, tasks=suite_tasks("slice"))
    release.main(ReleaseConfig(run=folder))
    assert (tmp_path / "tiny" / "slice" / MODEL).is_file()


def test_a_variant_is_released_beside_its_agent(folder, tmp_path, monkeypatch):
    for module in (release, checkpoint):
        monkeypatch.setattr(module, "released_folder", lambda agent: tmp_path / agent)
    edit_config(folder, tasks=suite_tasks("slice"))
    release.main(ReleaseConfig(run=folder))
    config = json.loads((folder / CONFIG).read_text())["config"]
    edit_config(folder, variant="goals", config=config | {"goals": True})
    save_weights(folder, Identity.load(folder))
    release.main(ReleaseConfig(run=folder))
    for name, target in (("tiny", "slice"), ("tiny:goals", "slice.goals")):
        assert checkpoint.find_released(name, TASKS) == tmp_path / "tiny" / target


def test_embeddings_of_another_encoder_are_named_by_their_fingerprint(folder):
    edit_config(folder, text=asdict(replace(TEXT_SPEC, fingerprint="1" * 64)))
    with pytest.raises(UsageError, match=r"fake \(000000000000\), but .* fake \(111111111111\)"):
        checkpoint.load(folder, agent="tiny")


def test_the_hash_names_weights_and_config(folder, identity):
    before = checkpoint.sha256(folder)
    assert checkpoint.sha256(folder) == before
    save_weights(folder, identity)  # other initial weights
    after = checkpoint.sha256(folder)
    edit_config(folder, preset="paper")
    assert len({before, after, checkpoint.sha256(folder)}) == 3


def test_the_released_checkpoint_that_covers_the_tasks_is_found(folder, tmp_path, monkeypatch):
    monkeypatch.setattr(checkpoint, "released_folder", lambda agent: tmp_path / agent)
    checkpoint.export_release(folder, tmp_path / "tiny" / "slice")
    assert checkpoint.find_released("tiny", ["pick_up_cup"]) == tmp_path / "tiny" / "slice"
    with pytest.raises(UsageError, match="no released checkpoint of tiny covers push_buttons"):
        checkpoint.find_released("tiny", ["push_buttons"])
    with pytest.raises(UsageError, match="tiny:goals"):
        checkpoint.find_released("tiny:goals", ["pick_up_cup"])


def test_released_checkpoints_live_in_the_package_of_their_agent():
    assert checkpoint.released_folder("rvt").parts[-3:] == ("baselines", "released", "rvt")
    assert checkpoint.released_folder("sacil").parts[-3:] == ("sacil_agent", "released", "sacil")


@pytest.mark.parametrize("name", sorted(agent.agent_modules()))
def test_every_released_checkpoint_loads(name):
    for config in checkpoint.released_folder(name).glob(f"*/{CONFIG}"):
        identity = Identity.load(config.parent)
        checkpoint.load(config.parent, agent=identity.name, tasks=identity.tasks)


def test_config_values_are_checked():
    content = asdict(Recipe())
    for field, value in (("batch", "16"), ("precision", "fp8"), ("augment", 3), ("lr", None)):
        with pytest.raises(UsageError, match=field):
            restore(Recipe, content | {field: value}, "here")


@pytest.mark.parametrize("shifts", [[0.1, 0.1], [0.1, 0.1, "0"], [], "0.1"])
def test_lists_are_checked_item_by_item(shifts):
    content = asdict(AugmentConfig()) | {"translation_m": shifts}
    with pytest.raises(UsageError, match="translation_m cannot be"):
        restore(AugmentConfig, content, "here")
