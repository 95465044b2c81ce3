"""Writing and naming artefacts: atomic writes, one writer at a time, hashes, versions."""

import fcntl
import hashlib
import json
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, Literal

import h5py

from sacil_tasks.errors import UsageError


@contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """Yield a draft beside `path`; it takes the name `path` only if the block succeeds.

    Raises:
        UsageError: the folder cannot be written or the disk is full.
    """
    draft = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield draft
        draft.replace(path)
    except OSError as error:
        raise unwritable(path, error) from error
    finally:
        with suppress(OSError):  # the folder itself may be what is wrong
            draft.unlink(missing_ok=True)


@contextmanager
def atomic_hdf5(path: Path, mode: Literal["w", "r+"] = "w") -> Iterator[h5py.File]:
    """Yield an HDF5 file in memory, new or as it is on disk; written only if the block succeeds.

    A disk that fills up under an open file would crash HDF5, and the process with it.

    Raises:
        UsageError: the folder cannot be written or the disk is full.
    """
    with atomic_path(path) as draft:
        # The chunk index of before 1.10 takes 2 KB a dataset, more than most states of a demo.
        with h5py.File(
            path, mode, driver="core", backing_store=False, libver=("v110", "v110")
        ) as file:
            yield file
            file.flush()
            image = file.id.get_file_image()
        draft.write_bytes(image)


def whole_lines(content: bytes, opening: bytes) -> bytes:
    """A log's content less a last line that a kill cut off; every line starts with `opening`.

    Raises:
        ValueError: what stands after the last newline is not the beginning of such a line.
    """
    end = content.rfind(b"\n") + 1
    cut = content[end:]
    if cut[: len(opening)] != opening[: len(cut)]:
        raise ValueError("its last line is not of this command")
    return content[:end]


def unwritable(path: Path, error: OSError) -> UsageError:
    """The sentence for a file that could not be written."""
    return UsageError(
        f"cannot write {path}: {error.strerror or error}. "
        "Free some space or choose another folder with --out."
    )


@contextmanager
def sole_writer(folder: Path) -> Iterator[None]:
    """Make `folder` and hold it until the block ends; the lock leaves no file and dies with us.

    Raises:
        UsageError: another process holds it, or it cannot be made.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        handle = os.open(folder, os.O_RDONLY)
    except OSError as error:
        raise unwritable(folder, error) from error
    try:
        _lock(handle, folder)
        yield
    finally:
        os.close(handle)


def _lock(handle: int, folder: Path) -> None:
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        raise UsageError(
            f"another run is writing in {folder}. Wait for it or choose another folder with --out."
        ) from error


def write_json(path: Path, content: Any) -> None:
    """Write JSON atomically, keys in the order given."""
    with atomic_path(path) as draft:
        draft.write_text(json.dumps(content, indent=2) + "\n")


def code_version() -> str:
    """Version of this project, stored in every artefact."""
    return package_version("sacil") or "uninstalled"


def package_version(package: str) -> str | None:
    """Version of an installed package, without importing it."""
    try:
        return version(package)
    except PackageNotFoundError:
        return None


def file_sha256(path: Path) -> str:
    """SHA-256 of a file's bytes, in hex."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def content_hash(content: Any) -> str:
    """SHA-256 of the canonical JSON of `content`, in hex."""
    canonical = json.dumps(content, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(canonical.encode()).hexdigest()
