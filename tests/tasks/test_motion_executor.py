"""Plans and their execution in SAPIEN."""

import hashlib
import os
import subprocess
import sys
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch
from motion_scene import WALL, cube_in_base, grasp, keyframe, make_env, tcp_in_base

from sacil_tasks.motion.collision import OPEN_M
from sacil_tasks.motion.executor import KeyframeExecutor, Plan
from sacil_tasks.motion.kinematics import HOME
from sacil_tasks.motion.planner import Refusal, TimingConfig

pytestmark = pytest.mark.sim

RIGHT, LEFT = keyframe((0.55, -0.15, 0.15)), keyframe((0.55, 0.15, 0.15))
"""On either side of the wall."""

TESTS = Path(__file__).parent


class Watch(gym.Wrapper):
    """Sees every control step, as a recording wrapper would."""

    def __init__(self, env):
        super().__init__(env)
        self.heights_m, self.speeds, self.joints, self.touched = [], [], [], False

    def step(self, action):
        result = super().step(action)
        robot = self.unwrapped.agent.robot
        self.heights_m.append(tcp_in_base(self)[2])
        self.joints.append(robot.get_qpos()[0, :7].numpy())
        self.speeds.append(robot.get_qvel()[0, :7].abs().max().item())
        self.touched |= touches_wall(self)
        return result


def touches_wall(env) -> bool:
    return any(
        point.separation < 0
        for contact in env.unwrapped.scene.get_contacts()
        for point in contact.points
        if any("wall" in body.entity.name for body in contact.bodies)
    )


def begin(env, seed=0):
    env.reset(seed=seed)
    env.unwrapped.agent.reset(torch.tensor([[*HOME, OPEN_M, OPEN_M]], dtype=torch.float32))
    executor = KeyframeExecutor(env)
    executor.begin()
    return executor


@pytest.fixture(scope="module")
def walled():
    return make_env(WALL)


@pytest.fixture(scope="module")
def open_table():
    return make_env()


@pytest.mark.parametrize("seed", range(3))
def test_executor_lifts_the_cube(open_table, seed):
    executor = begin(open_table, seed)
    keyframes = grasp(open_table)
    start = cube_in_base(open_table)
    assert executor.plan_sequence(keyframes) is None
    assert [executor.execute(each) for each in keyframes] == [None] * 3
    assert cube_in_base(open_table)[2] - start[2] == pytest.approx(0.1, abs=0.005)


def test_arm_arrives_where_the_keyframe_says(open_table):
    executor = begin(open_table)
    target = keyframe((0.5, 0.1, 0.25), quaternion_wxyz=(0.2, 0.85, 0.35, -0.25))
    assert executor.execute(target) is None
    np.testing.assert_allclose(tcp_in_base(open_table), target.position_m, atol=2e-3)


@pytest.mark.parametrize(
    ("target", "reason"),
    [
        (keyframe((np.nan, 0.0, 0.3)), "not_finite"),
        (keyframe((0.5, 0.0, 0.3), quaternion_wxyz=(0.0, 0.0, 0.0, 0.0)), "not_finite"),
        (keyframe((2.0, 0.0, 0.3)), "outside_workspace"),
        (keyframe((0.88, 0.35, 0.6)), "no_ik"),
        (keyframe((0.55, 0.0, 0.3)), "in_collision"),
    ],
)
def test_refusal_says_why_and_nothing_moves(walled, target, reason):
    executor = begin(walled)
    before = walled.unwrapped.agent.robot.get_qpos().clone()
    assert executor.execute(target) == Refusal(reason)
    assert (walled.unwrapped.agent.robot.get_qpos() == before).all()


def test_ignoring_collisions_plans_into_the_wall(walled):
    executor = begin(walled)
    assert isinstance(executor.plan(keyframe((0.55, 0.0, 0.3), ignore_collisions=True)), Plan)


def test_arm_goes_around_the_wall_within_its_limits(walled):
    watch = Watch(walled)
    executor = begin(watch)
    assert executor.execute(RIGHT) is None
    assert executor.execute(LEFT) is None
    np.testing.assert_allclose(tcp_in_base(walled), LEFT.position_m, atol=2e-3)
    assert not watch.touched
    limits = walled.unwrapped.agent.robot.get_qlimits()[0, :7].numpy()
    assert (np.array(watch.joints) >= limits[:, 0]).all()
    assert (np.array(watch.joints) <= limits[:, 1]).all()
    assert max(watch.speeds) <= TimingConfig().velocity_rad_s * 1.05


def test_arm_follows_the_plan_without_lag(open_table):
    watch = Watch(open_table)
    executor = begin(watch)
    target = keyframe((0.45, 0.2, 0.2))
    plan = executor.plan(target)
    assert isinstance(plan, Plan)
    assert executor.execute(target) is None
    followed = np.array(watch.joints)[: len(plan.motion)]
    np.testing.assert_allclose(followed, plan.motion, atol=0.01)


def test_descent_does_not_dip_below_its_end(open_table):
    watch = Watch(open_table)
    executor = begin(watch)
    low = keyframe((0.5, 0.1, 0.0165))
    assert executor.execute(keyframe((0.5, 0.1, 0.11))) is None
    assert executor.execute(low) is None
    assert min(watch.heights_m) == pytest.approx(low.position_m[2], abs=1e-3)


def test_hand_that_touches_the_wall_may_leave_it(walled):
    executor = begin(walled)
    assert executor.execute(RIGHT) is None
    assert executor.execute(keyframe((0.55, -0.02, 0.15), ignore_collisions=True)) is None
    assert touches_wall(walled)
    assert executor.execute(RIGHT) is None
    assert not touches_wall(walled)


@pytest.mark.parametrize("carries", [False, True])
def test_held_cube_is_lifted_over_what_the_hand_alone_clears(carries):
    """The fingertips pass 12 mm above the wall; the cube would pass at 2 mm."""
    env = make_env(((0.55, 0.2, 0.09), (0.2, 0.01, 0.09)))
    watch = Watch(env)
    executor = begin(watch)
    start, end = (0.55, 0.12, 0.202), (0.55, 0.28, 0.202)
    for each in grasp(env) if carries else []:
        assert executor.execute(each) is None
    assert executor.execute(keyframe(start, gripper_open=not carries)) is None
    watch.heights_m.clear()
    assert executor.execute(keyframe(end, gripper_open=not carries)) is None
    assert not watch.touched
    assert (max(watch.heights_m) > start[2] + 0.005) == carries
    env.close()


def plan_around_the_wall(env, executor) -> str:
    """Fingerprint of a plan that needs the sampling planner, from beside the wall."""
    beside = (-0.35, 0.1, 0.05, -2.3, 0.0, 2.4, 0.4, 0.04, 0.04)
    env.unwrapped.agent.robot.set_qpos(torch.tensor([beside]))
    plan = executor.plan(LEFT)
    assert isinstance(plan, Plan)
    return hashlib.sha256(plan.motion.tobytes()).hexdigest()


def test_hundredth_plan_is_the_first_of_a_fresh_process(walled):
    executor = begin(walled)
    for index in range(99):
        executor.plan(keyframe((0.45, 0.2 if index % 20 == 0 else -0.2, 0.2)))
    code = (
        "from test_motion_executor import *; env = make_env(WALL); "
        "print(plan_around_the_wall(env, begin(env)))"
    )
    fresh = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        check=True,
        env={**os.environ, "PYTHONPATH": os.pathsep.join([str(TESTS), str(TESTS.parents[1])])},
    )
    assert plan_around_the_wall(walled, executor) == fresh.stdout.strip()
