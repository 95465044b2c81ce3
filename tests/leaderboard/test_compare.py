"""Strips of keyframes and how far they are from the expert's."""

import dataclasses

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from leaderboard.compare import CompareConfig, cases_of, default_path, deviations, main
from leaderboard.deviation import ALIGNED_DEG, ALIGNED_MM, Deviation
from leaderboard.strip import EXTRA_COLUMNS, GREEN, RED, TILE_PIXELS, Camera, Course, Step, draw
from sacil_tasks.errors import UsageError
from sacil_tasks.interface import Keyframe

DOWN = np.array([0.0, 1.0, 0.0, 0.0])


def keyframe(position=(0.5, 0.0, 0.2), wxyz=DOWN, gripper_open=True) -> Keyframe:  # noqa: FBT002
    return Keyframe(np.array(position), np.asarray(wxyz, float), gripper_open, False)  # noqa: FBT003


def rotated(rotation: Rotation) -> Keyframe:
    return keyframe(wxyz=rotation.as_quat(scalar_first=True))


seeds = st.integers(0, 2**32 - 1)


@settings(deadline=None)
@given(seed=seeds)
def test_rotations_differ_by_scipys_angle_up_to_half_a_turn_of_the_gripper(seed):
    ours, theirs = Rotation.random(2, rng=np.random.default_rng(seed))
    twin = theirs * Rotation.from_euler("z", 180, degrees=True)
    truth = min((ours.inv() * it).magnitude() for it in (theirs, twin))
    found = Deviation.of(rotated(ours), rotated(theirs))
    assert found.rotation_deg == pytest.approx(np.rad2deg(truth), abs=1e-5)
    assert found.rotation_deg <= 180
    flipped = dataclasses.replace(rotated(ours), quaternion_wxyz=-rotated(ours).quaternion_wxyz)
    assert Deviation.of(flipped, rotated(twin)).rotation_deg == pytest.approx(
        found.rotation_deg, abs=1e-5
    )


def test_positions_differ_in_millimetres():
    found = Deviation.of(keyframe((0.5, 0.03, 0.2)), keyframe((0.5, 0.0, 0.24)))
    assert found.position_mm == pytest.approx(50)
    assert str(found) == "50 mm, 0 deg"


@pytest.mark.parametrize(
    ("found", "aligned"),
    [
        (Deviation(ALIGNED_MM, ALIGNED_DEG, same_gripper=True), True),
        (Deviation(ALIGNED_MM + 1, 0, same_gripper=True), False),
        (Deviation(0, ALIGNED_DEG + 1, same_gripper=True), False),
        (Deviation(0, 0, same_gripper=False), False),
    ],
)
def test_aligned_means_near_turned_alike_and_the_same_gripper(found, aligned):
    assert found.aligned is aligned


def above(height_m: float = 1.0, pixels: int = 64) -> Camera:
    """Straight above (0.5, 0), x of the base to the right of the image."""
    intrinsic = np.array([[pixels, 0, pixels / 2], [0, pixels, pixels / 2], [0, 0, 1.0]])
    rotation = np.diag([1.0, -1.0, -1.0])
    shift = -rotation @ [0.5, 0.0, height_m]
    return Camera(intrinsic, np.column_stack([rotation, shift]))


def test_a_camera_sees_points_where_they_are():
    camera = above(1.0, pixels=64)
    assert camera.pixel(np.array([0.5, 0.0, 0.0])) == (32, 32)
    assert camera.pixel(np.array([0.75, 0.25, 0.0])) == (48, 16)
    assert camera.pixel(np.array([0.75, 0.25, 0.5])) == (64, 0)
    assert camera.pixel(np.array([0.5, 0.0, 1.5])) is None


def course(*moved_m: float, refusal: str | None = None, expert: int = 2) -> Course:
    """Keyframes so far beside the expert's, on a black scene."""
    black = np.zeros((64, 64, 3), np.uint8)
    steps = [Step(keyframe((0.5 + moved, 0.0, 0.2)), None, black) for moved in moved_m]
    if refusal:
        steps[-1] = dataclasses.replace(steps[-1], refusal=refusal)
    return Course("toy", black, steps, [keyframe()] * expert, above())


