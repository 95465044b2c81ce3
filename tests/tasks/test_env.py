"""Environments: scenes follow the seed, words change nothing but words, state survives."""

import subprocess
import sys
from collections.abc import Iterator
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from sacil_tasks import sizes
from sacil_tasks.catalog import env_id, load_task, task_names, task_spec
from sacil_tasks.errors import UsageError
from sacil_tasks.instructions import variations
from sacil_tasks.interface import SCENE_BOUNDS
from sacil_tasks.scenes import scene_seed
from sacil_tasks.splits import SPLITS
from sacil_tasks.table import HOME_QPOS, SizedTableEnv

pytestmark = pytest.mark.sim


@pytest.fixture(scope="module", params=task_names())
def env(request: pytest.FixtureRequest) -> Iterator[SizedTableEnv]:
    yield from _made(request.param)


@pytest.fixture(scope="module")
def buttons() -> Iterator[SizedTableEnv]:
    yield from _made("push_buttons")


def _made(task: str, **kwargs: Any) -> Iterator[SizedTableEnv]:
    made = gym.make(env_id(task), **{"obs_mode": "none", "render_backend": "none"} | kwargs)
    yield made.unwrapped  # type: ignore[misc]
    made.close()


def _flat(tree: dict[str, Any], prefix: str = "") -> dict[str, torch.Tensor]:
    leaves: dict[str, torch.Tensor] = {}
    for name, value in tree.items():
        path = f"{prefix}/{name}"
        leaves |= _flat(value, path) if isinstance(value, dict) else {path: value}
    return leaves


def _differing(first: dict[str, Any], second: dict[str, Any], tolerance: float = 0.0) -> set[str]:
    left, right = _flat(first), _flat(second)
    assert left.keys() == right.keys()
    return {
        name
        for name in left
        if not torch.allclose(left[name].double(), right[name].double(), rtol=0, atol=tolerance)
    }


def _state(env: SizedTableEnv, seed: int, **options: Any) -> dict[str, Any]:
    env.reset(seed=seed, options=options)
    return env.get_state_dict()


def _hold(env: SizedTableEnv, steps: int, *, fingers: float = 1.0) -> dict[str, torch.Tensor]:
    for _ in range(steps):
        *_, info = env.step(np.array([*HOME_QPOS[:7], fingers], dtype=np.float32))
    return info


def _press(buttons: SizedTableEnv, k: int) -> None:
    """Pull a cap down as a finger would push it."""
    buttons.candidates[k].active_joints[0].set_drive_target(-0.008)
    _hold(buttons, 4)


def test_same_seed_same_scene_whatever_came_between(env: SizedTableEnv) -> None:
    first = _state(env, 7)
    words = env.get_language_instruction()
    sizes_m = env.sizes_m
    for seed in (8, 9, 10):
        env.reset(seed=seed)
        _hold(env, 2)
    assert not _differing(first, _state(env, 7))
    assert env.get_language_instruction() == words
    assert np.array_equal(env.sizes_m, sizes_m)


def test_same_seed_same_course_of_events(env: SizedTableEnv) -> None:
    ends = []
    for _ in range(2):
        env.reset(seed=11)
        _hold(env, 30, fingers=-1.0)
        ends.append(env.get_state_dict())
    assert not _differing(*ends)


def test_an_unseeded_reset_draws_another_scene(env: SizedTableEnv) -> None:
    first = _state(env, 7)
    env.reset()
    assert _differing(first, env.get_state_dict())


def test_words_change_nothing_but_words(env: SizedTableEnv) -> None:
    choices = variations(env.task)
    states = [_state(env, 3, slots=slots, template=0) for slots in choices]
    targets = set()
    for slots, state in zip(choices, states, strict=True):
        assert _differing(states[0], state) <= {"/task/asked"}
        env.reset(seed=3, options={"slots": slots, "template": 0})
        assert env.slots() == slots
        named = [env.candidate_labels[k] for k in env.target_order()]
        assert named == [slots[name] for name in env.task.slots]
        targets.add(env.target_order())
    assert len(targets) == len({env.task.size_words(slots) for slots in choices})


