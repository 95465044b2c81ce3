from collections import Counter
from dataclasses import fields, replace

import h5py
import numpy as np
import pytest
import synthetic
import torch

from baselines.agent import Recipe
from baselines.loader import Loader
from baselines.packed import PackedRows
from baselines.rotation import bins_to_quaternion
from baselines.samples import KeyframeSet, Sample, Shard, stream
from baselines.scene.augment import AugmentConfig
from baselines.scene.sight import Moment, ViewSight
from baselines.scene.views import base_from_cube
from baselines.text import SentenceTable, TextSpec, tidy
from sacil_tasks.errors import UsageError
from sacil_tasks.keyframes import IMAGE_COLUMNS, TABLES, arrays_sha256

TASKS = ("pick_and_lift", "pick_up_cup")
STILL = AugmentConfig(yaw_rad=0.0, translation_m=0.0)


@pytest.fixture(scope="module")
def keyframes(data):
    return KeyframeSet.load(data / "canon/train/keyframes", TASKS)


def loader(keyframes, *, seed=0, goal_sight=None, **recipe):
    sentences = {tidy(e.instruction) for shard in keyframes.shards for e in shard.episodes}
    rng = np.random.default_rng(0)
    table = {s: rng.normal(size=(len(s.split()), 8)).astype(np.float16) for s in sorted(sentences)}
    return Loader(
        keyframes,
        SentenceTable(TextSpec("fake", 8, 32, "0"), table),
        sight=ViewSight(16),
        recipe=Recipe(batch=6, **recipe),
        seed=seed,
        goal_sight=goal_sight,
    )


def tensors(batch):
    """All tensors of a batch but its goals, by name."""
    parts = [batch.inputs.scene, batch.inputs, batch.labels, batch]
    named = {f.name: getattr(part, f.name) for part in parts for f in fields(part)}
    return {n: t for n, t in named.items() if isinstance(t, torch.Tensor)}


def assert_same(first, second):
    assert all(torch.equal(t, tensors(second)[n]) for n, t in tensors(first).items())


def test_a_batch_is_a_function_of_seed_and_step(keyframes):
    assert_same(loader(keyframes, seed=3).batch(7), loader(keyframes, seed=3).batch(7))
    views = [
        loader(keyframes, seed=s).batch(n).inputs.scene.views for s, n in ((3, 7), (3, 8), (4, 7))
    ]
    assert not torch.equal(views[0], views[1])
    assert not torch.equal(views[0], views[2])


def test_goals_do_not_change_what_behaviour_cloning_sees(keyframes):
    plain, with_goals = loader(keyframes), loader(keyframes, goal_sight=ViewSight(16))
    for step in range(5):
        expected = plain.batch(step)
        assert expected.goal is None
        assert_same(expected, with_goals.batch(step))


def test_every_batch_tells_two_sizes_of_one_task_apart(keyframes):
    for step in range(200):
        samples = keyframes.draw(stream(0, step, "rows"), 2, None)
        assert len({keyframes.meaning(s) for s in samples}) > len({s.shard for s in samples})


def test_tasks_then_demos_are_drawn_uniformly(tmp_path):
    synthetic.write_file(tmp_path, "pick_and_lift", demos=3)
    synthetic.write_file(tmp_path, "pick_up_cup", demos=12)
    keyframes = KeyframeSet.load(tmp_path / "canon/train/keyframes", TASKS)
    drawn = [s for step in range(250) for s in keyframes.draw(stream(1, step, "rows"), 16, 0.5)]
    tasks = Counter(sample.shard for sample in drawn)
    demos = Counter((sample.shard, keyframes.episode(sample)) for sample in drawn)
    assert tasks[0] / len(drawn) == pytest.approx(0.5, abs=0.03)
    assert min(demos[0, e] for e in range(3)) > 0.8 * tasks[0] / 3
    assert min(demos[1, e] for e in range(12)) > 0.7 * tasks[1] / 12


