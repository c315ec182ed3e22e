"""Checkpoints: one file each, whole or not there at all, without pickle; the last two are kept."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import safetensors
import safetensors.numpy
from numpy.typing import NDArray

from shepherd_phys.files import whole_file

Array = NDArray[Any]

KEPT = 2
NAME = re.compile(r"checkpoint-(\d{6,})\.safetensors")


class CheckpointError(RuntimeError):
    """A checkpoint cannot be written or read; the message names it."""


@dataclass(frozen=True)
class Checkpoint:
    """The state of a run at the end of an interval."""

    number: int
    """Counts from 1; the worlds that follow it are those of restart ``number``."""
    arrays: Mapping[str, Array]
    facts: Mapping[str, Any]
    """Plain data: counters."""


def save(folder: Path, checkpoint: Checkpoint) -> Path:
    """Write a checkpoint: to a temporary file, to the disk, then under its name. Older ones but one are removed.

    Raises:
        CheckpointError: it cannot be written; the earlier ones are untouched.
    """
    path = folder / f"checkpoint-{checkpoint.number:06d}.safetensors"
    arrays = {name: np.ascontiguousarray(array) for name, array in checkpoint.arrays.items()}
    table = {"number": checkpoint.number, "facts": dict(checkpoint.facts)}
    try:
        table["checksum"] = _checksum(arrays, table)
        blob = safetensors.numpy.save(arrays, metadata={"checkpoint": json.dumps(table, allow_nan=False)})
        folder.mkdir(parents=True, exist_ok=True)
        with whole_file(path) as part:
            part.write_bytes(blob)
        for _, old in _numbered(folder)[:-KEPT]:
            old.unlink()
    except OSError as error:
        raise CheckpointError(f"{path}: cannot be written ({error.strerror})") from None
    except (TypeError, ValueError) as error:  # facts that JSON does not know
        raise CheckpointError(f"{path}: cannot be written ({error})") from None
    return path


def load_latest(folder: Path, before: int | None = None) -> Checkpoint | None:
    """The newest checkpoint that is whole; None where there is none.

    Args:
        folder: of the checkpoints.
        before: number of the first that is too new; None: none is.

    Raises:
        CheckpointError: there are some, and none can be read.
    """
    problem: CheckpointError | None = None
    for number, path in reversed(_numbered(folder)):
        if before is not None and number >= before:
            continue
        try:
            return load(path)
        except CheckpointError as error:
            problem = problem or error
    if problem is not None:
        raise problem
    return None


def any_in(folder: Path) -> bool:
    """Whether a folder holds checkpoints, readable or not."""
    return bool(_numbered(folder))


def load(path: Path) -> Checkpoint:
    """Read one checkpoint.

    Raises:
        CheckpointError: it is missing or damaged.
    """
    try:
        with safetensors.safe_open(path, framework="np") as file:
            table = json.loads((file.metadata() or {})["checkpoint"])
            arrays = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (it is no mapping)
        number, facts = int(table["number"]), dict(table["facts"])
        digest = table.pop("checksum")
    except OSError as error:
        raise CheckpointError(f"{path}: cannot be read ({error})") from None
    except (safetensors.SafetensorError, KeyError, TypeError, ValueError) as error:
        raise CheckpointError(f"{path}: is not a checkpoint ({' '.join(str(error).split())})") from None
    if digest != _checksum(arrays, table):
        raise CheckpointError(f"{path}: is damaged (its checksum is wrong)")
    return Checkpoint(number, arrays, facts)


def _numbered(folder: Path) -> list[tuple[int, Path]]:
    """The checkpoints in a folder with their numbers, oldest first."""
    if not folder.is_dir():
        return []
    return sorted((int(match[1]), path) for path in folder.iterdir() if (match := NAME.fullmatch(path.name)))


def _checksum(arrays: Mapping[str, Array], table: Mapping[str, Any]) -> str:
    """SHA-256 of the arrays and of what is told beside them."""
    total = hashlib.sha256(f"{json.dumps(table, sort_keys=True)}\n".encode())
    for name in sorted(arrays):
        total.update(f"{name} {arrays[name].dtype} {arrays[name].shape}\n".encode())
        total.update(np.ascontiguousarray(arrays[name]).tobytes())
    return total.hexdigest()
