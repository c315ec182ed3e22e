"""Who is near whom: exact nearest neighbours of every sheep, over all sheep or over the cells of a grid.

Compiled code shared by the flock models and by placement. A flock is sorted into `Cells`; each sheep then looks
through the block of cells that holds its neighbours. Brute force is the same code with one single cell, so both
ways find the same neighbours, to the last tie.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from shepherd_phys.cells import build_for, one_cell

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]
Ints = NDArray[np.int64]

GRID_FROM = 200
"""Sheep from which the grid is faster than brute force (measured: even at 200, a third of the time at 1000)."""

MARGIN = 1.0
"""Caution in choosing blocks; a block that proves too small is enlarged and searched again (0.85 is no faster)."""

LANES = 16
"""Candidate arrays are padded to a multiple of this, so that vectorised loops leave no remainder."""

HUGE = 1.7e308
"""A finite threshold above every finite squared distance; padding has distance infinity and stays above."""


@njit(cache=True)
def _count(d2: Floats, m: int, limit: float) -> int:
    count = 0
    for j in range(m):
        count += 1 if d2[j] <= limit else 0
    return count


@njit(cache=True)
def _next_above(d2: Floats, m: int, limit: float) -> float:
    smallest = np.inf
    for j in range(m):
        smallest = min(smallest, d2[j] if d2[j] > limit else np.inf)
    return smallest


@njit(cache=True)
def threshold(d2: Floats, m: int, n: int, guess: float) -> tuple[float, int]:
    """A value at or below which n of the numbers lie.

    Counting passes, which the compiler vectorises, narrow a bracket by interpolation: about five for 40 of 100
    where a quickselect takes five times as long.

    Args:
        d2: (>= m,) squared distances [m2].
        m: how many of them there are.
        n: how many to take, 1 <= n < m.
        guess: where to start [m2], e.g. what a point nearby needed.

    Returns:
        the value, and how many lie at or below it: n, or more where several equal the value and only some
        of them belong to the n.
    """
    low, n_low = -1.0, 0
    high, n_high = np.inf, m
    value = guess
    passes = 0
    while True:
        count = _count(d2, m, value)
        passes += 1
        if count == n:
            return value, n
        if count < n:
            low, n_low = value, count
        else:
            high, n_high = value, count
        if passes % 8 == 0:  # ties, or numbers spread unevenly: step to the next number that there is
            value = _next_above(d2, m, low)
            count = _count(d2, m, value)
            if count >= n or value == np.inf:  # infinity: some are not numbers; the answer will not be one either
                return value, count
            low, n_low = value, count
        if high == np.inf:
            value = max(low * (n + 1.0) / (n_low + 0.5), 1e-12)
        else:
            part = (n - n_low) / (n_high - n_low) if passes % 4 else 0.5
            base = max(low, 0.0)
            value = base + (high - base) * part


@njit(cache=True)
def _last_tie(d2: Floats, index: Ints, m: int, value: float, room: int) -> int:
    """Index up to which those at distance ``value`` belong to the nearest, ``room`` in number: lower indices first."""
    low, high = -1, 1
    for j in range(m):
        high = max(high, index[j])
    while high - low > 1:
        middle = (low + high) // 2
        count = 0
        for j in range(m):
            count += 1 if (d2[j] == value) & (index[j] <= middle) else 0
        if count >= room:
            high = middle
        else:
            low = middle
    return high


# Reassociation is allowed in this one sum alone: without it the compiler must add one number after the other. The order
# in which neighbours are added has no meaning; on a given machine it is fixed, so results stay reproducible.
@njit(cache=True, fastmath={"reassoc", "nsz"})
def _sum_within(x: Floats, y: Floats, d2: Floats, m: int, xi: float, yi: float, limit: float) -> tuple[float, float]:
    sx, sy = 0.0, 0.0
    for j in range(m):
        sx += x[j] - xi if d2[j] <= limit else 0.0
        sy += y[j] - yi if d2[j] <= limit else 0.0
    return sx, sy


# The functions below take plain arrays: wherever a tuple that holds arrays is handed on, numba counts references to
# each of them, atomically, which takes longer than the work itself (a sweep of placement took 14 times as long).


@njit(cache=True)
def _holds(start: Ints, columns: int, rows: int, row: int, column: int, half: int, n: int) -> bool:
    """Whether the block within ``half`` cells of a cell most likely holds the n nearest of the cell's points."""
    c0, c1 = max(column - half, 0), min(column + half, columns - 1)
    total = 0
    for r in range(max(row - half, 0), min(row + half, rows - 1) + 1):
        total += start[r * columns + c1 + 1] - start[r * columns + c0]
    # at the density of this block, a disc with n points has radius (2 half + 1) sqrt(n / (pi total)) cells
    return total > n and MARGIN * (2 * half + 1) ** 2 * n <= math.pi * total * half * half


