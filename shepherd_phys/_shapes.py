"""Queries on shapes held as plain arrays: distances to a surface, and where a beam meets it.

Each query evaluates the expressions that Chipmunk evaluates, in the same order, so that a beam which just grazes
a surface is a hit here exactly where it is one there (Munk2D: cpShape.c, cpPolyShape.c). Hence no ``fastmath``,
and IEEE division. numba's cache does not notice changes in another file: after an edit here, delete the caches
(``__pycache__``) of the kernels that call these functions.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]

DISC, SEGMENT, POLYGON = 0, 1, 2
"""Kinds of shape."""
SHEEP, SHEPHERDS, OBSTACLES, GOAL = 0, 1, 2, 3
"""Channels; the first three are channels of shapes."""


class Shapes(NamedTuple):
    """Shapes as arrays: S of them with V corners in all."""

    table: Ints
    """(S, 5) kind (DISC, SEGMENT, POLYGON), row of the body or -1, channel, first corner, number of corners."""
    radius: Floats
    """(S,) radius of the disc, or of the rounding of the others [m]."""
    corners: Floats
    """(V, 4) x, y [m] and the unit normal of the edge that ends there (outwards for a polygon; 0 for a disc), in
    the frame of the body; in world coordinates where it stands still."""
    boxes: Floats
    """(S, 4) left, bottom, right, top of a shape that stands still [m]; 0 for the others."""
    boxed: bool
    """Whether two or more shapes stand still: Chipmunk then tries their boxes before the shapes themselves."""


@njit(cache=True, error_model="numpy")
def _nearest_on_edge(px: float, py: float, ax: float, ay: float, bx: float, by: float) -> tuple[float, float]:
    """Point of the edge a-b that is nearest to p."""
    dx, dy = ax - bx, ay - by
    t = (dx * (px - bx) + dy * (py - by)) / (dx * dx + dy * dy)
    t = t if t < 1.0 else 1.0  # also where the edge has no length and t is NaN
    t = max(t, 0.0)
    return bx + dx * t, by + dy * t


@njit(cache=True, error_model="numpy")
def surface_distance(shapes: Shapes, s: int, x: float, y: float) -> tuple[float, float, float]:
    """Signed distance from (x, y) to the surface of shape s [m], negative inside, and the unit vector away from it.

    The point is in the frame of the corners: world coordinates for a shape that stands still.
    """
    kind, first, count = shapes.table[s, 0], shapes.table[s, 3], shapes.table[s, 4]
    r, corners = shapes.radius[s], shapes.corners
    fallback_x, fallback_y = 0.0, 1.0
    outside = True
    if kind == DISC:
        near_x, near_y = corners[first, 0], corners[first, 1]
        near = math.sqrt((x - near_x) * (x - near_x) + (y - near_y) * (y - near_y))
    elif kind == SEGMENT:
        near_x, near_y = _nearest_on_edge(
            x, y, corners[first, 0], corners[first, 1], corners[first + 1, 0], corners[first + 1, 1]
        )
        near = math.sqrt((x - near_x) * (x - near_x) + (y - near_y) * (y - near_y))
        fallback_x, fallback_y = corners[first, 2], corners[first, 3]
    else:
        outside = False
        near, near_x, near_y = math.inf, 0.0, 0.0
        before_x, before_y = corners[first + count - 1, 0], corners[first + count - 1, 1]
        for i in range(first, first + count):
            vx, vy, nx, ny = corners[i, 0], corners[i, 1], corners[i, 2], corners[i, 3]
            if nx * (x - vx) + ny * (y - vy) > 0.0:
                outside = True
            cx, cy = _nearest_on_edge(x, y, before_x, before_y, vx, vy)
            distance = math.sqrt((x - cx) * (x - cx) + (y - cy) * (y - cy))
            if distance < near:
                near, near_x, near_y, fallback_x, fallback_y = distance, cx, cy, nx, ny
            before_x, before_y = vx, vy
    signed = near if outside else -near
    if near > 1e-5:  # Chipmunk's own threshold: nearer, a difference of positions has no direction
        return signed - r, (x - near_x) / signed, (y - near_y) / signed
    return signed - r, fallback_x, fallback_y


@njit(cache=True, error_model="numpy")
def surface_distances(points: Floats, shapes: Shapes, which: Ints) -> tuple[Floats, Floats]:
    """Signed distances (N, K) [m] and unit vectors away (N, K, 2) of points (N, 2) from shapes ``which`` (K,)."""
    n = len(points)
    distance, away = np.empty((n, len(which))), np.empty((n, len(which), 2))
    for i in range(n):
        for j, s in enumerate(which):
            distance[i, j], away[i, j, 0], away[i, j, 1] = surface_distance(shapes, s, points[i, 0], points[i, 1])
    return distance, away


@njit(cache=True, error_model="numpy")
def disc_alpha(cx: float, cy: float, r: float, ax: float, ay: float, bx: float, by: float) -> float:
    """Share of the way a-b at which it enters a disc; NaN or out of [0, 1] where it does not."""
    dax, day = ax - cx, ay - cy
    dbx, dby = bx - cx, by - cy
    aa, ab = dax * dax + day * day, dax * dbx + day * dby
    qa = aa - 2.0 * ab + (dbx * dbx + dby * dby)
    qb = ab - aa
    return (-qb - math.sqrt(qb * qb - qa * (aa - r * r))) / qa


@njit(cache=True, error_model="numpy")
def cap_alpha(cx: float, cy: float, r: float, ax: float, ay: float, bx: float, by: float) -> float:
    """As `disc_alpha`, 1 where the disc is not hit."""
    t = disc_alpha(cx, cy, r, ax, ay, bx, by)
    return t if 0.0 <= t <= 1.0 else 1.0


@njit(cache=True, error_model="numpy")
def segment_alpha(corners: Floats, first: int, r: float, ax: float, ay: float, bx: float, by: float) -> float:
    """Share of the way a-b at which it meets a segment with round ends; 1 where it does not."""
    ux, uy, nx, ny = corners[first, 0], corners[first, 1], corners[first, 2], corners[first, 3]
    vx, vy = corners[first + 1, 0], corners[first + 1, 1]
    dx, dy = bx - ax, by - ay
    d = (ux - ax) * nx + (uy - ay) * ny
    fx, fy = (-nx, -ny) if d > 0.0 else (nx, ny)
    # the side that faces a, moved out by the radius and seen from a
    ox, oy = fx * r - ax, fy * r - ay
    if (dx * (uy + oy) - dy * (ux + ox)) * (dx * (vy + oy) - dy * (vx + ox)) <= 0.0:
        level = d + (-r if d > 0.0 else r)
        ad, bd = -level, dx * nx + dy * ny - level
        return ad / (ad - bd) if ad * bd < 0.0 else 1.0
    if r == 0.0:
        return 1.0
    return min(cap_alpha(ux, uy, r, ax, ay, bx, by), cap_alpha(vx, vy, r, ax, ay, bx, by))


@njit(cache=True, error_model="numpy")
def misses_box(box: Floats, ax: float, ay: float, bx: float, by: float) -> bool:
    """Whether the way a-b misses a bounding box, decided as Chipmunk's tree decides it."""
    dx, dy = bx - ax, by - ay
    enter, leave = -math.inf, math.inf
    if dx == 0.0:
        if ax < box[0] or box[2] < ax:
            return True
    else:
        t, u = (box[0] - ax) / dx, (box[2] - ax) / dx
        enter, leave = max(enter, min(t, u)), min(leave, max(t, u))
    if dy == 0.0:
        if ay < box[1] or box[3] < ay:
            return True
    else:
        t, u = (box[1] - ay) / dy, (box[3] - ay) / dy
        enter, leave = max(enter, min(t, u)), min(leave, max(t, u))
    return not (enter <= min(leave, 1.0) and leave >= 0.0)
