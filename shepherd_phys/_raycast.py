"""Kernels of the lidar: every beam of every shepherd in one call, each shape asked only about beams it may meet."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from shepherd_phys._shapes import (
    DISC,
    GOAL,
    OBSTACLES,
    POLYGON,
    SHEEP,
    Bools,
    Floats,
    Ints,
    Shapes,
    cap_alpha,
    disc_alpha,
    misses_box,
    segment_alpha,
    surface_distance,
)

_MARGIN = 1e-3
"""[rad]. Beams this far beside a shape are tried too: more than two of `_angle` err or rounding can move an edge."""
_INSIDE = 1e-6
"""[m]. A hit this far inside a bounding box is one of a beam that meets the box, however its sides are rounded."""


@njit(cache=True, error_model="numpy")
def _half_width(gap2: float, r: float) -> float:
    """Half of the angle under which a disc is seen, or a little more [rad]; ``gap2`` is distance^2 - r^2."""
    return min(0.5 * math.pi, r / math.sqrt(gap2)) if gap2 > 0.0 else 0.5 * math.pi


@njit(cache=True, error_model="numpy")
def _angle(y: float, x: float) -> float:
    """``atan2`` to within 3e-4 rad, in a third of its time: enough to say which beams to try."""
    ax, ay = abs(x), abs(y)
    q = min(ax, ay) / max(ax, ay)
    q2 = q * q
    angle = q + q * q2 * (q2 * (0.15931422 - 0.0464964749 * q2) - 0.327622764)
    if ay > ax:
        angle = 0.5 * math.pi - angle
    if x < 0.0:
        angle = math.pi - angle
    return -angle if y < 0.0 else angle


@njit(cache=True, error_model="numpy")
def _beams_between(low: float, high: float, beams: int) -> tuple[int, int]:
    """First and last beam between two angles; the first in [0, beams), the last may run past beams - 1."""
    per_radian = beams / (2.0 * math.pi)
    first = math.ceil((low - _MARGIN) * per_radian)
    last = math.floor((high + _MARGIN) * per_radian)
    if last - first >= beams - 1:
        return 0, beams - 1
    lap = beams * (first // beams)
    return first - lap, last - lap


@njit(cache=True, error_model="numpy")
def _covered_disc(cx: float, cy: float, r: float, x: float, y: float, beams: int) -> tuple[int, int]:
    """First and last beam from (x, y), outside a disc, that can meet it."""
    dx, dy = cx - x, cy - y
    half = _half_width(dx * dx + dy * dy - r * r, r)
    angle = _angle(dy, dx)
    return _beams_between(angle - half, angle + half, beams)


@njit(cache=True, error_model="numpy")
def _covered(shapes: Shapes, s: int, x: float, y: float, beams: int) -> tuple[int, int]:
    """First and last beam from (x, y), outside shape s, that can meet it."""
    corners, r, first, count = shapes.corners, shapes.radius[s], shapes.table[s, 3], shapes.table[s, 4]
    if shapes.table[s, 0] == DISC:
        return _covered_disc(corners[first, 0], corners[first, 1], r, x, y, beams)
    # seen from outside, a convex shape spans less than half a turn: measure angles from one towards its middle
    mx, my = 0.0, 0.0
    for i in range(first, first + count):
        mx += (corners[i, 0] - x) / count
        my += (corners[i, 1] - y) / count
    low, high = math.inf, -math.inf
    for i in range(first, first + count):
        dx, dy = corners[i, 0] - x, corners[i, 1] - y
        half = _half_width(dx * dx + dy * dy - r * r, r)
        turn = _angle(mx * dy - my * dx, mx * dx + my * dy)
        low, high = min(low, turn - half), max(high, turn + half)
    if high - low > math.pi - 0.1:  # close by, where rounding could turn a corner to the other side
        return 0, beams - 1
    middle = _angle(my, mx)
    return _beams_between(middle + low, middle + high, beams)


@njit(cache=True, error_model="numpy", inline="always")
def _cast_disc(
    hit: Floats,
    cx: float,
    cy: float,
    r: float,
    x: float,
    y: float,
    directions: Floats,
    reach: float,
    first: int,
    last: int,
) -> None:
    """`_cast` for a disc; the usual shape has a path of its own, which takes half the time."""
    for k in range(first, last + 1):
        t = disc_alpha(cx, cy, r, x, y, x + reach * directions[0, k], y + reach * directions[1, k])
        hit[k] = t * reach if 0.0 <= t < 1.0 else math.inf


@njit(cache=True, error_model="numpy")
def _cast(
    hit: Floats, shapes: Shapes, s: int, x: float, y: float, directions: Floats, reach: float, first: int, last: int
) -> None:
    """Write the distances at which beams first..last from (x, y) meet shape s [m], infinity where they do not.

    Beams are ``reach`` long; ``directions`` (2, 2 beams) are unit vectors, ``hit`` (2 beams,): both twice round.
    """
    corners = shapes.corners
    kind, first_corner, count = shapes.table[s, 0], shapes.table[s, 3], shapes.table[s, 4]
    r = shapes.radius[s]
    if kind == DISC:
        _cast_disc(hit, corners[first_corner, 0], corners[first_corner, 1], r, x, y, directions, reach, first, last)
    elif kind == POLYGON:
        _cast_polygon(hit, corners, first_corner, count, r, x, y, directions, reach, first, last)
    else:
        for k in range(first, last + 1):
            bx, by = x + reach * directions[0, k], y + reach * directions[1, k]
            t = segment_alpha(corners, first_corner, r, x, y, bx, by)
            hit[k] = t * reach if t < 1.0 else math.inf


@njit(cache=True, error_model="numpy", inline="always")
def _cast_polygon(
    hit: Floats,
    corners: Floats,
    first_corner: int,
    count: int,
    r: float,
    x: float,
    y: float,
    directions: Floats,
    reach: float,
    first: int,
    last: int,
) -> None:
    """`_cast` for a convex polygon with rounded corners: edge by edge, for what does not hang on the beam."""
    hit[first : last + 1] = 1.0
    before = first_corner + count - 1
    for i in range(first_corner, first_corner + count):
        vx, vy, nx, ny = corners[i, 0], corners[i, 1], corners[i, 2], corners[i, 3]
        an = x * nx + y * ny
        d = an - (vx * nx + vy * ny) - r
        if d >= 0.0:
            low, high = nx * corners[before, 1] - ny * corners[before, 0], nx * vy - ny * vx
            for k in range(first, last + 1):
                bx, by = x + reach * directions[0, k], y + reach * directions[1, k]
                bn = bx * nx + by * ny
                if not (-1e-5 < an - bn < 1e-5):  # Chipmunk's own threshold for a beam along an edge
                    t = d / (an - bn)
                    if 0.0 <= t <= 1.0:
                        px, py = x * (1.0 - t) + bx * t, y * (1.0 - t) + by * t
                        if low <= nx * py - ny * px <= high:
                            hit[k] = t
        before = i
    for k in range(first, last + 1):
        t = hit[k]
        if r > 0.0:
            bx, by = x + reach * directions[0, k], y + reach * directions[1, k]
            for i in range(first_corner, first_corner + count):
                t = min(t, cap_alpha(corners[i, 0], corners[i, 1], r, x, y, bx, by))
        hit[k] = t * reach if t < 1.0 else math.inf


@njit(cache=True, error_model="numpy")
def _outside_box(
    hit: Floats, box: Floats, x: float, y: float, directions: Floats, reach: float, first: int, last: int
) -> None:
    """Turn hits of beams that miss the bounding box into none; the arguments are those of `_cast`."""
    left, bottom, right, top = box[0] + _INSIDE, box[1] + _INSIDE, box[2] - _INSIDE, box[3] - _INSIDE
    for k in range(first, last + 1):
        if left < x + hit[k] * directions[0, k] < right and bottom < y + hit[k] * directions[1, k] < top:
            continue
        if hit[k] < math.inf and misses_box(box, x, y, x + reach * directions[0, k], y + reach * directions[1, k]):
            hit[k] = math.inf


@njit(cache=True, error_model="numpy")
def _measure(gaps: Floats, order: Ints, shapes: Shapes, x: float, y: float) -> None:
    """Write the distance from (x, y) to every shape (S,) [m], negative inside, and an order: nearer ones first.

    The order is a coarse one (64 classes), good for skipping what is hidden, and of no influence on a reading.
    """
    table, radius, corners = shapes.table, shapes.radius, shapes.corners
    nearest, farthest = math.inf, 0.0
    for s in range(len(gaps)):
        if table[s, 0] == DISC:
            dx, dy = x - corners[table[s, 3], 0], y - corners[table[s, 3], 1]
            gaps[s] = math.sqrt(dx * dx + dy * dy) - radius[s]
        else:
            gaps[s] = surface_distance(shapes, s, x, y)[0]
        nearest, farthest = min(nearest, gaps[s]), max(farthest, gaps[s])
    per_metre = 63.0 / (farthest - nearest) if farthest > nearest else 0.0
    places = np.zeros(65, np.int64)
    for s in range(len(gaps)):
        places[int((gaps[s] - nearest) * per_metre) + 1] += 1
    for i in range(64):
        places[i + 1] += places[i]
    for s in range(len(gaps)):
        i = int((gaps[s] - nearest) * per_metre)
        order[places[i]] = s
        places[i] += 1


@njit(cache=True, error_model="numpy", inline="always")
def _all_nearer(out: Floats, row: int, p: int, limit: float, first: int, last: int) -> bool:
    """Whether the readings ``out[row, p]`` of beams first..last all lie below a limit [m]."""
    beams = out.shape[2]
    for k in range(first, last + 1):  # noqa: SIM110 - numba has no generators here
        if not out[row, p, k if k < beams else k - beams] < limit:
            return False
    return True


@njit(cache=True, error_model="numpy", inline="always")
def _keep_nearest(out: Floats, row: int, p: int, hit: Floats, first: int, last: int) -> None:
    """Take hits first..last (2 beams,) into the readings ``out[row, p]``."""
    beams = out.shape[2]
    for k in range(first, last + 1):
        into = k if k < beams else k - beams
        if hit[k] < out[row, p, into]:
            out[row, p, into] = hit[k]


@njit(cache=True, error_model="numpy")
def cast_goal(row: Floats, x: float, y: float, goal: Floats, directions: Floats, reach: float, way_out: bool) -> None:
    """Write the readings of the goal's circle from (x, y) into a row (beams,) full of infinities.

    ``goal`` (3,) is its centre and radius [m]. Readings are below ``reach`` [m]; from inside they are the distance
    to the circle if ``way_out``, else nothing.
    """
    beams = len(row)
    dx, dy, r = goal[0] - x, goal[1] - y, goal[2]
    inside = math.sqrt(dx * dx + dy * dy) <= r
    if inside and not way_out:
        return
    first, last = 0, beams - 1
    if not inside:
        half = _half_width(dx * dx + dy * dy - r * r, r)
        angle = math.atan2(dy, dx)
        first, last = _beams_between(angle - half, angle + half, beams)
    for k in range(first, last + 1):
        along = dx * directions[0, k] + dy * directions[1, k]
        aside = dx * directions[1, k] - dy * directions[0, k]
        inner = r * r - aside * aside
        if inside:
            distance = along + math.sqrt(max(inner, 0.0))
        elif inner >= 0.0 and along > 0.0:
            distance = along - math.sqrt(inner)
        else:
            continue
        if distance < reach:
            row[k if k < beams else k - beams] = max(distance, 0.0)


@njit(cache=True, error_model="numpy")
def _in_world(shapes: Shapes, poses: Floats) -> Shapes:
    """Bring the shapes to world coordinates: their bodies stand at poses (rows, 3) x, y [m], angle [rad]."""
    corners, world = shapes.corners, shapes.corners.copy()
    for s in range(len(shapes.table)):
        body, first = shapes.table[s, 1], shapes.table[s, 3]
        if body < 0:
            continue
        x, y, angle = poses[body, 0], poses[body, 1], poses[body, 2]
        ca, sa = (1.0, 0.0) if angle == 0.0 else (math.cos(angle), math.sin(angle))
        for i in range(first, first + shapes.table[s, 4]):
            world[i, 0] = ca * corners[i, 0] - sa * corners[i, 1] + x
            world[i, 1] = sa * corners[i, 0] + ca * corners[i, 1] + y
            world[i, 2] = ca * corners[i, 2] - sa * corners[i, 3]
            world[i, 3] = sa * corners[i, 2] + ca * corners[i, 3]
    return Shapes(shapes.table, shapes.radius, world, shapes.boxes, shapes.boxed)


@njit(cache=True, error_model="numpy")
def scan_shapes(
    out: Floats,
    shapes: Shapes,
    poses: Floats,
    n_sheep: int,
    goal: Floats,
    way_out: bool,
    directions: Floats,
    reach: float,
    goal_reach: float,
    rows: Ints,
    masks: Bools,
    first_mask: int,
    flies: Bools,
    cut: bool,
) -> None:
    """Read every beam of every channel of every shepherd, in one pass.

    Args:
        out: (channels, P, beams) readings [m], overwritten.
        shapes: the shapes.
        poses: (N + P, 3) x, y [m], angle [rad] of the bodies; sheep first.
        n_sheep: N.
        goal: (3,) centre and radius [m].
        way_out: whether the goal is seen from inside.
        directions: (2, 2 beams) unit vectors, twice round.
        reach: greatest reading [m].
        goal_reach: greatest reading of the goal [m].
        rows: (4,) row of ``out`` for SHEEP, SHEPHERDS, OBSTACLES, GOAL; -1 where it is not wanted.
        masks: (K, N) further sets of sheep, each with a row of its own.
        first_mask: row of the first of them.
        flies: (P,) whether the shepherd flies.
        cut: whether obstacles cut the other channels; needs their row.
    """
    beams, n_masks = out.shape[2], len(masks)
    world = _in_world(shapes, poses)
    table, radius, corners = world.table, world.radius, world.corners
    hit, far = np.empty(2 * beams), np.empty((1, 1, beams))
    gaps, order = np.empty(len(table)), np.empty(len(table), np.int64)
    out[:] = math.inf
    for p in range(out.shape[1]):
        x, y = poses[n_sheep + p, 0], poses[n_sheep + p, 1]
        _measure(gaps, order, world, x, y)
        for i in range(len(order)):
            s = int(order[i])
            body, channel = table[s, 1], table[s, 2]
            row, gap = rows[channel], gaps[s]
            in_sets = n_masks if channel == SHEEP else 0
            if body == n_sheep + p or gap > reach + 1e-6 or (row < 0 and in_sets == 0) or (flies[p] and gap <= 0.0):
                continue
            if gap <= 0.0:
                first, last = 0, beams - 1
                hit[:beams] = 0.0
            else:
                disc, r, corner = table[s, 0] == DISC, radius[s], table[s, 3]
                cx, cy = corners[corner, 0], corners[corner, 1]
                if disc:
                    first, last = _covered_disc(cx, cy, r, x, y, beams)
                else:
                    first, last = _covered(world, s, x, y, beams)
                # nearer shapes may hide all of it, in every row in which it counts
                limit = gap - 1e-6
                hidden = row < 0 or _all_nearer(out, row, p, limit, first, last)
                for m in range(in_sets):
                    if hidden and masks[m, body]:
                        hidden = _all_nearer(out, first_mask + m, p, limit, first, last)
                if hidden:
                    continue
                if disc:
                    _cast_disc(hit, cx, cy, r, x, y, directions, reach, first, last)
                else:
                    _cast(hit, world, s, x, y, directions, reach, first, last)
            if world.boxed and body < 0:
                _outside_box(hit, world.boxes[s], x, y, directions, reach, first, last)
            if row >= 0:
                _keep_nearest(out, row, p, hit, first, last)
            for m in range(in_sets):
                if masks[m, body]:
                    _keep_nearest(out, first_mask + m, p, hit, first, last)
        if rows[GOAL] >= 0:
            cast_goal(out[rows[GOAL], p], x, y, goal, directions, goal_reach, way_out)
        if not cut:
            continue
        if rows[GOAL] >= 0 and beyond(out[rows[GOAL], p], reach):
            far[:] = math.inf
            for s in range(len(table)):
                if table[s, 2] == OBSTACLES and 0.0 < gaps[s] < goal_reach + 1e-6:
                    first, last = _covered(world, s, x, y, beams)
                    _cast(hit, world, s, x, y, directions, goal_reach, first, last)
                    if world.boxed:
                        _outside_box(hit, world.boxes[s], x, y, directions, goal_reach, first, last)
                    _keep_nearest(far, 0, 0, hit, first, last)
            cut_behind(out[rows[GOAL], p], far[0, 0], reach)
        for c in range(len(out)):
            if c != rows[OBSTACLES]:
                cut_behind(out[c, p], out[rows[OBSTACLES], p], 0.0)


@njit(cache=True, error_model="numpy")
def beyond(row: Floats, reach: float) -> bool:
    """Whether any reading (beams,) is farther than ``reach`` [m]."""
    found = False
    for reading in row:
        found = found or reach < reading < math.inf
    return found


@njit(cache=True, error_model="numpy")
def cut_behind(row: Floats, obstacle: Floats, beyond_reach: float) -> None:
    """Turn readings farther than ``beyond_reach`` and behind an obstacle into nothing; (beams,) each [m]."""
    for k in range(len(row)):
        if obstacle[k] < row[k] and row[k] > beyond_reach:
            row[k] = math.inf