def test_splits_move_no_candidate_and_change_no_order_of_sizes(env: SizedTableEnv) -> None:
    _state(env, 5)
    canon_m, place = env.sizes_m, env.candidate_in_base()
    for split in env.task.splits:
        env.reset(seed=5, options={"split": split})
        there = env.candidate_in_base()[:, 2] > -1
        assert np.array_equal(env.candidate_in_base()[there, :2], place[there, :2])
        assert np.argsort(env.sizes_m).tolist() == np.argsort(canon_m).tolist()
        if split.startswith("shift"):
            assert np.all(np.sign(env.sizes_m - canon_m) == (1 if split == "shift_up" else -1))
        elif SPLITS[split].ratio is None and split != "mixed":
            assert np.array_equal(env.sizes_m, canon_m)


def test_objects_left_out_are_out_of_reach_and_never_count(env: SizedTableEnv) -> None:
    for split in {"pair", "single_object"} & set(env.task.splits):
        env.reset(seed=5, options={"split": split})
        there = env.candidate_in_base()[:, 2] > -1
        assert there.sum() == (2 if split == "pair" else 1)
        assert all(there[k] for k in env.target_order())
        info = _hold(env, 40)
        assert not info["success_lenient"].any()
        assert not (env.events.displaced & env._unnamed).any()  # noqa: SLF001


def test_clutter_is_of_another_kind_and_stands_clear(env: SizedTableEnv) -> None:
    if "clutter" not in env.task.splits:
        pytest.skip(f"{env.task.name} has no clutter")
    for seed in range(4):
        env.reset(seed=seed, options={"split": "clutter"})
        before = env.clutter_in_base()
        gaps_m = np.linalg.norm(before[:, :2] - env.candidate_in_base()[:, :2], axis=-1)
        assert gaps_m.min() > 0.1
        _hold(env, 20)
        assert np.abs(env.clutter_in_base() - before).max() < 1e-3
    env.reset(seed=0)
    assert not len(env.clutter_in_base())


def test_every_split_says_what_the_registry_says(env: SizedTableEnv) -> None:
    words = {}
    for split in env.task.splits:
        env.reset(seed=5, options={"split": split})
        (words[split],) = env.get_language_instruction()
    assert words["blank_text"] == ""
    assert words["canon"] == words["shift_down"] == words["fine_110"] == words["clutter"]
    assert "er " in words["pair"]
    assert not set(words["unique_colour"].split()) & set(sizes.LABELS)
    held_out = {words["para_size"], words["para_verb"], words["para_both"]}
    assert len(held_out | {words["canon"]}) == 4


def test_the_environments_generator_does_not_tell_the_sizes(env: SizedTableEnv) -> None:
    alike = 0
    for seed in range(20):
        env.reset(seed=seed)
        order = env.np_random.permutation(3)
        alike += all(
            sizes.LABELS[k] == label for k, label in zip(order, env.candidate_labels, strict=True)
        )
    assert alike < 12


def test_unsupported_splits_and_options_are_refused(env: SizedTableEnv) -> None:
    for split in set(SPLITS) - set(env.task.splits):
        with pytest.raises(UsageError, match=f"{env.task.name} has no split {split}"):
            env.reset(seed=1, options={"split": split})
    for options in ({"split": "shift_dwon"}, {"slots": {"size": "tiny"}}, {"template": 99}):
        with pytest.raises(UsageError):
            env.reset(seed=1, options=options)
    with pytest.raises(UsageError, match="a seed is"):
        env.reset(seed=-1)


def test_holding_still_never_succeeds_and_disturbs_nothing(env: SizedTableEnv) -> None:
    for index in range(12):
        env.reset(seed=scene_seed("val", 0, env.task.name, index, 0))
        info = _hold(env, 5)
        assert not info["success_lenient"].any()
        assert env.outcome().code == "NO_INTERACTION"
        assert not env.outcome().displaced


def test_candidates_rest_where_they_are_put(env: SizedTableEnv) -> None:
    env.reset(seed=4)
    before = env.candidate_in_base()
    _hold(env, 40)
    assert np.abs(env.candidate_in_base() - before).max() < 1e-3


def test_info_tells_nothing_of_the_target(env: SizedTableEnv) -> None:
    infos = [env.reset(seed=6, options={"slots": slots})[1] for slots in variations(env.task)]
    for info in infos[1:]:
        assert info.keys() == infos[0].keys()
        for name in info:
            assert torch.equal(torch.as_tensor(info[name]), torch.as_tensor(infos[0][name]))


