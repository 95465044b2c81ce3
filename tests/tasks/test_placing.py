"""Places: what counts as put where it belongs, and what each way of missing it is called."""

from collections.abc import Iterator
from typing import Any, cast

import gymnasium as gym
import numpy as np
import pytest
import sapien

from sacil_tasks import fixtures
from sacil_tasks.catalog import env_id
from sacil_tasks.errors import UsageError
from sacil_tasks.outcomes import Outcome
from sacil_tasks.placing import PlacingEnv
from sacil_tasks.props import cup_height_m, pepper_height_m
from sacil_tasks.table import HOME_QPOS
from sacil_tasks.tasks.put_item_in_drawer import OPENING_M, PutItemInDrawerEnv

pytestmark = pytest.mark.sim

UPSIDE_DOWN = (0.0, 1.0, 0.0, 0.0)
UP = np.array([0.0, 0.0, 1.0])
DRAWERS = tuple(fixtures.HANDLE_HEIGHTS_M)


def _made(task: str) -> Iterator[PlacingEnv]:
    made = gym.make(env_id(task), obs_mode="none", render_backend="none")
    yield cast(PlacingEnv, made.unwrapped)
    made.close()


@pytest.fixture(scope="module")
def cups() -> Iterator[PlacingEnv]:
    yield from _made("place_cups")


@pytest.fixture(scope="module")
def peppers() -> Iterator[PlacingEnv]:
    yield from _made("take_off_peppers")


@pytest.fixture(scope="module")
def items() -> Iterator[PlacingEnv]:
    yield from _made("put_items_in_drawer")


def _hold(env: PlacingEnv, steps: int) -> None:
    for _ in range(steps):
        env.step(np.array([*HOME_QPOS[:7], 1.0], dtype=np.float32))


def _put(env: PlacingEnv, k: int, in_fixture_m: np.ndarray, quaternion: Any = (1, 0, 0, 0)) -> None:
    """Handle a candidate as a hand would and leave it at a point of the fixture's frame."""
    handled = env.events.handle_order == -1
    handled[0, k] = True
    env.events.handle(handled)
    turn = sapien.Pose(q=env.fixture.pose.q[0].numpy())
    env.candidates[k].set_pose(
        sapien.Pose(env._on_fixture(in_fixture_m), (turn * sapien.Pose(q=quaternion)).q)  # noqa: SLF001
    )


def _settled(env: PlacingEnv) -> Outcome:
    _hold(env, 10)
    return env.outcome()


def _third(env: PlacingEnv) -> int:
    return ({0, 1, 2} - set(env.target_order())).pop()


def _over_peg(env: PlacingEnv, k: int, peg: int, shift_m: float = 0.0) -> np.ndarray:
    height_m = cup_height_m(float(env.sizes_m[k]))
    height_m = fixtures.PLATE_TOP_M + height_m / 2
    return np.array([fixtures.PEGS_M[peg] + shift_m, 0.0, height_m + 1e-4])


def test_cups_upside_down_over_pegs_in_order_are_placed(cups: PlacingEnv) -> None:
    for order, code in (((0, 1), "SUCCESS"), ((1, 0), "ORDER_ERROR")):
        cups.reset(seed=3)
        for peg, position in enumerate(order):
            k = cups.target_order()[position]
            _put(cups, k, _over_peg(cups, k, peg), UPSIDE_DOWN)
        assert _settled(cups).code == code
        assert len(cups.outcome().placed) == 2


def test_a_cup_beside_its_peg_or_upright_is_not_placed(cups: PlacingEnv) -> None:
    cups.reset(seed=3)
    first, second = cups.target_order()
    beside_m = float(cups.sizes_m[first]) / 2 + 0.01
    _put(cups, first, _over_peg(cups, first, 2, -beside_m), UPSIDE_DOWN)
    _put(cups, second, _over_peg(cups, second, 0) + UP * 0.033)
    assert not _settled(cups).placed
    assert cups.outcome().code == "MOTOR_FAIL"


def test_an_unnamed_cup_on_a_peg_spoils_it(cups: PlacingEnv) -> None:
    cups.reset(seed=3)
    for peg, k in enumerate((*cups.target_order(), _third(cups))):
        _put(cups, k, _over_peg(cups, k, peg), UPSIDE_DOWN)
    assert not _settled(cups).success_lenient
    assert cups.outcome().code == "SIZE_CONFUSION"


def _beside_pan(env: PlacingEnv, k: int, y_m: float) -> np.ndarray:
    return np.array([0.0, y_m, pepper_height_m(float(env.sizes_m[k])) / 2 + 1e-4])


