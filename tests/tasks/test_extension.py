"""The tasks as a stranger uses them: plain gymnasium and ManiSkill, no command of ours."""

import json
import subprocess
import sys
from collections.abc import Iterator
from copy import deepcopy
from dataclasses import dataclass
from itertools import cycle
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gymnasium as gym
import h5py
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from mani_skill.utils.structs import Actor, Articulation, Pose
from mani_skill.utils.wrappers import RecordEpisode
from mani_skill.utils.wrappers.gymnasium import CPUGymWrapper

from sacil_tasks.catalog import MAX_EPISODE_STEPS, env_id, task_names
from sacil_tasks.demos import Trajectory
from sacil_tasks.errors import UsageError
from sacil_tasks.instructions import variations
from sacil_tasks.motion.executor import KeyframeExecutor
from sacil_tasks.outcomes import Outcome
from sacil_tasks.recording import StepRecorder
from sacil_tasks.table import HOME_QPOS, SizedTableEnv

pytestmark = pytest.mark.sim

MODES = ("state", "rgbd", "pointcloud", "state_dict", "rgb+depth+segmentation", "none")
CHECKED_MODES = ("state_dict", "state", "rgbd")
"""Of the others ManiSkill's observation spaces hold empty parts, which gymnasium refuses."""

SEED = 3
"""A scene that the expert solves in every task."""

IN_VIEW = {"tcp_pose"}
"""What images come with; sizes, poses and words would give the target away."""


@pytest.fixture(scope="module", autouse=True)
def alive() -> Iterator[None]:
    """The renderer starts once: it would start again after the last environment has closed."""
    made = _make("pick_and_lift", obs_mode="rgb")
    yield
    made.close()


def _make(task: str, **kwargs: Any) -> gym.Env:
    quiet = {"render_backend": "none"} if kwargs.get("obs_mode", "none") in _UNSEEN else {}
    return gym.make(f"sacil_tasks:{env_id(task)}", **{"obs_mode": "none"} | quiet | kwargs)


_UNSEEN = {"none", "state", "state_dict"}


def _leaves(tree: Any) -> list[torch.Tensor]:
    return (
        [leaf for it in tree.values() for leaf in _leaves(it)] if isinstance(tree, dict) else [tree]
    )


@pytest.mark.parametrize(("task", "mode"), zip(task_names(), cycle(MODES), strict=False))
def test_observations_are_what_their_space_says(task: str, mode: str) -> None:
    made = _make(task, obs_mode=mode)
    first, info = made.reset(seed=1)
    seen, reward, *_ = made.step(made.action_space.sample())
    space = made.observation_space
    assert space.contains(_to_numpy(first))
    assert space.contains(_to_numpy(seen))
    assert not {leaf.data_ptr() for leaf in _leaves(first)} & {
        it.data_ptr() for it in _leaves(seen)
    }
    if mode not in _UNSEEN:
        assert set(seen["extra"]) == IN_VIEW
    assert (reward.tolist(), reward.dtype) == ([0.0], torch.float32)
    assert all(torch.as_tensor(value).shape[:1] in {(), (1,)} for value in info.values())
    assert len(made.unwrapped.get_language_instruction()) == 1
    made.close()


def _to_numpy(tree: Any) -> Any:
    if isinstance(tree, dict):
        return {name: _to_numpy(branch) for name, branch in tree.items()}
    return tree.numpy()


@pytest.mark.parametrize(("task", "mode"), zip(task_names(), cycle(CHECKED_MODES), strict=False))
def test_gymnasium_accepts_every_task(task: str, mode: str) -> None:
    made = _make(task, obs_mode=mode)
    check_env(CPUGymWrapper(made), skip_render_check=True, skip_close_check=True)
    made.close()


def test_states_tell_what_decides_success() -> None:
    """Nothing but the state is needed to tell whether the task is solved."""
    wanted = {"pick_and_lift": "goal_position", "place_cup": "fixture_pose"}
    for task, name in wanted.items():
        made = _make(task, obs_mode="state_dict")
        seen, _ = made.reset(seed=1)
        assert {name, "candidate_pose", "candidate_size", "asked", "handle_order"} <= set(
            seen["extra"]
        )
        made.close()


@pytest.mark.parametrize(
    ("asked", "answer"),
    [
        ({"reward_mode": "dense"}, "no reward mode called 'dense'. Known: none, sparse"),
        ({"num_envs": 2, "sim_backend": "physx_cpu"}, "one environment per process"),
        ({"camera_rig": "aimd"}, "Did you mean aimed"),
    ],
)
def test_what_cannot_be_made_is_one_sentence(asked: dict[str, Any], answer: str) -> None:
    with pytest.raises(UsageError, match=answer) as caught:
        _make("push_buttons", **asked)
    assert "\n" not in str(caught.value)