def colours(picture: np.ndarray) -> set[tuple[int, ...]]:
    return set(map(tuple, np.unique(picture.reshape(-1, 3), axis=0).tolist()))


def test_alignment_is_green_and_deviation_red():
    assert GREEN in colours(draw("words", [course(0.0)]))
    assert RED not in colours(draw("words", [course(0.0)]))
    assert RED in colours(draw("words", [course(0.1)]))
    assert RED in colours(draw("words", [course(0.0, refusal="no_path")]))


def test_a_picture_has_a_row_for_each_agent_and_a_column_for_each_keyframe():
    one = draw("words", [course(0.0, 0.0)])
    two = draw("words", [course(0.0, 0.0), course(0.1)])
    assert one.shape[1] == two.shape[1] == 3 * TILE_PIXELS
    assert two.shape[0] > 1.9 * (one.shape[0] - 40)
    assert one.dtype == np.uint8


def test_a_long_episode_is_cut_off_and_says_so():
    picture = draw("words", [course(*[0.0] * 25)])
    assert picture.shape[1] == (1 + 2 + EXTRA_COLUMNS) * TILE_PIXELS


def test_deviations_are_printed_keyframe_by_keyframe():
    title, *lines = deviations([course(0.004, 0.1, 0.0, refusal="no_path")])
    assert title == "toy"
    assert lines[0].split() == ["keyframe", "1", "4", "mm,", "0", "deg", "aligned"]
    assert "100 mm" in lines[1]
    assert "DEVIATES" in lines[1]
    assert lines[2].endswith("refused: no_path")
    assert "beyond the expert's last" in lines[2]


def test_photographs_are_left_as_they_are():
    mine = course(0.1)
    draw("words", [mine])
    assert not mine.steps[0].photo.any()


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"agents": ("sacil", "rtv")}, "Did you mean rvt"),
        ({"agents": ()}, "names at least one"),
        ({"task": "pick_and_lft"}, "Did you mean pick_and_lift"),
        ({"split": "cannon"}, "Did you mean canon"),
        ({"task": "pick_up_cup", "split": "shift_up"}, "pick_up_cup has no split shift_up"),
        ({"variation": 3}, "--variation must be 0 to 2 for pick_and_lift, but 3 came"),
        ({"scene": -1}, "--scene starts at 0"),
        ({"workers": 0}, "--workers at 1"),
        ({"checkpoints": ("x",)}, "names 1 folders for 2 agents"),
    ],
)
def test_a_wrong_word_is_one_sentence_before_anything_starts(changes, sentence):
    with pytest.raises(UsageError, match=sentence):
        cases_of(CompareConfig(**changes))


def test_pictures_of_other_choices_have_other_names():
    configs = [
        CompareConfig(),
        CompareConfig(agents=("sacil:no_queries", "rvt")),
        CompareConfig(scene=1),
        CompareConfig(variation=1),
        CompareConfig(partition="test"),
        CompareConfig(seed=1),
    ]
    assert len({default_path(config) for config in configs}) == len(configs)


@pytest.mark.sim
def test_the_expert_does_not_deviate_from_itself(tmp_path, capsys):
    path = tmp_path / "strip.png"
    main(CompareConfig(agents=("oracle", "hold"), task="pick_and_lift", out=path))
    oracle, hold = capsys.readouterr().out.split("hold: ")
    assert oracle.count("0 mm, 0 deg") == oracle.count("aligned") == 4
    assert "SUCCESS, took" in oracle
    assert "NO_INTERACTION, took nothing" in hold
    assert "DEVIATES" in hold
    picture = cv2.imread(str(path))
    assert picture.shape[1] == (1 + 4 + EXTRA_COLUMNS) * TILE_PIXELS
    assert picture.std() > 10