def test_peppers_count_on_the_table_but_neither_on_the_pan_nor_below(peppers: PlacingEnv) -> None:
    peppers.reset(seed=3)
    first, second = peppers.target_order()
    ahead = -0.3 if np.cos(peppers._fixture_yaw()) < 0 else 0.3  # noqa: SLF001
    assert not peppers.outcome().placed
    _put(peppers, first, _beside_pan(peppers, first, ahead))
    _put(peppers, second, _beside_pan(peppers, second, ahead) - UP * 0.2)
    assert peppers._receptacles()[0].tolist().count(0) == 1  # noqa: SLF001
    _put(peppers, second, _beside_pan(peppers, second, 1.5 * ahead))
    assert _settled(peppers).code == "SUCCESS"
    _put(peppers, _third(peppers), _beside_pan(peppers, _third(peppers), 2 * ahead))
    assert _settled(peppers).code == "SIZE_CONFUSION"


def _open(env: PlacingEnv, *names: str) -> None:
    """Open drawers at once, so that only what is done with the items matters."""
    env.fixture.set_qpos(np.array([[OPENING_M * (name in names) for name in DRAWERS]]))
    _hold(env, 1)


def _in_drawer(env: PlacingEnv, k: int, name: str, beside_m: float) -> np.ndarray:
    height_m = fixtures.HANDLE_HEIGHTS_M[name] + fixtures.DRAWER_FLOOR_M
    return np.array([OPENING_M - 0.062, beside_m, height_m + float(env.sizes_m[k]) / 2 + 1e-4])


@pytest.mark.parametrize("named", DRAWERS)
@pytest.mark.parametrize("used", DRAWERS)
def test_the_named_drawer_and_order_decide(items: PlacingEnv, named: str, used: str) -> None:
    slots = {"first": "small", "second": "large", "drawer": named}
    for order in ((0, 1), (1, 0)):
        items.reset(seed=3, options={"slots": slots})
        _open(items, used)
        for position, beside_m in zip(order, (-0.055, 0.055), strict=True):
            k = items.target_order()[position]
            _put(items, k, _in_drawer(items, k, used, beside_m))
        right = "SUCCESS" if used == named else "RECEPTACLE_ERROR"
        assert _settled(items).code == (right if order == (0, 1) else "ORDER_ERROR")


def test_opening_a_wrong_drawer_is_remembered(items: PlacingEnv) -> None:
    items.reset(seed=3, options={"slots": {"first": "small", "second": "large", "drawer": "top"}})
    _open(items, "middle")
    _open(items)
    assert items.outcome().wrong_receptacle
    kept = items.get_state_dict()
    items.reset(seed=4)
    assert not items.outcome().wrong_receptacle
    items.set_state_dict(kept)
    assert items.outcome().wrong_receptacle


def test_drawers_stay_as_they_are_left(items: PlacingEnv) -> None:
    items.reset(seed=3)
    opened = [0.0, 0.1, OPENING_M]
    items.fixture.set_qpos(np.array([opened]))
    _hold(items, 40)
    assert items.fixture.qpos[0].tolist() == pytest.approx(opened, abs=1e-3)


@pytest.mark.parametrize("named", DRAWERS)
def test_the_named_drawer_can_be_open_from_the_start(items: PlacingEnv, named: str) -> None:
    slots = {"first": "small", "second": "large", "drawer": named}
    for wanted in (True, False):
        items.reset(seed=3, options={"slots": slots, "drawer_open": wanted})
        opened = [OPENING_M * (wanted and name == named) for name in DRAWERS]
        assert items.fixture.qpos[0].tolist() == pytest.approx(opened, abs=1e-6)


def test_a_drawer_is_open_or_not(items: PlacingEnv) -> None:
    with pytest.raises(UsageError, match="True or False"):
        items.reset(seed=3, options={"drawer_open": "no"})


def test_only_fingers_on_candidates_and_the_named_handle_are_clean(items: PlacingEnv) -> None:
    assert isinstance(items, PutItemInDrawerEnv)
    items.reset(seed=3)
    tcp = items.agent.tcp_pose.sp
    items.candidates[0].set_pose(tcp)
    for _ in range(5):
        items.step(np.array([*HOME_QPOS[:7], -1.0], dtype=np.float32))
    assert items.events.grasped[0, 0]
    assert not items.contacts.forces_n
    items.candidates[1].set_pose(sapien.Pose(tcp.p + UP * 0.05))
    _hold(items, 1)
    touched = {link for link, thing in items.contacts.forces_n if "candidate_1" in thing}
    assert "panda_hand" in touched
    assert items.outcome().robot_contact_n > 0
    items.reset(seed=3)
    assert not items.outcome().robot_contact_n
