"""The audit: it finds what is planted, holds for every task, and resumes."""

import json
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from sacil_tasks import audit, verdicts
from sacil_tasks.audit import AuditConfig, Trial, TrialLog
from sacil_tasks.catalog import task_names, task_spec
from sacil_tasks.contents import draw_contents
from sacil_tasks.errors import UsageError
from sacil_tasks.files import sole_writer
from sacil_tasks.instructions import variations
from sacil_tasks.scenes import draw_layout, scene_seed
from sacil_tasks.shortcuts import Scenes, cross_fitted_accuracy, guesses, limit
from sacil_tasks.sizes import LABELS
from sacil_tasks.wording import draw_meaning, say

SCENES = 1200


@cache
def seen(task: str) -> Scenes:
    """What resets show, drawn without a simulator; ids are those of the candidates' order."""
    spec = task_spec(task)
    seeds = [scene_seed("train", 1, task, index, 0) for index in range(SCENES)]
    layouts = [draw_layout(spec, seed) for seed in seeds]
    contents = [draw_contents(spec, "canon", seed) for seed in seeds]
    words = [draw_meaning(spec, "canon", seed) for seed in seeds]
    asked = np.array([[LABELS.index(it) for it in spec.size_words(slots)] for slots, _ in words])
    holders = np.array([np.argsort(it.labels) for it in contents])
    return Scenes(
        sentences=[
            say(spec, "canon", slots, template, seed=seed, colour_of={})
            for seed, (slots, template) in zip(seeds, words, strict=True)
        ],
        asked=asked,
        targets=np.take_along_axis(holders, asked, axis=1),
        xy_m=np.array([it.xy_m for it in layouts]),
        yaw_rad=np.array([it.yaw_rad for it in layouts]),
        rgb=np.array([it.rgb for it in contents]),
        ids=np.tile([7.0, 8.0, 9.0], (SCENES, 1)),
        shared=np.random.default_rng(0).normal(size=(SCENES, 4)),
    )


@pytest.mark.parametrize("task", task_names())
def test_nothing_but_images_tells_the_target(task: str) -> None:
    for kind, shares in guesses(seen(task)).items():
        assert np.abs(np.array(shares) - 1 / 3).max() < limit(SCENES), kind


def _leaky(kind: str) -> Scenes:
    """Scenes in a quarter of which something gives the target away."""
    scenes = seen("pick_and_lift")
    told = np.arange(SCENES) % 8 < 2
    asked, targets = scenes.asked[:, 0], scenes.targets[:, 0]
    leaks = {
        "position": np.where(asked == 2, scenes.xy_m[..., 1].argmax(1), targets),
        "colour": scenes.rgb[..., 0].argmax(1),
        "actor name": asked,
        "segmentation id": asked,
        "text": np.array([len(sentence) % 3 for sentence in scenes.sentences]),
        "info and extras": (scenes.shared[:, 0] > 0).astype(int),
    }
    leak = np.where(told | (kind == "position"), leaks[kind], targets)
    return replace(scenes, targets=leak[:, None])


@pytest.mark.parametrize(
    "kind", ["position", "colour", "actor name", "segmentation id", "text", "info and extras"]
)
def test_a_planted_leak_is_found(kind: str) -> None:
    assert guesses(_leaky(kind))[kind][0] - 1 / 3 > limit(SCENES)


def test_the_classifier_learns_a_rule_that_holds() -> None:
    features = np.random.default_rng(0).normal(size=(400, 3, 2))
    targets = (features @ [1.0, -2.0]).argmax(axis=1)
    assert cross_fitted_accuracy(features, targets) > 0.95


@pytest.mark.parametrize("task", task_names())
def test_oracles_fare_as_designed(task: str) -> None:
    found = verdicts.oracle_findings(task, scenes=12)
    assert [it for it in found if not it.holds] == []
    assert {it.split for it in found} >= {"canon", "shift_down"}
    assert any(it.what == "both right by trained size" for it in found) == (
        len(task_spec(task).slots) > 1
    )


def test_an_oracle_that_fails_is_found(monkeypatch) -> None:
    monkeypatch.setattr(verdicts, "rank_choices", lambda contents, asked: np.zeros_like(asked))
    assert not verdicts.oracle_findings("pick_and_lift", scenes=12)[0].holds