@pytest.mark.parametrize(("share", "expected"), [(None, 1 / synthetic.KEYFRAMES), (0.5, 0.5)])
def test_keyframes_at_which_words_decide_have_the_share_asked_for(keyframes, share, expected):
    drawn = [s for step in range(250) for s in keyframes.draw(stream(2, step, "rows"), 16, share)]
    rows = Counter(
        s.row - keyframes.shards[s.shard].first_rows[keyframes.episode(s)] for s in drawn
    )
    assert rows[0] / len(drawn) == pytest.approx(expected, abs=0.03)
    assert rows[1] == pytest.approx(rows[2], rel=0.15), "later keyframes stay alike"


def test_each_choice_of_each_task_is_drawn_alike(keyframes):
    first, second = keyframes.shards
    targets = np.where(np.arange(len(second.columns["step"])) % 4 < 1, 1, 2)  # two choices a demo
    two = replace(second, columns=second.columns | {"target_index": targets})
    drawn = KeyframeSet([first, two]).draw(stream(3, 0, "rows"), 6000, 1.0)
    tally = Counter((s.shard, s.row % (synthetic.KEYFRAMES + 1)) for s in drawn)
    assert set(tally) == {(0, 0), (1, 0), (1, 1)}
    assert all(count / len(drawn) == pytest.approx(1 / 3, abs=0.03) for count in tally.values())


def test_words_decide_whenever_another_candidates_turn_comes(keyframes):
    columns = keyframes.shards[0].columns | {"target_index": np.array([1, 1, 2, -1, -1, 0, 0, -1])}
    shard = replace(keyframes.shards[0], columns=columns)
    assert shard.choices(0) == [0, 2]
    assert shard.choices(1) == [4, 5], "the first keyframe, though it serves no candidate"


def test_only_observations_with_a_keyframe_are_samples(keyframes):
    samples = keyframes.everything()
    assert len(samples) == len(TASKS) * 6 * synthetic.KEYFRAMES
    assert all(keyframes.shards[s.shard].columns["next_index"][s.row] >= 0 for s in samples)


def test_goal_is_the_next_observation(keyframes):
    batch = loader(keyframes, goal_sight=ViewSight(16), augment=STILL).batch(0)
    drawn = keyframes.draw(stream(0, 0, "rows"), 6, Recipe().choice_share)
    after = [Sample(s.shard, s.row + 1) for s in drawn]
    moments = [Moment(keyframes.shards[s.shard].observation(s.row)) for s in after]
    assert torch.equal(batch.goal.views, ViewSight(16).look(moments).views)


def test_goals_are_moved_by_their_own_draw(keyframes):
    fixed, moved = (
        loader(keyframes, goal_sight=ViewSight(16), **r) for r in ({"augment": STILL}, {})
    )
    assert not torch.equal(fixed.batch(0).goal.views, moved.batch(0).goal.views)


def test_labels_without_augmentation_are_the_commanded_keyframes(keyframes):
    samples = keyframes.everything()[:6]
    labels = loader(keyframes).plain(samples).labels
    asked = np.stack(
        [keyframes.shards[s.shard].columns["keyframe_in_base"][s.row] for s in samples]
    )
    np.testing.assert_allclose(base_from_cube(labels.position_in_cube), asked[:, :3], atol=1e-6)
    turn = bins_to_quaternion(labels.rotation_bins).numpy()
    np.testing.assert_allclose(np.abs((turn * asked[:, 3:]).sum(-1)), 1, atol=1e-6)
    assert labels.gripper_open.tolist() == [1, 0, 0] * 2
    assert labels.ignore_collisions.tolist() == [0, 1, 0] * 2


def test_label_and_cloud_move_together(keyframes):
    """A scene of one point at the label: wherever it is moved, it is drawn at the label."""
    seen = keyframes.shards[0].observation(0)
    columns = {name: column.copy() for name, column in keyframes.shards[0].columns.items()}
    depth_mm = np.zeros((len(columns["step"]), *seen.depth_mm.shape), seen.depth_mm.dtype)
    depth_mm[:, 0, 40, 80] = 700
    ray = np.linalg.inv(seen.intrinsics[0]) @ [80.5, 40.5, 1] * 0.7
    columns["keyframe_in_base"][:, :3] = (seen.camera_in_base[0] @ [*ray, 1])[:3]
    images = keyframes.shards[0].images | {"depth_mm": PackedRows(depth_mm)}
    scene = KeyframeSet([replace(keyframes.shards[0], columns=columns, images=images)])
    batch = loader(scene).batch(0)
    for views, label in zip(batch.inputs.scene.views, batch.labels.position_in_cube, strict=True):
        xyz = views[:, :3].permute(0, 2, 3, 1)[views[:, 3:6].sum(1) > 0]
        assert len(xyz) > 0
        torch.testing.assert_close(xyz, label.expand_as(xyz), atol=2e-3, rtol=0)


