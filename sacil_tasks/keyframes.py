"""Demonstrations -> one keyframe file a task: what training reads, without a simulator.

A demo of K keyframes gives K+1 rows: the observation before each keyframe, labelled with the
keyframe the expert commanded there, and the last observation, which has no label. Rows of all
demos stand one after another in `observations/`, demos in `episodes/`. HDF5, no pickle.
"""

import hashlib
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import product
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import h5py
import numpy as np
from jaxtyping import Float32

from sacil_tasks.errors import UsageError
from sacil_tasks.files import atomic_hdf5
from sacil_tasks.interface import CAMERAS, IMAGE_PIXELS, MAX_KEYFRAMES, Keyframe, Observation
from sacil_tasks.typed import parsed

KIND = "sacil-keyframes"
SCHEMA_VERSION = 2
CANDIDATES = 3
NO_ROW = -1

_IMAGE = (len(CAMERAS), IMAGE_PIXELS, IMAGE_PIXELS)
_TEXT = h5py.string_dtype()

OBSERVATION_COLUMNS: Mapping[str, tuple[Any, tuple[int, ...]]] = {
    "rgb": (np.uint8, (*_IMAGE, 3)),
    "depth_mm": (np.uint16, _IMAGE),
    "intrinsics": (np.float32, (len(CAMERAS), 3, 3)),
    "camera_in_base": (np.float32, (len(CAMERAS), 4, 4)),
    "tcp_in_base": (np.float32, (7,)),
    "gripper_open": (np.bool_, ()),
    "step": (np.int32, ()),
    "episode_id": (np.int32, ()),
    "next_index": (np.int32, ()),
    "keyframe_in_base": (np.float32, (7,)),
    "keyframe_open": (np.bool_, ()),
    "keyframe_ignore_collisions": (np.bool_, ()),
    "target_index": (np.int32, ()),
    "candidate_in_base": (np.float32, (CANDIDATES, 3)),
}
"""Type and shape of one row of each dataset in `observations/`."""

EPISODE_COLUMNS: Mapping[str, tuple[Any, tuple[int, ...]]] = {
    "instruction": (_TEXT, ()),
    "slots": (_TEXT, ()),
    "variation": (np.int32, ()),
    "template": (np.int32, ()),
    "scene_index": (np.int32, ()),
    "env_seed": (np.uint32, ()),
    "first_row": (np.int32, ()),
    "rows": (np.int32, ()),
    "sizes_m": (np.float32, (CANDIDATES,)),
}
"""Type and shape of one row of each dataset in `episodes/`."""

TABLES = ("observations", "episodes")
"""Groups of a file, and what its content hash is taken of."""

IMAGE_COLUMNS = ("rgb", "depth_mm")
"""Columns stored in compressed chunks of one demo, so that files are merged without unpacking."""

_BAND = 8
"""Image rows of a chunk. A chunk holds the same band of one camera's images throughout a demo: most
of it stands still, and the images are near enough to each other for gzip's 32 KiB of memory."""


@dataclass(frozen=True, kw_only=True)
class Episode:
    """The scene and the words of one demo."""

    instruction: str
    slots: Mapping[str, str]
    variation: int
    template: int
    scene_index: int
    env_seed: int
    sizes_m: Float32[np.ndarray, "3"]


@dataclass(frozen=True, kw_only=True)
class KeyframeDemo:
    """One demo: K+1 observations and the K keyframes between them."""

    episode: Episode
    observations: Sequence[Observation]
    keyframes: Sequence[Keyframe]
    targets: Sequence[int]
    """Candidate each keyframe serves (K); diagnosis only, no model may see it."""
    candidate_in_base: Float32[np.ndarray, "rows 3 3"]
    """Candidate positions in metres at each observation; diagnosis only."""


@dataclass(frozen=True, kw_only=True)
class KeyframeMeta:
    """What a keyframe file says about itself."""

    task: str
    env_id: str
    split: str
    partition: str
    scene_set: int
    suites: Mapping[str, Sequence[str]]
    """Suite -> its tasks, so that training can check that a suite is complete."""
    code_version: str
    demos_sha256: str
    """Content hash of the trajectory file of the same demos."""