def test_state_survives_a_round_trip_in_mid_episode(env: SizedTableEnv) -> None:
    slots = variations(env.task)[1]
    env.reset(seed=12, options={"slots": slots, "template": 1})
    _hold(env, 10)
    env.events.touch_order[0, 1] = 1
    kept = env.get_state_dict()
    words, outcome = env.get_language_instruction(), env.outcome()
    env.reset(seed=12)
    env.set_state_dict(kept)
    assert not _differing(kept, env.get_state_dict(), tolerance=1e-6)
    assert env.get_language_instruction() == words
    assert env.outcome() == outcome


def test_pressed_buttons_stay_down_and_are_marked(buttons: SizedTableEnv) -> None:
    buttons.reset(seed=2)
    _press(buttons, 1)
    _hold(buttons, 20)
    assert buttons.outcome().handled == (buttons.candidate_labels[1],)
    kept = buttons.get_state_dict()
    buttons.reset(seed=2)
    buttons.set_state_dict(kept)
    _hold(buttons, 20)
    travel = [float(button.qpos[0, 0]) for button in buttons.candidates]
    assert travel == pytest.approx([0.0, -0.006, 0.0], abs=3e-4)
    heights = [float(marker.pose.p[0, 2]) for marker in buttons.markers]
    assert [height > 0 for height in heights] == [False, True, False]


def test_order_of_presses_decides(buttons: SizedTableEnv) -> None:
    buttons.reset(seed=2)
    first, second = buttons.target_order()
    for order, lenient in (((first, second), True), ((second, first), False)):
        buttons.reset(seed=2)
        for k in order:
            _press(buttons, k)
        assert buttons.outcome().success_lenient == lenient
        assert buttons.outcome().code == ("SUCCESS" if lenient else "ORDER_ERROR")
    third = ({0, 1, 2} - {first, second}).pop()
    buttons.reset(seed=2)
    for k in (third, first, second):
        _press(buttons, k)
    assert buttons.outcome().success_lenient
    assert buttons.outcome().code == "SIZE_CONFUSION"


def test_expert_keyframes_stay_inside_the_scene_bounds(env: SizedTableEnv) -> None:
    low = np.subtract(SCENE_BOUNDS.center_in_base, SCENE_BOUNDS.side_m / 2)
    for seed in range(30):
        env.reset(seed=seed)
        for index in range(env.task.keyframes):
            keyframe = env.expert_keyframe(index, env.target_order())
            assert np.all(keyframe.position_m > low)
            assert np.all(keyframe.position_m < low + SCENE_BOUNDS.side_m)


def test_the_expert_turns_to_one_candidate_after_the_other_from_above(env: SizedTableEnv) -> None:
    env.reset(seed=13)
    served = [env.expert_target(index) for index in range(env.task.keyframes)]
    first_of = [served.index(position) for position in range(len(env.task.slots))]
    assert set(served[: first_of[0]]) <= {None}
    assert served[first_of[0] :] == sorted(served[first_of[0] :], key=lambda target: target or 0)
    for position, index in enumerate(first_of):
        keyframe = env.expert_keyframe(index, env.target_order())
        approach = Rotation.from_quat(keyframe.quaternion_wxyz, scalar_first=True).apply([0, 0, 1])
        assert approach == pytest.approx([0, 0, -1])
        gap = keyframe.position_m[:2] - env.candidate_in_base()[env.target_order()[position], :2]
        assert np.abs(gap).max() < 1e-6


def test_the_gripper_starts_high_and_vertical(env: SizedTableEnv) -> None:
    env.reset(seed=0)
    home = env.tcp_in_base()[0].numpy()
    assert home == pytest.approx([0.548, 0, 0.548, 0, 1, 0, 0], abs=1e-3)


@pytest.mark.parametrize("task", task_names())
def test_specs_read_from_source_are_those_of_the_classes(task: str) -> None:
    assert load_task(task).task == task_spec(task)
    assert task_spec(task).name == task


def test_ids_work_in_a_fresh_process_and_load_lazily() -> None:
    code = (
        "import sys, sacil_tasks, gymnasium as gym\n"
        "assert not {'torch', 'mani_skill', 'sapien'} & set(sys.modules)\n"
        "env = gym.make('sacil_tasks:SizedPickUpCup-v1', render_backend='none')\n"
        "print(env.reset(seed=1)[0].shape, env.unwrapped.get_language_instruction())"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "cup" in done.stdout
