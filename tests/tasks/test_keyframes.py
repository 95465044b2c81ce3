"""Keyframe files: what is written is what is read, and nothing else is accepted."""

from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest

from sacil_tasks.errors import UsageError
from sacil_tasks.interface import MAX_KEYFRAMES, Keyframe, Observation
from sacil_tasks.keyframes import (
    Episode,
    KeyframeDemo,
    KeyframeFile,
    KeyframeMeta,
    copy_demo,
    create_tables,
    seal,
    write_demo,
    write_keyframes,
)

META = KeyframeMeta(
    task="pick_and_lift",
    env_id="sacil_tasks:SizedPickAndLift-v1",
    split="canon",
    partition="train",
    scene_set=0,
    suites={"slice": ["pick_and_lift", "push_buttons"]},
    code_version="0.1.0",
    demos_sha256="ab" * 32,
)


def make_demo(seed: int, keyframes: int = 3) -> KeyframeDemo:
    rng = np.random.default_rng(seed)
    return KeyframeDemo(
        episode=Episode(
            instruction=f"lift the small block {seed}",
            slots={"size": "small"},
            variation=seed % 3,
            template=1,
            scene_index=seed,
            env_seed=2**32 - 1 - seed,
            sizes_m=rng.random(3, dtype=np.float32),
        ),
        observations=[_observation(rng, step) for step in range(keyframes + 1)],
        keyframes=[_keyframe(rng) for _ in range(keyframes)],
        targets=rng.integers(3, size=keyframes).tolist(),
        candidate_in_base=rng.random((keyframes + 1, 3, 3), dtype=np.float32),
    )


def _observation(rng: np.random.Generator, step: int) -> Observation:
    return Observation(
        rgb=rng.integers(256, size=(4, 128, 128, 3), dtype=np.uint8),
        depth_mm=rng.integers(2000, size=(4, 128, 128), dtype=np.uint16),
        intrinsics=rng.random((4, 3, 3), dtype=np.float32),
        camera_in_base=rng.random((4, 4, 4), dtype=np.float32),
        tcp_in_base=rng.random(7, dtype=np.float32),
        gripper_open=bool(rng.integers(2)),
        step=step,
        max_steps=MAX_KEYFRAMES,
    )


def _keyframe(rng: np.random.Generator) -> Keyframe:
    return Keyframe(
        position_m=rng.random(3),
        quaternion_wxyz=rng.random(4),
        gripper_open=bool(rng.integers(2)),
        ignore_collisions=bool(rng.integers(2)),
    )


@pytest.fixture
def demos() -> list[KeyframeDemo]:
    return [make_demo(7, keyframes=3), make_demo(8, keyframes=3)]


@pytest.fixture
def path(tmp_path: Path, demos: list[KeyframeDemo]) -> Path:
    write_keyframes(tmp_path / "pick_and_lift.h5", demos, META)
    return tmp_path / "pick_and_lift.h5"


def test_observations_and_episodes_survive_a_round_trip(path, demos):
    with KeyframeFile.open(path) as file:
        assert file.meta == META
        assert file.first_rows == [0, 4]
        for episode, demo in zip(file.episodes, demos, strict=True):
            assert vars(episode) | {"sizes_m": None} == vars(demo.episode) | {"sizes_m": None}
            np.testing.assert_array_equal(episode.sizes_m, demo.episode.sizes_m)
        for row, expected in enumerate([*demos[0].observations, *demos[1].observations]):
            for name, value in vars(file.observation(row)).items():
                np.testing.assert_array_equal(value, getattr(expected, name), err_msg=name)


def test_labels_stand_beside_the_observation_they_follow(path, demos):
    with KeyframeFile.open(path) as file:
        columns = dict(file.columns())
        poses = columns["keyframe_in_base"]
        assert columns["next_index"].tolist() == [1, 2, 3, -1, 5, 6, 7, -1]
        assert columns["episode_id"].tolist() == [0, 0, 0, 0, 1, 1, 1, 1]
        assert np.isnan(poses[[3, 7]]).all()
        second = demos[1].keyframes[1]
        np.testing.assert_allclose(poses[5], [*second.position_m, *second.quaternion_wxyz], 1e-6)
        assert columns["keyframe_open"][5] == second.gripper_open
        assert columns["target_index"].tolist() == [
            *demos[0].targets,
            -1,
            *demos[1].targets,
            -1,
        ]


