"""What a critic may see while it trains and an actor never does: the whole world, seen from one shepherd's frame."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from shepherd_phys.state import Bools, Floats, WorldState

N_BEARINGS = 8
"""Directions round the goal, evenly spread, the first along the frame's x axis."""
SHEEP_RINGS = (0.0, 1.5, 3.5, 6.0, 9.5, 14.0, 20.0, 30.0)
"""Distances from the goal's border of the rings in which sheep are counted [m]."""
SHEPHERD_RINGS = (1.0, 6.0, 12.0, 22.0)
"""The same for the other shepherds."""
LENGTH_SCALE = 25.0
"""Unit of the shepherd's own place [m]: half the side of the paper's box."""
TEAM_SCALE = 6.0
"""The largest team of the paper."""

N_SHEEP_CELLS = N_BEARINGS * len(SHEEP_RINGS)
N_SHEPHERD_CELLS = N_BEARINGS * len(SHEPHERD_RINGS)
N_NUMBERS = N_SHEEP_CELLS + N_SHEPHERD_CELLS + 5
"""Length of the view of one shepherd."""

_SHEEP_RINGS, _SHEPHERD_RINGS = np.array(SHEEP_RINGS), np.array(SHEPHERD_RINGS)


def whole_world(state: WorldState, angle: Floats, mirrored: Bools, view: NDArray[Any]) -> None:
    """Write the view of every shepherd.

    Args:
        state: the world now.
        angle: (P,) direction of the x axis of each shepherd's frame [rad]; 0 for world axes.
        mirrored: (P,) whose frame is seen in a mirror, y upside down.
        view: (P, `N_NUMBERS`) float32, receives for each shepherd

            * 64 fractions of the sheep, row = ring x 8 + bearing, about the goal's centre. A sheep is shared linearly
              between the two nearest bearings and the two nearest rings, so that the numbers move as it moves; a sheep
              in the goal is on ring 0.
            * 32 numbers of the other shepherds in the same way, over `TEAM_SCALE`.
            * its own place from the goal's centre, x and y over `LENGTH_SCALE`.
            * the fractions of the sheep in the goal now and ever; the team's size over `TEAM_SCALE`.

    The clock is not in it: a critic that bootstraps at time-outs must not see it.
    """
    _whole_world(
        state.sheep_pos, state.sheep_goal_distance, state.sheep_in_goal, state.sheep_arrived, state.shepherd_pos,
        state.goal_pos, state.goal_radius, angle, mirrored, _SHEEP_RINGS, _SHEPHERD_RINGS, view,
    )  # fmt: skip


@njit(cache=True)
def _place(away: float, rings: Floats) -> tuple[int, float]:
    """The ring at or inside a distance, and the part that belongs to the next one."""
    k = 0
    while k + 1 < len(rings) and rings[k + 1] <= away:
        k += 1
    if k + 1 == len(rings):
        return k, 0.0
    return k, max(away - rings[k], 0.0) / (rings[k + 1] - rings[k])


@njit(cache=True)
def _count(cells: Floats, ring: int, outer: float, bearing: float, amount: float) -> None:
    """Share an amount between the four cells (rings, bearings) about a place; ``bearing`` counts cells."""
    n = cells.shape[1]
    whole = math.floor(bearing)
    part = bearing - whole
    left = int(whole) % n
    right = (left + 1) % n
    cells[ring, left] += amount * (1.0 - outer) * (1.0 - part)
    cells[ring, right] += amount * (1.0 - outer) * part
    if outer > 0.0:
        cells[ring + 1, left] += amount * outer * (1.0 - part)
        cells[ring + 1, right] += amount * outer * part


@njit(cache=True)
def _whole_world(
    sheep: Floats, distance: Floats, inside: Bools, arrived: Bools, shepherds: Floats, goal: Floats, radius: float,
    angle: Floats, mirrored: Bools, sheep_rings: Floats, shepherd_rings: Floats, view: Any,
) -> None:  # fmt: skip
    """Fill ``view``; the arguments are those of `whole_world`, in its state's words."""
    n, p = len(sheep), len(shepherds)
    per_radian = N_BEARINGS / (2.0 * math.pi)
    bearing, ring, outer = np.empty(n), np.empty(n, np.int64), np.empty(n)
    n_inside, n_arrived = 0, 0
    for i in range(n):
        bearing[i] = math.atan2(sheep[i, 1] - goal[1], sheep[i, 0] - goal[0]) * per_radian
        ring[i], outer[i] = _place(distance[i], sheep_rings)
        n_inside += 1 if inside[i] else 0
        n_arrived += 1 if arrived[i] else 0
    sheep_cells = np.empty((len(sheep_rings), N_BEARINGS))
    other_cells = np.empty((len(shepherd_rings), N_BEARINGS))
    for k in range(p):
        turned, sign = angle[k] * per_radian, -1.0 if mirrored[k] else 1.0
        sheep_cells[:] = 0.0
        for i in range(n):
            _count(sheep_cells, ring[i], outer[i], sign * (bearing[i] - turned), 1.0 / n)
        other_cells[:] = 0.0
        for j in range(p):
            x, y = shepherds[j, 0] - goal[0], shepherds[j, 1] - goal[1]
            if j != k:
                at, further = _place(math.hypot(x, y) - radius, shepherd_rings)
                _count(other_cells, at, further, sign * (math.atan2(y, x) * per_radian - turned), 1.0 / TEAM_SCALE)
        place = 0
        for r in range(len(sheep_rings)):
            for b in range(N_BEARINGS):
                view[k, place] = sheep_cells[r, b]
                place += 1
        for r in range(len(shepherd_rings)):
            for b in range(N_BEARINGS):
                view[k, place] = other_cells[r, b]
                place += 1
        x, y = shepherds[k, 0] - goal[0], shepherds[k, 1] - goal[1]
        ca, sa = math.cos(angle[k]), math.sin(angle[k])
        view[k, place] = (ca * x + sa * y) / LENGTH_SCALE
        view[k, place + 1] = sign * (ca * y - sa * x) / LENGTH_SCALE
        view[k, place + 2] = n_inside / n
        view[k, place + 3] = n_arrived / n
        view[k, place + 4] = p / TEAM_SCALE