@njit(cache=True)
def _block_half(start: Ints, columns: int, rows: int, row: int, column: int, half: int, least: int, n: int) -> int:
    """The smallest half-width [cells], but at least ``least``, at which a block most likely holds what is looked for.

    ``half`` is where to start, e.g. what the cell before needed.
    """
    whole = max(row, rows - 1 - row, column, columns - 1 - column)
    least = min(least, whole)
    half = min(max(half, least), whole)
    grown = False
    while half < whole and not _holds(start, columns, rows, row, column, half, n):
        half += 1
        grown = True
    while not grown and half > least and _holds(start, columns, rows, row, column, half - 1, n):
        half -= 1
    return half


@njit(cache=True)
def _gather(
    start: Ints, xs: Floats, ys: Floats, columns: int, rows: int, row: int, column: int, half: int, x: Floats, y: Floats
) -> tuple[int, int]:
    """Copy a block's points side by side into x, y.

    Returns:
        how many there are, padded with points at infinity; and where the points of the cell itself begin.
    """
    c0, c1 = max(column - half, 0), min(column + half, columns - 1)
    m, home = np.uint64(0), 0  # unsigned: no check for negative indices in the innermost loop
    for r in range(max(row - half, 0), min(row + half, rows - 1) + 1):
        first, end = start[r * columns + c0], start[r * columns + c1 + 1]
        if r == row:
            home = np.int64(m) + start[r * columns + column] - first
        for slot in range(np.uint64(first), np.uint64(end)):
            x[m], y[m] = xs[slot], ys[slot]
            m += np.uint64(1)
    padded = (np.int64(m) + LANES - 1) // LANES * LANES
    for k in range(np.int64(m), padded):
        x[k], y[k] = np.inf, np.inf
    return int(padded), int(home)


@njit(cache=True)
def _label(start: Ints, order: Ints, columns: int, rows: int, row: int, column: int, half: int, index: Ints) -> None:
    """The indices of the points that `_gather` copies: they matter only at ties."""
    c0, c1 = max(column - half, 0), min(column + half, columns - 1)
    m = 0
    for r in range(max(row - half, 0), min(row + half, rows - 1) + 1):
        for slot in range(start[r * columns + c0], start[r * columns + c1 + 1]):
            index[m] = order[slot]
            m += 1
    index[m : m + LANES] = -1


@njit(cache=True)
def _clear(u: float, v: float, columns: int, rows: int, row: int, column: int, half: int) -> float:
    """Distance from a point (u, v) of a cell within which the block round that cell misses nobody [cells]."""
    clear = np.inf  # beyond a border cell there is nothing
    if column - half > 0:
        clear = min(clear, u - (column - half))
    if column + half < columns - 1:
        clear = min(clear, column + half + 1 - u)
    if row - half > 0:
        clear = min(clear, v - (row - half))
    if row + half < rows - 1:
        clear = min(clear, row + half + 1 - v)
    return clear - 1e-6  # rounding may put a point on the other side of a cell's edge


@njit(cache=True)
def _sum_apart(
    x: Floats, y: Floats, d2: Floats, m: int, xi: float, yi: float, r_a: float, hits: Ints
) -> tuple[float, float]:
    """Sum of unit(A_i - A_j) over the points nearer than r_a; ``hits`` is scratch."""
    limit = r_a * r_a
    count = 0
    for j in range(m):  # without a branch: which points are near is unpredictable
        hits[count] = j
        count += 1 if d2[j] < limit else 0
    sx, sy = 0.0, 0.0
    for k in range(count):
        j = hits[k]
        if d2[j] > 0.0:
            scale = 1.0 / math.sqrt(d2[j])
            sx += (xi - x[j]) * scale
            sy += (yi - y[j]) * scale
    return sx, sy


@njit(cache=True)
def _leave_out_ties(d2: Floats, index: Ints, m: int, n: int, limit: float) -> None:
    """Where several points lie at the limit itself, keep the lower indices, as many as make up n."""
    room = n - _count(d2, m, np.nextafter(limit, -1.0))
    last = _last_tie(d2, index, m, limit, room)
    for j in range(m):
        if d2[j] == limit and index[j] > last:
            d2[j] = np.inf