def write_keyframes(path: Path, demos: Sequence[KeyframeDemo], meta: KeyframeMeta) -> None:
    """Write `demos`, at least one and all with as many keyframes, in the order given, atomically.

    Raises:
        UsageError: the folder cannot be written or the disk is full.
    """
    with atomic_hdf5(path) as file:
        create_tables(file, episodes=len(demos), demo_rows=len(demos[0].observations))
        first_row = 0
        for episode_id, demo in enumerate(demos):
            write_demo(file, demo, episode_id=episode_id, first_row=first_row)
            first_row += len(demo.observations)
        seal(file, meta)


def create_tables(group: h5py.Group, *, episodes: int, demo_rows: int) -> None:
    """Lay out empty `observations/` and `episodes/` datasets for demos of `demo_rows` rows each."""
    for name, (dtype, shape) in OBSERVATION_COLUMNS.items():
        packing = _packing(shape, demo_rows) if name in IMAGE_COLUMNS else {}
        group.create_dataset(
            f"observations/{name}", (episodes * demo_rows, *shape), dtype, **packing
        )
    for name, (dtype, shape) in EPISODE_COLUMNS.items():
        group.create_dataset(f"episodes/{name}", (episodes, *shape), dtype)


def _packing(shape: tuple[int, ...], demo_rows: int) -> dict[str, Any]:
    _, _, *rest = shape
    return {
        "chunks": (demo_rows, 1, _BAND, *rest),
        "compression": "gzip",
        "compression_opts": 6,
        "shuffle": True,
        # Checksums turn a damaged chunk into an error instead of wrong pixels.
        "fletcher32": True,
    }


def write_demo(group: h5py.Group, demo: KeyframeDemo, *, episode_id: int, first_row: int) -> None:
    """Fill the rows of one demo."""
    rows = slice(first_row, first_row + len(demo.observations))
    for name, column in _observation_columns(demo, episode_id, first_row).items():
        group[f"observations/{name}"][rows] = column
    for name, cell in _episode_cells(demo, first_row).items():
        group[f"episodes/{name}"][episode_id] = cell


def copy_demo(
    source: h5py.Group, target: h5py.Group, *, episode: int, episode_id: int, first_row: int
) -> int:
    """Copy demo `episode` of `source`, images still packed; return the number of its rows."""
    start, count = (int(source[f"episodes/{name}"][episode]) for name in ("first_row", "rows"))
    for name in OBSERVATION_COLUMNS:
        column, into = source[f"observations/{name}"], target[f"observations/{name}"]
        if name in IMAGE_COLUMNS:
            _copy_chunks(column, into, start, first_row)
        else:
            into[first_row : first_row + count] = column[start : start + count]
    last = first_row + count
    target["observations/episode_id"][first_row:last] = episode_id
    target["observations/next_index"][first_row:last] = _next_rows(first_row, count)
    for name in EPISODE_COLUMNS:
        target[f"episodes/{name}"][episode_id] = source[f"episodes/{name}"][episode]
    target["episodes/first_row"][episode_id] = first_row
    return count


def _copy_chunks(source: h5py.Dataset, target: h5py.Dataset, start: int, first_row: int) -> None:
    lengths = zip(source.shape[1:], source.chunks[1:], strict=True)
    for corner in product(*(range(0, length, step) for length, step in lengths)):
        mask, chunk = source.id.read_direct_chunk((start, *corner))
        target.id.write_direct_chunk((first_row, *corner), chunk, mask)


def _next_rows(first_row: int, count: int) -> list[int]:
    return [*range(first_row + 1, first_row + count), NO_ROW]


def seal(file: h5py.File, meta: KeyframeMeta) -> None:
    """Write the attributes that make `file` a keyframe file."""
    fields = asdict(meta) | {"suites": json.dumps({k: list(v) for k, v in meta.suites.items()})}
    file.attrs.update(fields)
    file.attrs["max_steps"] = MAX_KEYFRAMES
    file.attrs["kind"] = KIND
    file.attrs["schema_version"] = SCHEMA_VERSION
    file.attrs["content_sha256"] = arrays_sha256(file, TABLES)


