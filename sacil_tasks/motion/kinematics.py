"""Kinematics of the Panda: forward, inverse, and straight lines of the tool centre point.

The model is ManiSkill's own URDF, so that its frames are the simulator's. Poses are
`pinocchio.SE3` of the link `panda_hand_tcp` in the robot base frame; joints are the seven arm
angles in radians.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import pinocchio as pin
from jaxtyping import Float64
from mani_skill import PACKAGE_ASSET_DIR
from scipy.linalg.lapack import dposv

Joints = Float64[np.ndarray, "7"]
JointPath = Float64[np.ndarray, "n 7"]
"""Joint waypoints; what lies between two of them is a straight joint segment."""

URDF = f"{PACKAGE_ASSET_DIR}/robots/panda/panda_v2.urdf"
SRDF = f"{PACKAGE_ASSET_DIR}/robots/panda/panda_v2.srdf"
TCP_LINK = "panda_hand_tcp"
ARM_JOINTS = 7
HOME = np.array([0.0, 0.0, 0.0, -1.5, 0.0, 1.5, np.pi / 4])
"""The hand points straight down, 0.55 m above the table; the null space is pulled here."""

HALF_TURN = pin.SE3(pin.utils.rotate("z", np.pi), np.zeros(3))
"""About the tool axis: the gripper is symmetric, so both poses grasp alike."""


@dataclass(frozen=True, kw_only=True)
class IkConfig:
    """Damped least squares."""

    iterations: int = 20
    """Newton steps before a seed is given up."""

    tolerance: float = 1e-5
    """Largest norm of the pose error (metres and radians together)."""

    damping: float = 1e-3
    """Added to the diagonal of J J^T: keeps steps finite near singular poses."""

    home_pull: float = 0.1
    """Share of the way to `HOME` taken in the null space by the first step; halved at each next
    step, so that the last steps are Newton's own and converge quadratically."""

    random_seeds: int = 16
    """Starts around the present joints, beside these joints themselves and `HOME`."""

    seed_spread_rad: float = 0.5
    """Standard deviation of the random starts."""

    limit_margin_rad: float = 0.3
    """Solutions closer than this to a joint limit are tried later."""


@dataclass(frozen=True, kw_only=True)
class LineConfig:
    """Steps along a straight line of the tool centre point."""

    step_m: float = 0.02
    """Farthest the tool moves between two inverse kinematics; the joint segment between two
    such points leaves the line by less than 1 mm."""

    step_rad: float = 0.2
    """Farthest the tool turns between two inverse kinematics."""

    jump_rad: float = 0.5
    """A larger joint move within one step means that the solution has flipped."""

    iterations: int = 10
    """Newton steps per point; they start from the point before."""