@pytest.mark.sim
@pytest.mark.parametrize("task", task_names())
def test_every_mistake_has_one_code(task: str) -> None:
    from sacil_tasks.trials import expected_codes

    spec = task_spec(task)
    for asked in variations(spec):
        assert expected_codes(spec, asked, asked, spec.keyframes) == ["SUCCESS"]
        for obeyed in variations(spec):
            (code,) = expected_codes(spec, asked, obeyed, spec.keyframes)
            named = set(spec.size_words(asked))
            assert (code == "SIZE_CONFUSION") == bool(set(spec.size_words(obeyed)) - named)
            assert expected_codes(spec, asked, obeyed, 0) == ["NO_INTERACTION"]
            halfway = expected_codes(spec, asked, obeyed, spec.keyframes // 2)
            elsewhere = any(asked[name] != obeyed[name] for name in spec.receptacles)
            assert ("RECEPTACLE_ERROR" in halfway) == elsewhere, "its drawer may be open by then"


def _episodes(small: int, large: int) -> list[dict]:
    return [
        {
            "rejected": 0,
            "episodes": [
                {"asked": ["small"], "clean": index < small, "code": ""},
                {"asked": ["large"], "clean": index < large, "code": ""},
            ],
        }
        for index in range(100)
    ]


def test_the_expert_must_be_good_and_blind_to_size() -> None:
    (good,) = verdicts.expert_findings("pick_and_lift", "canon", _episodes(99, 98))
    (bad,) = verdicts.expert_findings("pick_and_lift", "canon", _episodes(97, 96))
    (biased,) = verdicts.expert_findings("pick_and_lift", "shift_down", _episodes(100, 90))
    assert (good.holds, bad.holds, biased.holds) == (True, False, False)


def test_changed_pixels_and_sizes_alike_are_found() -> None:
    clear, alike = [[1, 2, 3]] * 2 + [[0, 0, 0]] * 2, [[1, 2, 3]] + [[2, 2, 3]] * 3
    rows = [{"images": ["a", "a"], "pixels": clear}, {"images": ["a", "b"], "pixels": alike}]
    pixels, sizes = verdicts.look_findings("pick_and_lift", "canon", rows)
    assert (pixels.measured, sizes.measured) == ("1/2", "1/2")
    assert all(it.holds for it in verdicts.look_findings("pick_and_lift", "canon", rows[:1]))


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"tasks": ("pick_and_lfit",)}, "Did you mean pick_and_lift"),
        ({"suite": "singel"}, "Did you mean single"),
        ({"resets": 0}, "at least 1"),
        ({"checks": ()}, "--checks names none"),
        ({"tasks": ("pick_up_cup",), "splits": ("shift_up",)}, "pick_up_cup has no split shift_up"),
    ],
)
def test_a_wrong_word_is_one_sentence_before_anything_starts(changes, sentence, tmp_path) -> None:
    with pytest.raises(UsageError, match=sentence):
        audit.main(AuditConfig(**{"out": tmp_path / "run"} | changes))
    assert not (tmp_path / "run").exists()


def test_a_cut_line_is_dropped_other_code_not_counted_and_foreign_files_refused(tmp_path) -> None:
    trial = Trial("looks", "pick_and_lift", "canon", 0, 2)
    TrialLog(tmp_path).append(trial, [{"a": 1}])
    path = tmp_path / audit.TRIALS_FILE
    path.write_text(path.read_text() + '{"code": "half')
    assert TrialLog(tmp_path).rows == {trial: [{"a": 1}]}
    older = json.loads(path.read_text()) | {"code": "older"}
    path.write_text(json.dumps(older) + "\n")
    assert TrialLog(tmp_path).rows == {}


@pytest.mark.parametrize("notes", ["notes\n", "no end of line", '{"my": "own"}', "two\nlines"])
def test_a_foreign_file_is_refused_and_left_as_it_is(tmp_path, notes) -> None:
    path = tmp_path / audit.TRIALS_FILE
    path.write_text(notes)
    with pytest.raises(UsageError, match="not a log of this command"):
        TrialLog(tmp_path)
    assert path.read_text() == notes


def test_two_audits_do_not_share_a_folder(tmp_path) -> None:
    with sole_writer(tmp_path), pytest.raises(UsageError, match="another run is writing"):
        audit.main(AuditConfig(tasks=("pick_up_cup",), checks=("oracles",), out=tmp_path))


def test_a_split_named_twice_is_played_once() -> None:
    once, twice = (AuditConfig(checks=("expert",), splits=("canon",) * n) for n in (1, 2))
    assert audit.plan(once) == audit.plan(twice)


@pytest.mark.sim
@pytest.mark.slow
def test_a_small_audit_holds_and_its_trials_are_kept(tmp_path, capsys) -> None:
    config = AuditConfig(
        tasks=("push_buttons",), resets=20, looks=1, scripts=1, scenes=1, workers=1, out=tmp_path
    )
    audit.main(config)
    first = capsys.readouterr().out
    assert " NO" not in first
    kept = (tmp_path / audit.TRIALS_FILE).read_bytes()
    audit.main(config)
    assert capsys.readouterr().out == first
    assert (tmp_path / audit.TRIALS_FILE).read_bytes() == kept