def arrays_sha256(file: h5py.Group, groups: Sequence[str]) -> str:
    """SHA-256 over names, types, shapes and values of all datasets below `groups`, in hex."""
    digest = hashlib.sha256()
    for name, dataset in _sorted_datasets(file, groups):
        _absorb(digest, name, dataset, dataset[()])
    return digest.hexdigest()


def _absorb(digest: "hashlib._Hash", name: str, dataset: h5py.Dataset, values: np.ndarray) -> None:
    digest.update(f"{name} {dataset.dtype.kind} {dataset.shape}".encode())
    if dataset.dtype.kind == "O":
        digest.update(json.dumps([text.decode() for text in values]).encode())
    else:
        digest.update(np.ascontiguousarray(values).data)


def _sorted_datasets(file: h5py.Group, groups: Sequence[str]) -> list[tuple[str, h5py.Dataset]]:
    return sorted((name, dataset) for group in groups for name, dataset in _datasets(file[group]))


def _datasets(group: h5py.Group) -> Iterator[tuple[str, h5py.Dataset]]:
    for child in group.values():
        if isinstance(child, h5py.Dataset):
            yield child.name, child
        else:
            yield from _datasets(child)


def _observation_columns(
    demo: KeyframeDemo, episode_id: int, first_row: int
) -> dict[str, np.ndarray]:
    seen, asked = demo.observations, demo.keyframes
    count = len(seen)
    commanded = [np.r_[k.position_m, k.quaternion_wxyz] for k in asked]
    columns = {
        name: np.stack([getattr(observation, name) for observation in seen])
        for name in ("rgb", "depth_mm", "intrinsics", "camera_in_base", "tcp_in_base")
    }
    return columns | {
        "gripper_open": np.array([o.gripper_open for o in seen]),
        "step": np.array([o.step for o in seen]),
        "episode_id": np.full(count, episode_id),
        "next_index": np.array(_next_rows(first_row, count)),
        "keyframe_in_base": np.array([*commanded, np.full(7, np.nan)]),
        "keyframe_open": np.array([*(k.gripper_open for k in asked), False]),
        # D-collision: each keyframe's own label.
        "keyframe_ignore_collisions": np.array([*(k.ignore_collisions for k in asked), False]),
        "target_index": np.array([*demo.targets, NO_ROW]),
        "candidate_in_base": demo.candidate_in_base,
    }


def _episode_cells(demo: KeyframeDemo, first_row: int) -> dict[str, Any]:
    cells = {
        name: getattr(demo.episode, name) for name in EPISODE_COLUMNS if hasattr(demo.episode, name)
    }
    return cells | {
        "slots": json.dumps(dict(demo.episode.slots)),
        "first_row": first_row,
        "rows": len(demo.observations),
    }