@pytest.mark.skipif(torch.cuda.is_available(), reason="a GPU can simulate several environments")
def test_several_environments_need_a_gpu() -> None:
    with pytest.raises(UsageError, match="num_envs=2 needs physics on an NVIDIA GPU"):
        _make("push_buttons", num_envs=2)


@pytest.fixture(scope="module")
def buttons() -> Iterator[gym.Env]:
    """Built once, as on a GPU."""
    made = _make("push_buttons", reconfiguration_freq=0, obs_mode="state_dict")
    yield made
    made.close()


@pytest.mark.parametrize(
    ("seed", "options", "answer"),
    [
        (1, {"slot": {}}, "no reset option called 'slot'. Did you mean slots"),
        (1, {"drawer_open": True}, "no reset option called 'drawer_open'"),
        (1, {"slots": "small"}, "slots are words by name"),
        (1, {"split": None}, "no split of push_buttons called 'None'"),
        (1, {"split": "shift_up"}, 'add "reconfigure": True'),
        (1.5, {}, "a seed is an integer"),
        ("1", {}, "a seed is an integer"),
        ([1, 2], {}, r"1 environment\(s\) take one seed"),
    ],
)
def test_wrong_resets_are_one_sentence(
    buttons: gym.Env, seed: Any, options: dict[str, Any], answer: str
) -> None:
    with pytest.raises(UsageError, match=answer):
        buttons.unwrapped.reset(seed=seed, options=options)


def test_without_a_rebuild_places_follow_the_seed_and_sizes_stay(buttons: gym.Env) -> None:
    base: Any = buttons.unwrapped
    for env_idx in ([0], torch.tensor([0])):
        before_m = base.sizes_m
        buttons.reset(seed=5, options={"env_idx": env_idx})
        here = base.candidate_in_base()
        _, info = buttons.reset(seed=6, options={"env_idx": env_idx})
        assert not info["reconfigure"]
        assert not np.allclose(base.candidate_in_base(), here)
        assert np.array_equal(base.sizes_m, before_m)
    _, info = buttons.reset(seed=6, options={"reconfigure": True, "split": "shift_down"})
    assert info["reconfigure"]
    assert not np.allclose(base.sizes_m, before_m)
    buttons.reset(seed=6, options={"reconfigure": True})


def test_a_split_may_change_whenever_a_rebuild_is_due() -> None:
    made = _make("push_buttons", reconfiguration_freq=2)
    made.reset(seed=1)
    _, info = made.reset(seed=1, options={"split": "shift_down"})
    assert info["reconfigure"]
    with pytest.raises(UsageError, match="was built for the split shift_down"):
        made.reset(seed=1, options={"split": "canon"})
    made.close()


def test_an_episode_is_cut_off_where_the_caller_says() -> None:
    for asked, limit in (({}, MAX_EPISODE_STEPS), ({"max_episode_steps": 3}, 3)):
        made = _make("pick_up_cup", **asked)
        made.reset(seed=1)
        cut = [bool(made.step(_home())[3]) for _ in range(4)]
        assert cut == [step >= limit for step in range(1, 5)]
        made.close()


def _home(fingers: float = 1.0) -> np.ndarray:
    return np.array([*HOME_QPOS[:7], fingers], dtype=np.float32)


def test_recordings_hold_all_of_the_state_and_a_video(tmp_path: Path) -> None:
    made = _make("place_cups", render_mode="rgb_array", render_backend="cpu")
    made = RecordEpisode(CPUGymWrapper(made), str(tmp_path), trajectory_name="demo")
    made.reset(seed=4, options={"template": 1})
    for _ in range(3):
        made.step(_home())
    base: Any = made.unwrapped
    last = base.get_state_dict()
    made.close()
    assert [path.stat().st_size > 1000 for path in tmp_path.glob("*.mp4")] == [True]
    with h5py.File(tmp_path / "demo.h5") as file:
        states = file["traj_0/env_states"]
        for group in ("actors", "articulations", "task"):
            assert states[group].keys() == last[group].keys()
            for name, value in last[group].items():
                assert np.array_equal(states[group][name][-1], value[0].numpy())


def test_recordings_of_an_expert_replay_in_a_fresh_process(tmp_path: Path) -> None:
    """Nothing there imports our package but the id that ManiSkill has recorded."""
    how = {"obs_mode": "none", "control_mode": "pd_joint_pos", "render_backend": "none"}
    made = gym.make(env_id("put_item_in_drawer"), **how)
    made = RecordEpisode(made, str(tmp_path), trajectory_name="demo", save_video=False)
    slots = {"size": "large", "drawer": "middle"}
    made.reset(options={"slots": slots})
    _act(KeyframeExecutor(made), made.unwrapped)  # type: ignore[arg-type]
    made.close()
    command = [sys.executable, "-m", "mani_skill.trajectory.replay_trajectory", "--save-traj"]
    command += ["--traj-path", str(tmp_path / "demo.h5"), "--use-env-states"]
    ended = subprocess.run(command, capture_output=True, text=True, check=True)
    assert "1/1=100.00% demos saved" in ended.stdout
    (again,) = tmp_path.glob("demo.*.json")
    for path in (tmp_path / "demo.json", again):
        written = json.loads(path.read_text())
        assert written["env_info"]["env_id"] == f"sacil_tasks:{env_id('put_item_in_drawer')}"
        assert written["episodes"][0]["reset_kwargs"]["options"]["slots"] == slots


