"""Shapes of pymunk as plain arrays, for kernels; and the collision categories that tell them apart."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
import pymunk
from numpy.typing import NDArray

from shepherd_phys._shapes import (
    DISC,
    OBSTACLES,
    POLYGON,
    SEGMENT,
    SHEEP,
    SHEPHERDS,
    Shapes,
    surface_distance,
    surface_distances,
)
from shepherd_phys.obstacles import Obstacle, solid

__all__ = [
    "BEAM_CATEGORY",
    "DISC",
    "HIDDEN_CATEGORY",
    "OBSTACLES",
    "OBSTACLE_CATEGORY",
    "POLYGON",
    "SEGMENT",
    "SHEEP",
    "SHEEP_CATEGORY",
    "SHEPHERDS",
    "SHEPHERD_CATEGORY",
    "Geometry",
    "Owned",
    "Shapes",
    "compile_shapes",
    "surface_distance",
    "surfaces",
]

Floats = NDArray[np.float64]

SHEEP_CATEGORY = 1
SHEPHERD_CATEGORY = 2
OBSTACLE_CATEGORY = 4
"""Filter categories that the world gives to shapes; each channel's beams see one of them."""
HIDDEN_CATEGORY = 8
"""Category of sheep that a scan of a part of the sheep leaves out, during that scan only."""
BEAM_CATEGORY = 16
"""Category that queries have and no shape: flying bodies meet it alone, so beams see what nothing touches."""

CLEARANCE = 1e-3
"""Gap that `Geometry.push_out` leaves [m]."""

Owned = tuple[pymunk.Shape, int, int]
"""A shape, the row of its body among the poses (sheep first, then shepherds; -1: it stands still), its channel."""