class KeyframeFile:
    """A keyframe file open for reading, checked on opening; use it in a `with` block."""

    def __init__(self, path: Path, file: h5py.File) -> None:
        """Use `KeyframeFile.open`."""
        self.path = path
        self._file = file
        self.meta = _meta(file)
        self.content_sha256 = str(file.attrs["content_sha256"])
        self.rows = len(file["observations/step"])
        self.episodes = _episodes(file)
        self.first_rows: list[int] = file["episodes/first_row"][:].tolist()
        """Row of the first observation of each episode."""

    @classmethod
    def open(cls, path: Path) -> Self:
        """Open and check the layout; `columns` checks the content.

        Raises:
            UsageError: missing, truncated, foreign, or of another schema version.
        """
        if not path.is_file():
            raise UsageError(
                f"no keyframes at {path}. Make them with `python -m sacil_tasks.gen_demos`."
            )
        try:
            file = h5py.File(path, "r")
        except OSError as error:
            raise _unusable(path, "truncated or not HDF5") from error
        try:
            fault = _layout_fault(file)
            if fault is None:
                return cls(path, file)
        except (OSError, KeyError, ValueError, TypeError) as error:
            fault = f"damaged ({error})"
        file.close()
        raise _unusable(path, fault)

    def columns(self) -> Iterator[tuple[str, np.ndarray]]:
        """Names and all rows of the datasets in `observations/`, one after another.

        Raises:
            UsageError: stored chunks are damaged, or, after the last column, the file does not
                hold what its content hash says: somebody has changed it.
        """
        digest = hashlib.sha256()
        for place, dataset in _sorted_datasets(self._file, TABLES):
            _, table, name = place.split("/")
            try:
                rows = dataset[()]
            except OSError as error:
                raise _unusable(self.path, f"damaged in '{name}'") from error
            _absorb(digest, place, dataset, rows)
            if table == "observations":
                yield name, rows
        if digest.hexdigest() != self.content_sha256:
            raise _unusable(self.path, "not what its content hash says: it was changed afterwards")

    def observation(self, row: int) -> Observation:
        """The observation of one row, as a policy would have seen it."""
        table = self._file["observations"]
        return Observation(
            rgb=table["rgb"][row],
            depth_mm=table["depth_mm"][row],
            intrinsics=table["intrinsics"][row],
            camera_in_base=table["camera_in_base"][row],
            tcp_in_base=table["tcp_in_base"][row],
            gripper_open=bool(table["gripper_open"][row]),
            step=int(table["step"][row]),
            max_steps=int(self._file.attrs["max_steps"]),
        )

    def __enter__(self) -> Self:
        """Return itself."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Close the file."""
        self._file.close()


def _meta(file: h5py.File) -> KeyframeMeta:
    attrs = file.attrs
    texts = {
        name: str(attrs[name])
        for name in ("task", "env_id", "split", "partition", "code_version", "demos_sha256")
    }
    suites = parsed(Mapping[str, Sequence[str]], attrs["suites"])  # type: ignore[type-abstract]
    return KeyframeMeta(**texts, scene_set=int(attrs["scene_set"]), suites=suites)


def _episodes(file: h5py.File) -> list[Episode]:
    columns = {name: file[f"episodes/{name}"][:] for name in EPISODE_COLUMNS}
    return [
        Episode(
            instruction=columns["instruction"][i].decode(),
            slots=json.loads(columns["slots"][i]),
            variation=int(columns["variation"][i]),
            template=int(columns["template"][i]),
            scene_index=int(columns["scene_index"][i]),
            env_seed=int(columns["env_seed"][i]),
            sizes_m=columns["sizes_m"][i],
        )
        for i in range(len(columns["rows"]))
    ]


def _layout_fault(file: h5py.File) -> str | None:
    """What is wrong with the file's layout, or None."""
    if file.attrs.get("kind") != KIND:
        return "not a keyframe file"
    version = file.attrs.get("schema_version")
    if version != SCHEMA_VERSION:
        return f"of schema version {version}, not {SCHEMA_VERSION}"
    for table, columns in (("observations", OBSERVATION_COLUMNS), ("episodes", EPISODE_COLUMNS)):
        fault = _table_fault(file, table, columns)
        if fault:
            return fault
    if file["episodes/rows"][:].sum() != len(file["observations/step"]):
        return "inconsistent: its episodes do not add up to its rows"
    return None


def _table_fault(
    file: h5py.File, table: str, columns: Mapping[str, tuple[Any, tuple[int, ...]]]
) -> str | None:
    if strange := sorted(set(file.get(table, ())) - set(columns)):
        return f"with {table}/{strange[0]}, which no keyframe file has"
    lengths = set()
    for name, (dtype, shape) in columns.items():
        dataset = file.get(f"{table}/{name}")
        if dataset is None:
            return f"without {table}/{name}"
        if not isinstance(dataset, h5py.Dataset) or dataset.shape is None:
            return f"with {table}/{name} that is no table"
        if dataset.ndim != 1 + len(shape) or dataset.shape[1:] != shape or dataset.dtype != dtype:
            return f"with {table}/{name} of another shape or type"
        lengths.add(len(dataset))
    return f"with {table} of unequal lengths" if len(lengths) > 1 else None


def _unusable(path: Path, fault: str | None) -> UsageError:
    return UsageError(
        f"{path} is {fault}. Delete it and run `python -m sacil_tasks.gen_demos` again."
    )