@dataclass(frozen=True)
class Played:
    """An episode of the expert, solved."""

    env: SizedTableEnv
    steps: Trajectory
    outcome: Outcome


@pytest.fixture(
    scope="module",
    params=("pick_and_lift", "place_cup", "push_buttons", "put_items_in_drawer", "take_off_pepper"),
)
def played(request: pytest.FixtureRequest) -> Iterator[Played]:
    made = StepRecorder(_make(request.param, control_mode="pd_joint_pos"))
    made.keep_states = True
    made.reset(seed=SEED)
    base: Any = made.unwrapped
    _act(KeyframeExecutor(made), base)
    yield Played(base, made.trajectory(), base.outcome())
    made.close()


def _state(tree: Any, step: int) -> Any:
    """What `get_state_dict` gave after so many control steps."""
    if isinstance(tree, dict):
        return {name: _state(branch, step) for name, branch in tree.items()}
    return torch.as_tensor(tree[step])[None]


def test_an_episode_goes_on_from_a_state_taken_in_its_middle(played: Played) -> None:
    """A drawer open and an item in it, a button held down, a cup in the hand: nothing is lost."""
    env, steps = played.env, played.steps
    cut = 7 * len(steps.actions) // 10
    env.reset(seed=SEED + 1)
    env.reset(seed=SEED)
    env.set_state_dict(_state(steps.states, cut))
    assert env.events.touch_order.any()
    for action in steps.actions[cut:]:
        env.step(action)
    assert env.outcome() == played.outcome
    kept, meant = env.get_state_dict()["task"], _state(steps.states["task"], -1)
    assert all(torch.equal(kept[name], meant[name]) for name in meant)


def test_success_and_outcomes_are_computed_row_by_row(
    played: Played, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The half of a GPU's work that a CPU can check: several episodes at once, as rows."""
    env, steps = played.env, played.steps
    env.reset(seed=SEED)
    other = next(slots for slots in variations(env.task) if slots != env.slots())
    views, outcomes = [], []
    for step, slots in ((0, env.slots()), (-1, env.slots()), (-1, other)):
        env.set_state_dict(_state(steps.states, step))
        env.ask(slots)
        views.append(_view(env))
        outcomes.append(env.outcome())
    assert [outcome.success for outcome in outcomes] == [False, True, False]
    for name in views[0]:
        monkeypatch.setattr(env, name, _stack([view[name] for view in views]))
    assert env.evaluate()["success"].tolist() == [False, True, False]
    assert [env.outcome(i) for i in range(len(outcomes))] == outcomes


def _view(env: SizedTableEnv) -> dict[str, Any]:
    """All that success is computed from, as it is now."""
    tensors = ("_labels", "_sizes_m", "_asked", "_targets", "_unnamed", "_open_order")
    bodies = ("candidates", "drawers", "fixture", "goal")
    view = {name: getattr(env, name).clone() for name in tensors if hasattr(env, name)}
    view |= {name: _body(getattr(env, name)) for name in bodies if hasattr(env, name)}
    sensor = env._sensor  # noqa: SLF001
    read = {name: getattr(sensor, name)() for name in ("positions", "quaternions")}
    return view | {"_sensor": read, "events": vars(deepcopy(env.events))}


def _body(body: Any) -> Any:
    if isinstance(body, list):
        return [_body(one) for one in body]
    read = {"pose": body.pose.raw_pose.clone()}
    if isinstance(body, Actor):
        read["is_static"] = body.is_static(0.01)
    if isinstance(body, Articulation):
        read["qpos"] = body.qpos.clone()
    return read


def _stack(parts: list[Any]) -> Any:
    """What one object would say of all parallel environments."""
    if isinstance(parts[0], torch.Tensor):
        return torch.cat(parts)
    if isinstance(parts[0], list):
        return [_stack(list(rows)) for rows in zip(*parts, strict=True)]
    rows = {name: torch.cat([part[name] for part in parts]) for name in parts[0]}
    for name in {"is_static", "positions", "quaternions"} & rows.keys():
        rows[name] = lambda *_, value=rows[name]: value
    if "pose" in rows:
        rows["pose"] = Pose.create(rows["pose"])
    return SimpleNamespace(**rows, batched=True)


def _act(executor: KeyframeExecutor, env: SizedTableEnv) -> None:
    """The expert's whole episode."""
    executor.begin()
    for index in range(env.task.keyframes):
        assert executor.execute(env.expert_keyframe(index, env.target_order())) is None
    assert env.outcome().success