def test_merging_packed_demos_equals_writing_them_together(path, demos, tmp_path):
    parts = []
    for number, demo in enumerate(demos):
        parts.append(h5py.File(tmp_path / f"part{number}.h5", "w"))
        create_tables(parts[-1], episodes=1, demo_rows=4)
        write_demo(parts[-1], demo, episode_id=0, first_row=0)
    with h5py.File(tmp_path / "merged.h5", "w") as merged:
        create_tables(merged, episodes=2, demo_rows=4)
        first_row = 0
        for number, part in enumerate(parts):
            first_row += copy_demo(part, merged, episode=0, episode_id=number, first_row=first_row)
        seal(merged, META)
    with KeyframeFile.open(path) as whole, KeyframeFile.open(tmp_path / "merged.h5") as merged:
        assert merged.content_sha256 == whole.content_sha256


def test_the_content_hash_depends_on_every_pixel_and_word(tmp_path, demos):
    hashes = set()
    for number, change in enumerate([_nothing, _one_pixel, _one_word]):
        changed = [make_demo(7, keyframes=3), make_demo(8, keyframes=3)]
        change(changed[1])
        write_keyframes(tmp_path / f"{number}.h5", changed, META)
        with KeyframeFile.open(tmp_path / f"{number}.h5") as file:
            hashes.add(file.content_sha256)
    assert len(hashes) == 3


def _nothing(demo: KeyframeDemo) -> None:
    pass


def _one_pixel(demo: KeyframeDemo) -> None:
    demo.observations[2].rgb[3, 5, 5, 0] ^= 1


def _one_word(demo: KeyframeDemo) -> None:
    object.__setattr__(demo.episode, "instruction", "lift the large block")


def _truncate(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def _replace_by_text(path: Path) -> None:
    path.write_text("not HDF5")


def _edit(change: Callable[[h5py.File], None]) -> Callable[[Path], None]:
    def apply(path: Path) -> None:
        with h5py.File(path, "r+") as file:
            change(file)

    return apply


def _drop_column(file: h5py.File) -> None:
    del file["observations/tcp_in_base"]


def _group_for_column(file: h5py.File) -> None:
    del file["observations/step"]
    file.create_group("observations/step")


def _scalar_for_column(file: h5py.File) -> None:
    del file["observations/step"]
    file["observations/step"] = np.int32(1)


def _shorten_episodes(file: h5py.File) -> None:
    file["episodes/rows"][0] = 1


@pytest.mark.parametrize(
    ("damage", "complaint"),
    [
        (Path.unlink, "no keyframes at"),
        (_truncate, "truncated or not HDF5"),
        (_replace_by_text, "truncated or not HDF5"),
        (_edit(lambda file: file.attrs.clear()), "not a keyframe file"),
        (_edit(lambda file: file.attrs.modify("schema_version", 1)), "of schema version 1, not 2"),
        (_edit(_drop_column), "without observations/tcp_in_base"),
        (_edit(_shorten_episodes), "do not add up"),
        (_edit(lambda file: file.create_group("observations/more/x")), "observations/more, which"),
        (_edit(_group_for_column), "observations/step that is no table"),
        (_edit(_scalar_for_column), "of another shape"),
        (_edit(lambda file: file.attrs.create("suites", 5)), "damaged"),
        (_edit(lambda file: file.attrs.modify("suites", "[1]")), "damaged"),
        (_edit(lambda file: file.attrs.__delitem__("task")), "damaged"),
    ],
)
def test_damaged_and_foreign_files_are_named_in_one_sentence(path, damage, complaint):
    damage(path)
    with pytest.raises(UsageError, match=complaint) as caught:
        KeyframeFile.open(path)
    assert "gen_demos" in str(caught.value)


def test_flipped_bits_are_noticed_when_the_pixels_are_read(path):
    content = bytearray(path.read_bytes())
    with h5py.File(path) as file:
        offset = file["observations/depth_mm"].id.get_chunk_info(0).byte_offset
    content[offset + 1000] ^= 1
    path.write_bytes(bytes(content))
    with KeyframeFile.open(path) as file, pytest.raises(UsageError, match="damaged in 'depth_mm'"):
        dict(file.columns())


@pytest.mark.parametrize("place", ["observations/tcp_in_base", "episodes/scene_index"])
def test_a_value_that_was_changed_afterwards_is_noticed(path, place):
    with h5py.File(path, "r+") as file:
        file[place][0] += 1
    with KeyframeFile.open(path) as file, pytest.raises(UsageError, match="content hash"):
        dict(file.columns())


def test_a_place_that_cannot_be_written_is_a_usage_error(tmp_path, demos):
    (tmp_path / "x.h5" / "occupied").mkdir(parents=True)
    with pytest.raises(UsageError, match="cannot write"):
        write_keyframes(tmp_path / "x.h5", demos, META)
