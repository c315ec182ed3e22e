"""Where a world starts: positions drawn at random, and overlapping bodies relaxed apart."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numba import njit
from numpy.typing import NDArray

from shepherd_phys.cells import build, one_cell
from shepherd_phys.settings import SettingsError

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]
Ints = NDArray[np.int64]

GAP = 1e-3
"""[m] left between bodies that are pushed apart, so that rounding leaves no overlap."""

MAX_SWEEPS = 1_000
"""Sweeps after which placing gives up: 100 sheep at the paper's density need about 15, 10,000 about 350."""

OVERSHOOT = 1.8
"""Way that an overlapping pair is moved apart, over the overlap: as in successive over-relaxation, a value below 2 lets
crowds spread in a fifth of the sweeps that 1 needs (measured, 1000 bodies); a few end further apart than need be."""

FEW = 64
"""Bodies up to which no grid is built."""

GOLDEN_ANGLE = math.pi * (3.0 - math.sqrt(5.0))
"""[rad]. Directions at its multiples never repeat: coincident bodies leave each other in all directions."""


class PlacementError(SettingsError):
    """The bodies do not fit where the settings want them."""


def place(
    rng: np.random.Generator,
    *,
    n_sheep: int,
    n_flocks: int,
    flock_sizes: tuple[int, ...] | None = None,
    flock_distance: tuple[float, float] = (10.0, 20.0),
    flock_bearing: tuple[float, float] = (0.0, 2.0 * math.pi),
    flock_sd: float = 1.0,
    n_shepherds: int,
    box: float = 50.0,
    goal_pos: tuple[float, float] | None = None,
) -> tuple[Floats, Floats, Floats]:
    """Draw where goal, sheep and shepherds start; bodies may overlap yet (see `relax`).

    Draws, always all and in this order: goal ``random(2)`` (also where it is given: the rest stays the same),
    bearings ``random(n_flocks)``, distances ``random(n_flocks)``, members ``standard_normal((n_sheep, 2))``,
    shepherds ``random((n_shepherds, 2))``.

    Args:
        rng: source of randomness.
        n_sheep: N.
        n_flocks: flocks, of equal size; where N does not divide, the first ones have one sheep more.
        flock_sizes: sheep in each of them, where sizes are not equal.
        flock_distance: least and largest distance of a flock's centre from the goal's [m], uniform.
        flock_bearing: least and largest bearing of a flock's centre from the goal [rad], uniform.
        flock_sd: standard deviation of the members about the centre, along each axis [m].
        n_shepherds: P.
        box: side of the box centred on the origin [m]; goal and shepherds are uniform in it.
        goal_pos: the goal's centre, where it is not to be drawn [m].

    Returns:
        goal (2,), sheep (N, 2) flock by flock, shepherds (P, 2) [m].
    """
    drawn = box * (rng.random(2) - 0.5)
    goal = drawn if goal_pos is None else np.array(goal_pos, dtype=np.float64)
    bearing = flock_bearing[0] + (flock_bearing[1] - flock_bearing[0]) * rng.random(n_flocks)
    distance = flock_distance[0] + (flock_distance[1] - flock_distance[0]) * rng.random(n_flocks)
    centres = goal + distance[:, None] * np.column_stack([np.cos(bearing), np.sin(bearing)])
    members = flock_sd * rng.standard_normal((n_sheep, 2))
    shepherds = box * (rng.random((n_shepherds, 2)) - 0.5)
    return goal, centres[flock_of(n_sheep, n_flocks, flock_sizes)] + members, shepherds


def flock_of(n_sheep: int, n_flocks: int, flock_sizes: tuple[int, ...] | None = None) -> NDArray[np.int64]:
    """Which flock each sheep (N,) starts in: the sizes given, or equal ones, the first one larger where N needs it."""
    if flock_sizes is not None:
        return np.repeat(np.arange(n_flocks), flock_sizes)
    small, larger = divmod(n_sheep, n_flocks)
    return np.repeat(np.arange(n_flocks), np.where(np.arange(n_flocks) < larger, small + 1, small))


