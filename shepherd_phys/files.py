"""Files that appear whole or not at all."""

from __future__ import annotations

import errno
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path


def checked_place(path: Path, what: str) -> None:
    """Whether a file can be put there; to be asked before there is something to lose.

    Raises:
        OSError: there is no such folder, it lets nobody write, or a folder is in the file's place; names what it is.
    """
    if not path.resolve().parent.is_dir():
        raise FileNotFoundError(errno.ENOENT, f"{what} cannot be written: no such folder", str(path.parent))
    if path.is_dir():
        raise IsADirectoryError(errno.EISDIR, f"{what} cannot be written: a folder is in its place", str(path))
    if not os.access(path.resolve().parent, os.W_OK | os.X_OK):
        raise PermissionError(errno.EACCES, f"{what} cannot be written: its folder is closed", str(path.parent))


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