def test_time_runs_down_and_the_first_keyframe_is_marked(keyframes):
    batch = loader(keyframes).plain(keyframes.everything()[:3])
    assert batch.inputs.proprio[:, 1].tolist() == pytest.approx([1, 1 - 2 / 24, 1 - 4 / 24])
    assert batch.first.tolist() == [True, False, False]


def test_paraphrases_share_a_meaning_and_demos_a_trajectory(keyframes):
    batch = loader(keyframes).plain(keyframes.everything())
    by_demo = list(zip(batch.task.tolist(), batch.meaning.tolist(), strict=True))
    assert len(set(by_demo)) == len(set(batch.meaning.tolist())) == 6  # two tasks, three sizes
    assert len(set(batch.trajectory.tolist())) == 12


def test_images_come_out_of_memory_as_they_are_on_disk(keyframes):
    shard = keyframes.shards[0]
    with h5py.File(shard.path) as file:
        for name in IMAGE_COLUMNS:
            stored = file[f"observations/{name}"][:]
            rows = [shard.images[name][row] for row in range(len(stored))]
            np.testing.assert_array_equal(rows, stored)
            assert rows[0].dtype == stored.dtype


def test_a_missing_file_names_the_command_that_makes_it(tmp_path):
    with pytest.raises(UsageError, match="gen_demos --tasks pick_and_lift"):
        KeyframeSet.load(tmp_path, ["pick_and_lift"])


def test_a_file_of_another_task_is_refused(tmp_path):
    path = synthetic.write_file(tmp_path, "pick_up_cup", demos=2)
    path.rename(path.with_name("pick_and_lift.h5"))
    with pytest.raises(UsageError, match="keyframes of pick_up_cup, canon, train, not of pick_and"):
        KeyframeSet.load(path.parent, ["pick_and_lift"])


def test_a_file_of_another_partition_is_refused(tmp_path):
    path = synthetic.write_file(tmp_path, "pick_and_lift", demos=2)
    held_out = tmp_path / "canon/val/keyframes"
    held_out.mkdir(parents=True)
    path.rename(held_out / path.name)
    with pytest.raises(UsageError, match="canon, train, not of pick_and_lift, canon, val"):
        KeyframeSet.load(held_out, ["pick_and_lift"])


def test_a_draw_too_small_for_two_sizes_is_refused_instead_of_repeated_forever(keyframes):
    with pytest.raises(ValueError, match="at least 2"):
        keyframes.draw(stream(0, 0, "rows"), 1, None)


def test_demos_of_one_size_cannot_teach_size(tmp_path):
    synthetic.write_file(tmp_path, "pick_and_lift", demos=1)
    keyframes = KeyframeSet.load(tmp_path / "canon/train/keyframes", ["pick_and_lift"])
    with pytest.raises(UsageError, match="single size"):
        loader(keyframes).batch(0)


@pytest.mark.parametrize("damage", ["empty", "truncated", "foreign"])
def test_a_damaged_file_is_named(tmp_path, damage):
    path = synthetic.write_file(
        tmp_path, "pick_and_lift", demos=0 if damage == "without demos" else 2
    )
    if damage == "empty":
        path.write_bytes(b"")
    if damage == "truncated":
        path.write_bytes(path.read_bytes()[:5000])
    if damage == "foreign":
        h5py.File(path, "w").close()
    with pytest.raises(UsageError, match=r"pick_and_lift\.h5"):
        Shard.load(path)


def test_a_keyframe_outside_the_render_cube_is_refused(tmp_path):
    path = synthetic.write_file(tmp_path, "pick_and_lift", demos=2)
    with h5py.File(path, "r+") as file:
        file["observations/keyframe_in_base"][1, 1] = 0.5
        file.attrs["content_sha256"] = arrays_sha256(file, TABLES)
    with pytest.raises(UsageError, match="1 keyframes lie outside the cube"):
        Shard.load(path)
