"""`write_film`: pictures to an .mp4 or .gif file, picture by picture, the file whole or not at all.

Needs moviepy (``pip install "shepherd-phys[film]"``), imported when a film is written.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shepherd_phys.files import checked_place, whole_file

Picture = NDArray[np.uint8]
ENDINGS = (".mp4", ".gif")
MAX_GIF_FPS = 50
"""A GIF counts in hundredths of a second, and players slow down those that ask for 1 / 100 s."""


def checked_film(path: Path, fps: float) -> None:
    """Whether a film can be written there; to be asked before there is something to lose.

    Raises:
        ValueError: another ending than .mp4 or .gif; a number of pictures a second that it cannot have.
        OSError: no file can be put there.
        ImportError: moviepy is missing; says how to install it.
    """
    if path.suffix.lower() not in ENDINGS:
        raise ValueError(f"{path}: a film ends in {' or '.join(ENDINGS)} (given: {path.suffix or 'no ending'!r})")
    most = MAX_GIF_FPS if path.suffix.lower() == ".gif" else 240
    if not 1 <= fps <= most:
        raise ValueError(f"fps: must be from 1 to {most} for {path.suffix.lower()} (given: {fps!r})")
    checked_place(path, "film")
    _moviepy()


def write_film(pictures: Iterable[Picture], path: str | Path, fps: float) -> int:
    """Write a film; it takes the name ``path`` when it is complete.

    Args:
        pictures: uint8 (h, w, 3), all of one size; an .mp4 leaves out an odd last row or column.
        path: ends in .mp4 (H.264, plays everywhere) or .gif.
        fps: pictures a second.

    Returns:
        how many pictures it has.

    Raises:
        ValueError: there is no picture, or as `checked_film`.
        OSError: the file cannot be written.
        ImportError: moviepy is missing.
    """
    path = Path(path)
    checked_film(path, fps)
    todo = iter(pictures)
    first = next(todo, None)
    if first is None:
        raise ValueError(f"{path}: a film needs at least one picture")
    write = _write_gif if path.suffix.lower() == ".gif" else _write_mp4
    with whole_file(path) as part:
        return write(itertools.chain([first], todo), part, fps)


def _moviepy() -> Any:
    try:
        from moviepy.video.io import ffmpeg_writer
    except ImportError as error:
        raise ImportError('films need moviepy: pip install "shepherd-phys[film]"') from error
    return ffmpeg_writer


def _write_mp4(pictures: Iterator[Picture], part: Path, fps: float) -> int:
    part.touch()  # or ffmpeg says in many lines that it cannot
    writer: Any = None
    count = 0
    try:
        for picture in pictures:
            h, w = (side // 2 * 2 for side in picture.shape[:2])  # of 4:2:0 pixels
            if writer is None:
                # the name has another ending until it is whole, and 4:2:0 is what every player knows
                options = ["-f", "mp4", "-movflags", "+faststart", "-crf", "18"]
                writer = _moviepy().FFMPEG_VideoWriter(str(part), (w, h), fps, ffmpeg_params=options)
            writer.write_frame(np.ascontiguousarray(picture[:h, :w]))
            count += 1
    finally:
        if writer is not None:
            writer.close()
    return count


def _write_gif(pictures: Iterator[Picture], part: Path, fps: float) -> int:
    from PIL import Image

    count = 0

    def drawn() -> Iterator[Image.Image]:
        nonlocal count
        for picture in pictures:
            frame = Image.fromarray(picture).quantize(128, method=Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE)
            # in whole hundredths of a second, and yet as long in sum as it should be
            frame.info["duration"] = 10 * (round(100 * (count + 1) / fps) - round(100 * count / fps))
            count += 1
            yield frame

    frames = drawn()
    first = next(frames)
    with part.open("wb") as file:
        first.save(file, format="GIF", save_all=True, append_images=frames, loop=0)
    return count