def relax(
    pos: Floats,
    radius: Floats,
    *,
    movable: Bools | None = None,
    push_out: Callable[[Floats, Floats], Floats] | None = None,
    max_sweeps: int = MAX_SWEEPS,
) -> Floats:
    """Push overlapping discs apart until none overlap; those that overlap nobody stay where they are.

    Each sweep visits all pairs that overlap and moves both by half of it (Gauss-Seidel). Deterministic.

    Args:
        pos: (M, 2) centres [m].
        radius: (M,) [m].
        movable: (M,) which of them may move (all); a fixed one leaves the whole way to the other.
        push_out: (pos (M, 2), radius (M,)) -> (M, 2), moves discs out of what is solid; applied after every sweep.
        max_sweeps: sweeps before giving up.

    Returns:
        (M, 2) centres [m]: every two discs are at least the sum of their radii apart, and ``push_out`` moves none.

    Raises:
        PlacementError: overlaps remain (two fixed bodies that overlap always do).
    """
    free = np.ones(len(pos), np.bool_) if movable is None else np.ascontiguousarray(movable, np.bool_)
    radius = np.ascontiguousarray(radius, np.float64)
    placed = np.array(pos, dtype=np.float64, order="C")
    if len(placed) == 0:
        return placed
    if not (np.isfinite(placed).all() and np.isfinite(radius).all()):
        raise PlacementError("positions and radii of bodies must be finite")
    if push_out is None:
        overlapping = _sweeps(placed, radius, free, max_sweeps)
    else:
        for _ in range(max_sweeps):
            pushed = np.where(free[:, None], push_out(placed, radius), placed)
            inside = int((pushed != placed).any(axis=1).sum())  # what parted bodies may have been pushed back into
            placed = np.ascontiguousarray(pushed)
            overlapping = max(_sweeps(placed, radius, free, 1), inside)
            if overlapping == 0:
                break
    if overlapping:
        raise PlacementError(
            f"{overlapping} of {len(pos)} bodies still overlap another or an obstacle after {max_sweeps} sweeps: "
            "n_sheep, flock_sd, n_flocks, flock_distance, obstacles and the bodies' radii leave too little room; fewer "
            "or smaller bodies, or a larger flock_sd, make some"
        )
    return placed


@njit(cache=True)
def _sweeps(pos: Floats, radius: Floats, free: Bools, max_sweeps: int) -> int:
    """Sweep in place until nothing overlaps; returns how many bodies did in the last sweep."""
    reach = 2.0 * radius.max() + GAP
    touched = np.zeros(len(pos), np.bool_)
    overlapping = 0
    for _ in range(max_sweeps):
        cells = build(pos, reach) if len(pos) > FEW else one_cell(pos)
        touched[:] = False
        _sweep(cells.columns, cells.rows, cells.start, cells.order, pos, radius, free, touched)
        overlapping = int(touched.sum())
        if overlapping == 0:
            break
    return overlapping


@njit(cache=True)
def _sweep(
    columns: int, rows: int, start: Ints, order: Ints, pos: Floats, radius: Floats, free: Bools, touched: Bools
) -> None:
    """Part all pairs within cells, and those with the cells right of them and above them (arrays of `Cells`)."""
    for cell in range(rows * columns):
        row, column = cell // columns, cell % columns
        for slot in range(start[cell], start[cell + 1]):
            i = order[slot]
            for r in range(row, min(row + 2, rows)):
                first = slot + 1 if r == row else start[r * columns + max(column - 1, 0)]
                for other in range(first, start[r * columns + min(column + 1, columns - 1) + 1]):
                    j = order[other]
                    dx, dy = pos[j, 0] - pos[i, 0], pos[j, 1] - pos[i, 1]
                    wanted = radius[i] + radius[j]
                    square = dx * dx + dy * dy
                    if square >= wanted * wanted:
                        continue
                    touched[i] = touched[j] = True
                    distance = math.sqrt(square)
                    if distance > 0.0:
                        ux, uy = dx / distance, dy / distance
                    else:
                        ux, uy = math.cos(GOLDEN_ANGLE * (i + j)), math.sin(GOLDEN_ANGLE * (i + j))
                    way = OVERSHOOT * (wanted - distance) + GAP
                    share = 0.5 if free[i] == free[j] else (1.0 if free[j] else 0.0)
                    if free[i]:
                        pos[i, 0] -= (1.0 - share) * way * ux
                        pos[i, 1] -= (1.0 - share) * way * uy
                    if free[j]:
                        pos[j, 0] += share * way * ux
                        pos[j, 1] += share * way * uy
