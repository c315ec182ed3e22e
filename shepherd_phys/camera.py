"""Which part of the plane a picture shows: `Camera`; `fit`, the one that sees all; `Smooth`, one that follows."""

from __future__ import annotations

import math
import operator
from collections.abc import Iterable
from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike
from pydantic import BeforeValidator, Field

from shepherd_phys.obstacles import Point
from shepherd_phys.settings import Settings, settings
from shepherd_phys.state import Floats, WorldState

Size = tuple[int, int]
"""(w, h) [px]."""
MIN_SIZE, MAX_SIZE = 16, 8192
"""[px] of a picture's sides."""
MIN_VIEW = 8.0
"""[m]: the camera of `fit` comes no nearer."""


@settings
class Camera(Settings):
    """Which part of the plane a picture shows. Pixels count from its upper left corner, y down."""

    center: Annotated[Point, BeforeValidator(lambda at: at.tolist() if isinstance(at, np.ndarray) else at)]
    """World point in the middle of the picture [m]."""
    width: float = Field(gt=0)
    """From the left border to the right one [m]."""

    def to_pixels(self, points: ArrayLike, size: Size) -> Floats:
        """Where world points (.., 2) [m] lie in a picture of ``size`` (w, h): (.., 2) [px]."""
        w, h = size
        offsets = np.asarray(points, dtype=float) - self.center
        return np.asarray(offsets * (w / self.width, -w / self.width) + (w / 2, h / 2))

    def to_world(self, pixels: ArrayLike, size: Size) -> Floats:
        """Reverse `to_pixels`: (.., 2) [px] -> (.., 2) [m]."""
        w, h = size
        offsets = np.asarray(pixels, dtype=float) - (w / 2, h / 2)
        return np.asarray(offsets * (self.width / w, -self.width / w) + self.center)


def fit(
    state: WorldState, size: Size = (640, 640), *, trails: Iterable[ArrayLike] | None = None, margin: float = 0.06
) -> Camera:
    """Find the camera that sees all sheep, all shepherds, the goal and the trails.

    It moves as smoothly as they do. For a film, take it once, of the first state, and hand it to every `draw`.

    Args:
        state: what is to be seen.
        size: (w, h) of the picture [px].
        trails: as in `draw`.
        margin: free border on each side, as a fraction of the picture, 0 to below 0.5.

    Raises:
        ValueError: names the argument that is impossible.
    """
    if not 0 <= margin < 0.5:
        raise ValueError(f"margin: must be from 0 to below 0.5 (given: {margin!r})")
    return fitted(state, checked_size(size), checked_trails(trails, state), margin)


def fitted(state: WorldState, size: Size, trails: Floats, margin: float = 0.06) -> Camera:
    """`fit`, of arguments that have been checked."""
    points = np.concatenate([state.sheep_pos, state.shepherd_pos, state.goal_pos[None]])
    reach = np.concatenate([state.sheep_radius, state.shepherd_radius, [state.goal_radius]])[:, None]
    low = np.concatenate([points - reach, trails.reshape(-1, 2)]).min(axis=0)
    high = np.concatenate([points + reach, trails.reshape(-1, 2)]).max(axis=0)
    aspect = size[0] / size[1]
    width, height = (high - low).tolist()
    x, y = ((low + high) / 2).tolist()
    return Camera(center=(x, y), width=max(max(width, height * aspect) / (1 - 2 * margin), MIN_VIEW * max(aspect, 1)))


def checked_size(size: Size) -> Size:
    """A picture's size in whole pixels.

    Raises:
        ValueError: it is none, or too small or large.
    """
    try:
        w, h = (operator.index(side) for side in size)
    except (TypeError, ValueError):
        w = h = 0
    if not (MIN_SIZE <= w <= MAX_SIZE and MIN_SIZE <= h <= MAX_SIZE):
        raise ValueError(f"size: must be (width, height) in whole pixels, {MIN_SIZE} to {MAX_SIZE} (given: {size!r})")
    return w, h


def checked_trails(trails: Iterable[ArrayLike] | None, state: WorldState) -> Floats:
    """(K, P, 2): the trails with the shepherds' present places at their end; K = 0 without trails."""
    shape = state.shepherd_pos.shape
    past = [np.asarray(places, dtype=float) for places in (() if trails is None else trails)]
    for places in past:
        if places.shape != shape:
            raise ValueError(f"trails: each must be {shape}, one place a shepherd (given: {places.shape})")
    return np.stack([*past, state.shepherd_pos]) if past else np.empty((0, *shape))


class Smooth:
    """A camera that goes smoothly where it is aimed at: what is left of the way shrinks by e in ``seconds``.

    Its width goes there by ratios, so that coming nearer and going back look alike.

    Args:
        seconds: [s], above 0.
    """

    def __init__(self, seconds: float = 1.0) -> None:
        if not (math.isfinite(seconds) and seconds > 0):
            raise ValueError(f"seconds: must be finite and above 0 (given: {seconds!r})")
        self._seconds = seconds
        self._camera: Camera | None = None
        self._time = 0.0

    def reset(self) -> None:
        """Forget where it was: it is at once where it is aimed at next."""
        self._camera = None

    def __call__(self, aim: Camera, time: float) -> Camera:
        """The camera at ``time`` [s], since then aimed at ``aim``."""
        if self._camera is None or time < self._time:
            self._camera = aim
        else:
            share = -math.expm1((self._time - time) / self._seconds)
            (x, y), (to_x, to_y) = self._camera.center, aim.center
            width = self._camera.width * (aim.width / self._camera.width) ** share
            self._camera = Camera(center=(x + share * (to_x - x), y + share * (to_y - y)), width=width)
        self._time = time
        return self._camera