class PandaArm:
    """Pinocchio model of the arm with hand; not safe to share between threads."""

    def __init__(self, ik: IkConfig | None = None, line: LineConfig | None = None) -> None:
        """Parse the robot description."""
        self.model = pin.buildModelFromUrdf(URDF)
        self.data = self.model.createData()
        self.lower: Joints = self.model.lowerPositionLimit[:ARM_JOINTS].copy()
        self.upper: Joints = self.model.upperPositionLimit[:ARM_JOINTS].copy()
        self._ik = ik or IkConfig()
        self._line = line or LineConfig()
        self._tcp = self.model.getFrameId(TCP_LINK)
        self._full = pin.neutral(self.model)

    def tcp_in_base(self, joints: Joints) -> pin.SE3:
        """Forward kinematics."""
        pin.framesForwardKinematics(self.model, self.data, self._with_fingers(joints))
        return self.data.oMf[self._tcp].copy()

    def inertia(self, joints: Joints) -> Float64[np.ndarray, "7 7"]:
        """Torque (N m) per joint acceleration (rad/s^2) at these joints, fingers closed."""
        upper = np.triu(pin.crba(self.model, self.data, self._with_fingers(joints)))
        return (upper + np.triu(upper, 1).T)[:ARM_JOINTS, :ARM_JOINTS]

    def solve(
        self, target: pin.SE3, start: Joints, *, iterations: int | None = None
    ) -> Joints | None:
        """Inverse kinematics from one start; None if it does not converge within the limits."""
        joints = start.copy()
        pull = self._ik.home_pull
        for _ in range(iterations or self._ik.iterations):
            error, jacobian = self._pose_error(target, joints)
            if error @ error < self._ik.tolerance**2:
                return joints
            step = self._step(error, jacobian, pull * (HOME - joints))
            joints = np.clip(joints + step, self.lower, self.upper)
            pull /= 2
        return None

    def goals(self, target: pin.SE3, start: Joints) -> list[Joints]:
        """Distinct solutions for the pose and its half turn, the most convenient first."""
        solutions: list[Joints] = []
        for seed in self._seeds(start):
            for pose in (target, target * HALF_TURN):
                found = self.solve(pose, seed)
                if found is not None and all(np.abs(found - old).max() > 0.05 for old in solutions):
                    solutions.append(found)
        return sorted(solutions, key=lambda joints: self._inconvenience(joints, start))

    def line(self, start: Joints, target: pin.SE3) -> JointPath | None:
        """Joint waypoints of the straight tool path to a pose; None where it cannot be followed."""
        waypoints = [start]
        for pose in self._poses_between(self.tcp_in_base(start), target):
            joints = self.solve(pose, waypoints[-1], iterations=self._line.iterations)
            if joints is None or np.abs(joints - waypoints[-1]).max() > self._line.jump_rad:
                return None
            waypoints.append(joints)
        return np.array(waypoints)

    def _with_fingers(self, joints: Joints) -> Float64[np.ndarray, "9"]:
        self._full[:ARM_JOINTS] = joints
        return self._full

    def _pose_error(
        self, target: pin.SE3, joints: Joints
    ) -> tuple[Float64[np.ndarray, "6"], Float64[np.ndarray, "6 7"]]:
        pin.computeJointJacobians(self.model, self.data, self._with_fingers(joints))
        placement = pin.updateFramePlacement(self.model, self.data, self._tcp)
        jacobian = pin.getFrameJacobian(self.model, self.data, self._tcp, pin.LOCAL)
        return pin.log6(placement.actInv(target)).vector, jacobian[:, :ARM_JOINTS]

    def _step(
        self,
        error: Float64[np.ndarray, "6"],
        jacobian: Float64[np.ndarray, "6 7"],
        pull: Joints,
    ) -> Joints:
        # J+ (e - J h) + h: the pull h to home only acts where it does not move the tool.
        gram = jacobian @ jacobian.T
        gram.flat[::7] += self._ik.damping**2
        _, weights, _ = dposv(gram, error - jacobian @ pull)
        return jacobian.T @ weights + pull

    def _seeds(self, start: Joints) -> Iterator[Joints]:
        yield start
        yield HOME
        # A generator of its own per call: a plan must not depend on the plans before it.
        generator = np.random.default_rng(0)
        for _ in range(self._ik.random_seeds):
            offset = generator.normal(scale=self._ik.seed_spread_rad, size=ARM_JOINTS)
            yield np.clip(start + offset, self.lower, self.upper)

    def _inconvenience(self, joints: Joints, start: Joints) -> float:
        room = np.minimum(joints - self.lower, self.upper - joints).min()
        penalty = 10 * max(0.0, self._ik.limit_margin_rad - room)
        return float(np.abs(joints - start).max() + penalty)

    def _poses_between(self, start: pin.SE3, target: pin.SE3) -> Iterator[pin.SE3]:
        turn = pin.log3(start.rotation.T @ target.rotation)
        shift = target.translation - start.translation
        steps = (
            np.linalg.norm(shift) / self._line.step_m,
            np.linalg.norm(turn) / self._line.step_rad,
        )
        count = max(1, int(np.ceil(max(steps))))
        for index in range(1, count):
            share = index / count
            rotation = start.rotation @ pin.exp3(share * turn)
            yield pin.SE3(rotation, start.translation + share * shift)
        yield target
