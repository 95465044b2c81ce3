import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from baselines.agent import Network, Recipe
from baselines.batch import Prediction
from baselines.loader import Loader
from baselines.rotation import bins_to_quaternion
from baselines.samples import KeyframeSet
from baselines.scene.sight import ViewSight
from baselines.scene.views import cube_from_base
from baselines.text import SentenceTable, TextSpec, tidy
from baselines.validate import ValidateConfig, grip_angle_deg, main, validate
from sacil_tasks.aim import REACH_M, nearest
from sacil_tasks.errors import UsageError


@pytest.fixture(scope="module")
def loader(data):
    keyframes = KeyframeSet.load(data / "canon/val/keyframes", ["pick_and_lift"])
    sentences = {tidy(e.instruction) for e in keyframes.shards[0].episodes}
    text = SentenceTable(TextSpec("fake", 4, 32, "0"), dict.fromkeys(sentences, np.ones((2, 4))))
    return Loader(keyframes, text, sight=ViewSight(16), recipe=Recipe(), seed=0)


class Cheat(Network):
    """Answers with the expert's keyframes, moved by `shift_m`."""

    def __init__(self, loader, shift_m=(0, 0, 0)):
        super().__init__()
        samples = loader.keyframes.everything()
        self.labels = loader.plain(samples).labels
        self.shift = torch.tensor(shift_m) * float(cube_from_base()[0, 0])
        self.seen = 0

    def act(self, inputs):
        rows = slice(self.seen, self.seen + len(inputs.scene.views))
        self.seen += len(inputs.scene.views)
        return Prediction(
            self.labels.position_in_cube[rows] + self.shift,
            bins_to_quaternion(self.labels.rotation_bins[rows]),
            self.labels.gripper_open[rows].bool(),
            self.labels.ignore_collisions[rows].bool(),
        )


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"tasks": ()}, "--tasks names none"),
        ({"tasks": ("pick_upcup",)}, "Did you mean pick_up_cup"),
        ({"split": "shift_upp"}, "Did you mean shift_up"),
        ({"tasks": ("pick_up_cup",), "split": "shift_up"}, "pick_up_cup has no split shift_up"),
    ],
)
def test_a_wrong_name_is_one_sentence(changes, sentence):
    with pytest.raises(UsageError, match=sentence):
        main(ValidateConfig(**changes))


@pytest.mark.parametrize("batch", [2, 16])
def test_the_expert_scores_full_marks(loader, batch):
    scores = validate(Cheat(loader), loader, batch=batch)
    assert scores["all"]["keyframes"] == 9
    assert scores["all"]["position_mm"] < 0.01
    assert scores["all"]["rotation_within_5deg"] == scores["all"]["gripper_right"] == 9
    assert scores["all"]["selected_by_words"] == (3, 3)
    assert scores["all"]["selected_by_hand"] == (6, 6)


def test_scores_are_split_by_task_and_size(loader):
    scores = validate(Cheat(loader), loader)
    sizes = {f"pick_and_lift/{size}" for size in ("small", "medium", "large")}
    assert set(scores) == {"all", "pick_and_lift", *sizes}
    assert sum(scores[name]["keyframes"] for name in sizes) == scores["all"]["keyframes"]


def test_reaching_for_a_neighbour_is_a_wrong_selection(loader):
    scores = validate(Cheat(loader, shift_m=(0.0, 0.2, 0.0)), loader)
    assert scores["all"]["position_mm"] == pytest.approx(200, abs=0.1)
    assert scores["all"]["selected_by_words"] == scores["all"]["selected_in_slot_1"] == (0, 3)


def test_choices_are_counted_by_slot_and_size(loader):
    scores = validate(Cheat(loader), loader)["all"]
    assert scores["selected_in_slot_1"] == (3, 3)
    assert scores["took_when_asked"] == {
        "small": [1, 0, 0],
        "medium": [0, 1, 0],
        "large": [0, 0, 1],
    }


def test_reaching_is_judged_from_above_within_a_radius():
    candidates = np.array([[0.5, 0.0, 0.02], [0.5, 0.1, 0.02]])
    assert nearest(candidates, np.array([0.5, 0.04, 0.4])) == 0
    assert nearest(candidates, np.array([0.5, 0.06, 0.4])) == 1
    assert nearest(candidates, np.array([0.5 + 1.01 * REACH_M, 0.0, 0.02])) is None


def test_grasps_half_a_turn_apart_are_one():
    rng = np.random.default_rng(0)
    for _ in range(20):
        start, turn = Rotation.random(rng=rng), rng.uniform(-85, 85)
        turned = start * Rotation.from_euler("z", turn, degrees=True)
        twin = turned * Rotation.from_euler("z", 180, degrees=True)
        first = start.as_quat(scalar_first=True)
        for other in (turned, twin):
            angle = grip_angle_deg(first, -other.as_quat(scalar_first=True))
            assert angle == pytest.approx(abs(turn), abs=1e-3)
