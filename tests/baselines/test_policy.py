"""A checkpoint as a policy: what the harness gets from it."""

from pathlib import Path

import numpy as np
import pytest
import synthetic
import torch
from networks import TEXT, tiny

from baselines import checkpoint
from baselines.agents import rvt
from baselines.checkpoint import Identity
from baselines.policy import KeyframePolicy
from baselines.text import SentenceTable
from sacil_tasks.errors import UsageError
from sacil_tasks.interface import SCENE_BOUNDS, Observation

SENTENCES = {"lift the small block": 6, "push the large button now": 7}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A checkpoint of an untrained tiny RVT that knows two sentences."""
    torch.manual_seed(0)
    torch.set_num_threads(1)
    identity = Identity(
        agent="rvt",
        variant=None,
        preset="cpu",
        tasks=("pick_and_lift",),
        text=TEXT,
        config=tiny(rvt.CPU),
    )
    identity.save(tmp_path)
    checkpoint.save_weights(tmp_path, identity.create().state_dict())
    rng = np.random.default_rng(0)
    known = {
        sentence: rng.normal(size=(length, TEXT.dim)).astype(np.float16)
        for sentence, length in SENTENCES.items()
    }
    SentenceTable(TEXT, known).save(tmp_path / checkpoint.TEXT, known)
    return tmp_path


@pytest.fixture
def policy(folder: Path) -> KeyframePolicy:
    return rvt.load(checkpoint=folder, tasks=("pick_and_lift",), variant=None)


def observations() -> list[Observation]:
    rng = np.random.default_rng(0)
    return [synthetic.observation(rng, step) for step in range(2)]


def test_a_policy_names_its_weights_for_the_records(folder: Path, policy: KeyframePolicy) -> None:
    assert policy.checkpoint_sha256 == checkpoint.sha256(folder)


def test_keyframes_lie_in_the_scene_in_the_types_of_the_contract(policy: KeyframePolicy) -> None:
    memory = policy.begin("lift the small block")
    keyframes, memories = policy.act(observations()[:1], [memory])
    (keyframe,) = keyframes
    assert memories == [memory]
    assert keyframe.position_m.dtype == keyframe.quaternion_wxyz.dtype == np.float64
    assert np.linalg.norm(keyframe.quaternion_wxyz) == pytest.approx(1, abs=1e-12)
    offset = keyframe.position_m - SCENE_BOUNDS.center_in_base
    assert (np.abs(offset) <= SCENE_BOUNDS.side_m / 2).all()
    assert isinstance(keyframe.gripper_open, bool)
    assert isinstance(keyframe.ignore_collisions, bool)


def test_episodes_side_by_side_do_not_influence_each_other(policy: KeyframePolicy) -> None:
    memories = [policy.begin(sentence) for sentence in SENTENCES]
    together, _ = policy.act(observations(), memories)
    for seen, memory, expected in zip(observations(), memories, together, strict=True):
        (alone,), _ = policy.act([seen], [memory])
        np.testing.assert_allclose(alone.position_m, expected.position_m, atol=1e-5)
        np.testing.assert_allclose(alone.quaternion_wxyz, expected.quaternion_wxyz, atol=1e-6)


def test_the_same_question_gets_the_same_answer(policy: KeyframePolicy) -> None:
    memory = policy.begin("lift the small block")
    first, _ = policy.act(observations()[:1], [memory])
    policy.act(observations()[1:], [memory])
    second, _ = policy.act(observations()[:1], [memory])
    assert np.array_equal(first[0].position_m, second[0].position_m)


def test_an_observation_without_depth_still_gets_an_answer(policy: KeyframePolicy) -> None:
    seen = observations()[0]
    blind = Observation(**{**vars(seen), "depth_mm": np.zeros_like(seen.depth_mm)})
    (keyframe,), _ = policy.act([blind], [policy.begin("lift the small block")])
    assert np.isfinite(keyframe.position_m).all()


@pytest.mark.parametrize(
    ("request_", "words"),
    [
        ({"tasks": ("push_buttons",), "variant": None}, "not on push_buttons"),
        ({"tasks": (), "variant": "no_queries"}, "rvt:no_queries"),
    ],
)
def test_checkpoints_that_do_not_fit_are_refused(folder: Path, request_: dict, words: str) -> None:
    with pytest.raises(UsageError, match=words):
        rvt.load(checkpoint=folder, **request_)
