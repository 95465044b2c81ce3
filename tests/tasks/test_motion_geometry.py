"""Kinematics and collision checks against SAPIEN's own poses and contacts."""

import coal
import numpy as np
import pinocchio as pin
import pytest
import torch
from motion_scene import WALL, make_env
from sapien import physx

from sacil_tasks.motion.bodies import base_in_world, gap_m, read_robot
from sacil_tasks.motion.collision import MARGIN_M, OPEN_M, CollisionWorld, MotionState
from sacil_tasks.motion.kinematics import HALF_TURN, HOME, PandaArm
from sacil_tasks.motion.planner import TimingConfig, timed
from sacil_tasks.motion.shapes import to_coal, to_se3

pytestmark = pytest.mark.sim

AWAY = pin.SE3(np.eye(3), np.array([0.0, 0.0, -5.0]))
OBLIQUE = pin.SE3(
    pin.Quaternion(0.2, 0.85, 0.35, -0.25).normalized().matrix(), np.array([0.5, 0.1, 0.25])
)


@pytest.fixture(scope="module")
def env():
    return make_env(WALL)


@pytest.fixture(scope="module")
def arm():
    return PandaArm()


@pytest.fixture(scope="module")
def world(arm, env):
    return CollisionWorld(arm, read_robot(env.unwrapped), env.unwrapped)


def put_arm(env, joints, finger_m=OPEN_M):
    env.unwrapped.agent.robot.set_qpos(
        torch.tensor(np.append(joints, [finger_m, finger_m]), dtype=torch.float32)[None]
    )


def state(env, world, joints, *, finger_m=OPEN_M, held=None, moved=None):
    """The scene as it is, but for the bodies in `moved` (name to pose)."""
    world_in_base = base_in_world(env.unwrapped).inverse()
    poses = [world_in_base * to_se3(body.entity.pose) for body in world.bodies]
    for name, pose in (moved or {}).items():
        poses[index_of(world, name)] = pose
    return MotionState(joints, finger_m, tuple(poses), held)


def down(arm):
    return arm.tcp_in_base(HOME).rotation


def random_joints(arm, count, seed=0):
    return np.random.default_rng(seed).uniform(arm.lower, arm.upper, size=(count, 7))


def index_of(world, name):
    return next(i for i, body in enumerate(world.bodies) if name in body.name)


def test_forward_kinematics_is_sapiens_tcp_pose(env, arm):
    for joints in random_joints(arm, 20):
        put_arm(env, joints)
        pose = to_se3(env.unwrapped.agent.tcp.pose.sp)
        expected = base_in_world(env.unwrapped).inverse() * pose
        np.testing.assert_allclose(arm.tcp_in_base(joints), expected, atol=1e-5)


@pytest.mark.parametrize("target", [OBLIQUE, OBLIQUE * HALF_TURN], ids=["literal", "half turn"])
def test_inverse_kinematics_meets_an_oblique_pose_within_limits(arm, target):
    solutions = arm.goals(target, HOME)
    assert solutions
    for joints in solutions:
        reached = arm.tcp_in_base(joints)
        errors = [pin.log6(reached.actInv(pose)).vector for pose in (target, target * HALF_TURN)]
        assert min(np.abs(error).max() for error in errors) < 1e-4
        assert (joints >= arm.lower).all()
        assert (joints <= arm.upper).all()


def test_inverse_kinematics_gives_up_beyond_reach(arm):
    far = pin.SE3(OBLIQUE.rotation, np.array([1.2, 0.0, 0.3]))
    assert arm.goals(far, HOME) == []
    assert arm.line(HOME, far) is None


def test_tool_line_is_straight(arm):
    start, path = arm.tcp_in_base(HOME).translation, arm.line(HOME, OBLIQUE)
    way = OBLIQUE.translation - start
    middles = (path[1:] + path[:-1]) / 2
    points = np.array([arm.tcp_in_base(joints).translation for joints in middles]) - start
    along = points @ way / (way @ way)
    assert np.linalg.norm(points - along[:, None] * way, axis=1).max() < 1e-3
    assert (np.diff(along) > 0).all()
    np.testing.assert_allclose(arm.tcp_in_base(path[-1]), OBLIQUE, atol=1e-4)


def wall_distance(env, joints):
    """Smallest separation PhysX reports between wall and arm; infinite without a contact."""
    put_arm(env, joints)
    env.unwrapped.scene.step()
    names = [
        ({body.entity.name for body in contact.bodies}, contact)
        for contact in env.unwrapped.scene.get_contacts()
    ]
    return min(
        (
            point.separation
            for pair, contact in names
            if any("wall" in name for name in pair) and any("panda" in name for name in pair)
            for point in contact.points
        ),
        default=np.inf,
    )


