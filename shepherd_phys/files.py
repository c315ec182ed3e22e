"""Files that appear whole or not at all."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """A place beside ``path`` to write to; at the end that file takes the name ``path``, from an earlier one too.

    If the writing or the renaming fails, what was written is removed, and an earlier file stays as it was.

    Raises:
        OSError: the file cannot be put in its place.
    """
    part = path.with_name(path.name + ".part")
    try:
        yield part
        with part.open("rb+") as file:
            os.fsync(file.fileno())  # the name must never stand for a file that is not on the disk yet
        part.replace(path)
    finally:
        with suppress(OSError):
            part.unlink()
