"""How sheep feel obstacles: a push away from every surface that is near."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray
from pydantic import Field

from shepherd_phys._shapes import Shapes, surface_distance
from shepherd_phys.settings import Settings, settings
from shepherd_phys.state import WorldState

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

NO_PUSH: Floats = np.empty((0, 2))
"""What `Avoidance.pushes` gives where there are no obstacles."""


@settings
class Avoidance(Settings):
    """A push of weight w exp(-mu d / range) away from each surface nearer than the range, summed.

    d is the distance from a sheep's centre to the surface of one convex shape: a fence is two. The form is that of
    El-Fiqi et al. 2020 (IEEE Access 8:214658-214671), whose sheep have ``Avoidance(weight=3, range=5)``, which closes
    gaps of less than about 5 m to them.
    """

    weight: float = Field(default=1.5, ge=0)
    """w [1], beside the weights of a flock model's unit vectors (inferred); 0: sheep do not feel obstacles."""
    range: float = Field(default=2.0, gt=0)
    """[m] (inferred)."""
    decay: float = Field(default=2.0, ge=0)
    """mu [1] (2020)."""

    def pushes(self, state: WorldState) -> Floats:
        """The push on every sheep (N, 2) [1]; `NO_PUSH`, which has no rows, where there are no obstacles."""
        if not state.obstacles:
            return NO_PUSH
        around = state.surroundings
        if around.known:
            return np.asarray(
                summed_pushes(state.sheep_pos, *around.shapes, around.static, self.weight, self.range, self.decay)
            )
        distance, away = around.static_distances(state.sheep_pos)
        size = np.where(distance < self.range, self.weight * np.exp(-self.decay * distance / self.range), 0.0)
        return np.asarray((size[:, :, None] * away).sum(axis=1))


@njit(cache=True, error_model="numpy")
def summed_pushes(
    points: Floats, table: Ints, radius: Floats, corners: Floats, boxes: Floats, boxed: bool,
    which: Ints, weight: float, reach: float, decay: float,
) -> Floats:  # fmt: skip
    """The pushes of `Avoidance` on points (N, 2) [m] by the shapes ``which`` (K,), which stand still: (N, 2).

    The fields of `Shapes` come one by one: a tuple takes longer to hand over than to use here.
    """
    shapes = Shapes(table, radius, corners, boxes, boxed)
    pushed = np.zeros((len(points), 2))
    left, bottom, right, top = math.inf, math.inf, -math.inf, -math.inf
    for i in range(len(points)):
        x, y = points[i, 0], points[i, 1]
        left, right, bottom, top = min(left, x), max(right, x), min(bottom, y), max(top, y)
    for s in which:
        # the surface is no nearer than the box that holds it
        low_x, low_y = shapes.boxes[s, 0] - reach, shapes.boxes[s, 1] - reach
        high_x, high_y = shapes.boxes[s, 2] + reach, shapes.boxes[s, 3] + reach
        if right < low_x or left > high_x or top < low_y or bottom > high_y:
            continue
        for i in range(len(points)):
            x, y = points[i, 0], points[i, 1]
            if x < low_x or x > high_x or y < low_y or y > high_y:
                continue
            distance, away_x, away_y = surface_distance(shapes, s, x, y)
            if distance < reach:
                size = weight * math.exp(-decay * distance / reach)
                pushed[i, 0] += size * away_x
                pushed[i, 1] += size * away_y
    return pushed