@njit(cache=True)
def surroundings(pos: Floats, wanted: Bools, n: int, r_a: float, use_grid: bool, found: Ints) -> tuple[Floats, Floats]:
    """What each point sees of the others: the n nearest, at any distance, and those within r_a.

    Args:
        pos: (N, 2) points [m].
        wanted: (N,) for which of them.
        n: how many nearest others, clipped to N - 1; at equal distance the lower index is nearer.
        r_a: radius [m]; those nearer than it count.
        use_grid: look through cells instead of through all points. The neighbours are the same; the sums
            are added in another order, so they differ by rounding.
        found: (N, n) receives the indices of the n nearest in increasing order; (0, 0): not asked for.

    Returns:
        (N, 2) sum over the n nearest of A_j - A_i [m]; (N, 2) sum over those within r_a of unit(A_i - A_j). Rows
        not wanted are 0.
    """
    towards, apart = np.zeros((len(pos), 2)), np.zeros((len(pos), 2))
    n = min(n, len(pos) - 1)
    if n > 0:
        cells = build_for(pos, n) if use_grid else one_cell(pos)
        _search(
            cells.left, cells.bottom, cells.size, cells.columns, cells.rows, cells.start, cells.order,
            cells.x, cells.y, wanted, n, r_a, towards, apart, found,
        )  # fmt: skip
    return towards, apart


@njit(cache=True)
def _search(
    left: float, bottom: float, size: float, columns: int, rows: int, start: Ints, order: Ints, xs: Floats, ys: Floats,
    wanted: Bools, n: int, r_a: float, towards: Floats, apart: Floats, found: Ints,
) -> None:  # fmt: skip
    """Fill ``towards``, ``apart`` and ``found`` of `surroundings`, cell by cell."""
    total = len(order)
    x, y, d2 = np.empty(total + LANES), np.empty(total + LANES), np.empty(total + LANES)
    index, hits = np.empty(total + LANES, np.int64), np.empty(total + LANES + 1, np.int64)
    least = int(min(r_a / size, float(columns + rows))) + 1
    half_before, guess = least, size * size
    for cell in range(rows * columns):
        row, column, first = cell // columns, cell % columns, start[cell]
        half, m, home = -1, 0, 0
        for own in range(first, start[cell + 1]):
            i = order[own]
            if not wanted[i]:
                continue
            if half < 0:  # the first of this cell; cells side by side need blocks alike
                half = half_before = _block_half(start, columns, rows, row, column, half_before, least, n)
                m, home = _gather(start, xs, ys, columns, rows, row, column, half, x, y)
            xi, yi = xs[own], ys[own]
            u, v = (xi - left) / size, (yi - bottom) / size
            while True:
                for j in range(m):
                    dx, dy = x[j] - xi, y[j] - yi
                    d2[j] = dx * dx + dy * dy
                d2[home + own - first] = np.inf
                limit, count = (HUGE, n) if n == total - 1 else threshold(d2, m, n, guess)
                clear = _clear(u, v, columns, rows, row, column, half) * size
                if clear == np.inf or (clear > r_a and clear * clear > limit):
                    break
                # n points lie within the limit, so the true neighbours do: this block is certain to hold them
                half += 1 + int(min(math.sqrt(limit) / size, float(columns + rows)))
                m, home = _gather(start, xs, ys, columns, rows, row, column, half, x, y)
            guess = limit
            apart[i, 0], apart[i, 1] = _sum_apart(x, y, d2, m, xi, yi, r_a, hits)
            if count > n or len(found):
                _label(start, order, columns, rows, row, column, half, index)
            if count > n:
                _leave_out_ties(d2, index, m, n, limit)
            towards[i, 0], towards[i, 1] = _sum_within(x, y, d2, m, xi, yi, limit)
            if len(found):
                found[i] = np.sort(index[:m][d2[:m] <= limit])


@njit(cache=True)
def nearest(pos: Floats, n: int, use_grid: bool) -> Ints:
    """The n nearest others of each point, at equal distance those with lower indices.

    Args:
        pos: (N, 2) points [m].
        n: how many, clipped to N - 1.
        use_grid: look through cells instead of through all points; the answer is the same.

    Returns:
        (N, n) indices, increasing in each row.
    """
    found = np.empty((len(pos), max(min(n, len(pos) - 1), 0)), np.int64)
    surroundings(pos, np.ones(len(pos), np.bool_), n, 0.0, use_grid, found)
    return found