def test_checks_agree_with_sapiens_contacts(env, arm, world):
    """PhysX reports near misses too, so it knows when the arm touches and when it is clear."""
    beside_wall = arm.goals(pin.SE3(down(arm), np.array([0.55, 0.06, 0.3])), HOME)[0]
    answers = []
    for joints in np.random.default_rng(1).normal(beside_wall, 0.2, size=(200, 7)):
        joints = np.clip(joints, arm.lower, arm.upper)
        world.set_state(state(env, world, joints, moved={"table": AWAY, "cube": AWAY}))
        distance = wall_distance(env, joints)
        if distance < -1e-3 or distance > MARGIN_M + 1e-3:
            answers.append((world.is_free(joints), distance > 0))
    free, clear = np.array(answers).T
    assert 20 < clear.sum() < len(clear) - 20
    np.testing.assert_array_equal(free, clear)


@pytest.mark.parametrize("gap_m", [MARGIN_M - 1e-3, MARGIN_M + 1e-3])
def test_margin_below_the_fingers_is_ten_millimetres(env, arm, world, gap_m):
    """The fingertips end 9.5 mm below the tool centre; the table top lies at zero."""
    low = pin.SE3(down(arm), np.array([0.5, 0.2, 0.0095 + gap_m]))
    joints = arm.goals(low, HOME)[0]
    world.set_state(state(env, world, joints, moved={"cube": AWAY, "wall": AWAY}))
    assert world.is_free(joints) == (gap_m > MARGIN_M)


def test_arm_may_not_fold_into_itself(env, arm, world):
    folded = np.array([0.0, 1.5, 0.0, -3.0, 0.0, 0.0, 0.0])
    world.set_state(state(env, world, folded), ignore_obstacles=True)
    assert not world.is_free(folded)
    assert world.is_free(HOME)


def test_held_cube_is_part_of_the_hand(env, arm, world):
    """The wall ends at 0.4 m: fingertips may pass 12 mm above it, a cube between them may not."""
    cube = index_of(world, "cube")
    over = arm.goals(pin.SE3(down(arm), np.array([0.5, 0.0, 0.4 + 0.0095 + 0.012])), HOME)[0]
    world.set_state(state(env, world, HOME, finger_m=0.02, moved={"cube": AWAY}))
    assert world.is_free(over)
    in_hand = {"cube": arm.tcp_in_base(HOME)}
    world.set_state(state(env, world, HOME, finger_m=0.02, held=cube, moved=in_hand))
    assert world.is_free(HOME)
    assert not world.is_free(over)


@pytest.mark.parametrize(("shift_m", "between"), [(0.0, True), (0.03, False)])
def test_fingers_enclose_what_crosses_the_line_between_them(env, arm, world, shift_m, between):
    pose = arm.tcp_in_base(HOME) * pin.SE3(np.eye(3), np.array([shift_m, 0.0, 0.0]))
    found = world.body_between_fingers(state(env, world, HOME, moved={"cube": pose}))
    assert (found == index_of(world, "cube")) == between


def test_closed_fingers_enclose_nothing(env, arm, world):
    moved = {"cube": arm.tcp_in_base(HOME)}
    assert world.body_between_fingers(state(env, world, HOME, finger_m=0.0, moved=moved)) is None


@pytest.mark.parametrize("size_rad", [1e-7, 1e-3, 0.03, 0.3])
def test_timing_keeps_to_a_path_that_turns_back(size_rad):
    """Sharp corners bring the speed to zero, where toppra's own sampling has left the path."""
    generator = np.random.default_rng(5)
    for _ in range(40):
        path = HOME + size_rad * generator.normal(size=(4, 7))
        motion = timed(path, 20.0)
        np.testing.assert_allclose(motion[-1], path[-1], atol=1e-5)
        steps = np.abs(np.diff(np.concatenate([path[:1], motion]), axis=0))
        assert steps.max() <= TimingConfig().velocity_rad_s / 20.0 * 1.05
        low, high = path.min(axis=0) - 0.02, path.max(axis=0) + 0.02
        assert ((motion >= low) & (motion <= high)).all()


MATERIAL = physx.PhysxMaterial(0.5, 0.5, 0.0)


@pytest.mark.parametrize(
    ("shape", "extents_m"),
    [
        (physx.PhysxCollisionShapeBox((0.1, 0.2, 0.3), MATERIAL), (0.1, 0.2, 0.3)),
        (physx.PhysxCollisionShapeSphere(0.1, MATERIAL), (0.1, 0.1, 0.1)),
        (physx.PhysxCollisionShapeCapsule(0.1, 0.2, MATERIAL), (0.3, 0.1, 0.1)),
        (physx.PhysxCollisionShapeCylinder(0.1, 0.2, MATERIAL), (0.2, 0.1, 0.1)),
    ],
    ids=["box", "sphere", "capsule", "cylinder"],
)
def test_shapes_reach_as_far_along_each_axis_as_in_physx(shape, extents_m):
    radius = 1e-3
    gaps = [
        gap_m(to_coal(shape), (coal.Sphere(radius), pin.SE3(np.eye(3), axis))) for axis in np.eye(3)
    ]
    np.testing.assert_allclose(1.0 - radius - np.array(gaps), extents_m, atol=1e-4)