@dataclass(frozen=True, slots=True, eq=False)
class Geometry:
    """Compiled shapes; the arrays are read-only."""

    shapes: Shapes
    """S shapes with V corners in all, as kernels take them."""
    static: NDArray[np.int64]
    """Rows of the shapes that stand still."""
    unknown: tuple[Owned, ...]
    """Shapes that are not exactly a Circle, Segment or Poly; they are in no array."""
    has_obstacles: bool
    """Whether any shape, known or not, belongs to the obstacles."""

    @property
    def known(self) -> bool:
        """Whether the arrays tell the whole truth."""
        return not self.unknown

    def static_distances(self, points: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Signed distances from points to every shape that stands still, unknown ones last.

        Args:
            points: (N, 2) [m].

        Returns:
            distances (N, K) [m], negative inside, and unit vectors away from the nearest surface (N, K, 2); in
            the very middle of a disc that is up.
        """
        points = np.ascontiguousarray(points, dtype=np.float64)
        distance, away = surface_distances(points, self.shapes, self.static)
        for shape, body, _ in self.unknown:
            if body < 0:
                found = [shape.point_query((float(x), float(y))) for x, y in points]
                column = np.array([info.distance for info in found]).reshape(-1, 1)
                distance = np.concatenate((distance, column), axis=1)
                directions = np.array([info.gradient for info in found]).reshape(-1, 1, 2)
                away = np.concatenate((away, directions), axis=1)
        return distance, away

    def push_out(self, pos: NDArray[np.float64], radius: NDArray[np.float64]) -> NDArray[np.float64]:
        """Discs moved out of the shape that stands still and that each is deepest in, just clear of it.

        Args:
            pos: (M, 2) centres [m].
            radius: (M,) [m].

        Returns:
            (M, 2) centres [m].
        """
        distance, away = self.static_distances(pos)
        depth = radius[:, None] - distance
        deepest = depth.argmax(axis=1)
        rows = np.arange(len(pos))
        by = depth[rows, deepest]
        return np.asarray(pos + np.where(by > 0, by + CLEARANCE, 0.0)[:, None] * away[rows, deepest])

    def clear_by(self, gap: float) -> Callable[[Floats, Floats], Floats] | None:
        """`push_out` for discs that are to keep this far from what stands still [m]; None where nothing does."""
        if not len(self.static) and not self.unknown:
            return None
        return lambda pos, radius: self.push_out(pos, radius + gap)


def compile_shapes(shapes: Iterable[Owned]) -> Geometry:
    """Plain arrays of shapes, each with the row of its body (-1: it stands still) and its channel.

    Call it anew when a shape or a body that stands still was changed.
    """
    table: list[tuple[int, int, int, int, int]] = []
    radius: list[float] = []
    corners: list[tuple[float, float, float, float]] = []
    boxes: list[tuple[float, float, float, float]] = []
    unknown: list[Owned] = []
    has_obstacles = False
    for owned in shapes:
        shape, body, channel = owned
        has_obstacles = has_obstacles or channel == OBSTACLES
        compiled = _corners(shape)
        if compiled is None:
            unknown.append(owned)
            continue
        kind, own = compiled
        if body < 0:
            own = [_placed(corner, shape.body) for corner in own]
            box = shape.cache_bb()
            boxes.append((box.left, box.bottom, box.right, box.top))
        else:
            boxes.append((0.0, 0.0, 0.0, 0.0))
        table.append((kind, body, channel, len(corners), len(own)))
        radius.append(float(shape.radius))
        corners.extend(own)
    rows = np.array(table, np.int64).reshape(-1, 5)
    static = np.flatnonzero(rows[:, 1] < 0).astype(np.int64)
    arrays = Shapes(
        table=rows,
        radius=np.array(radius, np.float64),
        corners=np.array(corners, np.float64).reshape(-1, 4),
        boxes=np.array(boxes, np.float64).reshape(-1, 4),
        boxed=len(static) > 1,
    )
    for array in (*arrays[:4], static):
        array.setflags(write=False)
    return Geometry(arrays, static, tuple(unknown), has_obstacles)


def surfaces(obstacles: Iterable[Obstacle]) -> Geometry:
    """Obstacles compiled, apart from any world.

    Raises:
        SettingsError: one of them is none; the message names it.
    """
    body = pymunk.Body(body_type=pymunk.Body.STATIC)
    return compile_shapes(
        (shape, -1, OBSTACLES) for i, obstacle in enumerate(obstacles) for shape in solid(obstacle, i, body)
    )


def _corners(shape: pymunk.Shape) -> tuple[int, list[tuple[float, float, float, float]]] | None:
    """Kind and corners (x, y, normal) of a shape in its body's frame; None for a class that is not pymunk's own."""
    if type(shape) is pymunk.Circle:
        return DISC, [(shape.offset.x, shape.offset.y, 0.0, 0.0)]
    if type(shape) is pymunk.Segment:
        normal = shape.normal
        return SEGMENT, [(end.x, end.y, normal.x, normal.y) for end in (shape.a, shape.b)]
    if type(shape) is pymunk.Poly:
        vertices = shape.get_vertices()
        rows = []
        for before, corner in zip([vertices[-1], *vertices[:-1]], vertices, strict=True):
            nx, ny = corner.y - before.y, -(corner.x - before.x)
            # normalised as Chipmunk does it, by one reciprocal
            scale = 1.0 / (math.sqrt(nx * nx + ny * ny) + np.finfo(np.float64).tiny)
            rows.append((corner.x, corner.y, nx * float(scale), ny * float(scale)))
        return POLYGON, rows
    return None


def _placed(corner: tuple[float, float, float, float], body: pymunk.Body | None) -> tuple[float, float, float, float]:
    """Move a corner of a body that stands still to world coordinates."""
    if body is None:
        return corner
    x, y, nx, ny = corner
    ca, sa = math.cos(body.angle), math.sin(body.angle)
    return (
        ca * x - sa * y + body.position.x,
        sa * x + ca * y + body.position.y,
        ca * nx - sa * ny,
        sa * nx + ca * ny,
    )
