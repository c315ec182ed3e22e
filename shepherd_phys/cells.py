"""Points sorted into the cells of a grid, or all of them into a single cell."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

CELLS_PER_POINT = 16
"""Bound on the number of cells, so that a flock spread over a continent needs no more memory than a tight one."""

OCCUPANCY = 0.09
"""Others in a point's own cell over neighbours wanted (0.05 to 0.15: no difference above the noise)."""


class Cells(NamedTuple):
    """Points sorted into square cells; the cells at the border reach to infinity.

    Points outside the window lie in the nearest border cell: a few stragglers cost time for themselves, not
    memory. Within a cell points keep the order of their indices.
    """

    left: float
    """x of the window's left edge [m]."""
    bottom: float
    """y of the window's lower edge [m]."""
    size: float
    """Side of a cell [m]."""
    columns: int
    rows: int
    start: Ints
    """(rows x columns + 1,) first slot of each cell, row by row."""
    order: Ints
    """(N,) index of the point in each slot."""
    x: Floats
    """(N,) coordinates by slot [m]."""
    y: Floats
    """(N,) [m]"""


@njit(cache=True)
def one_cell(pos: Floats) -> Cells:
    """All points (N, 2) in one cell, in the order of their indices: brute force."""
    start = np.array([0, len(pos)])
    return Cells(0.0, 0.0, 1.0, 1, 1, start, np.arange(len(pos)), pos[:, 0].copy(), pos[:, 1].copy())


@njit(cache=True)
def _window(values: Floats) -> tuple[float, float]:
    """Edges that hold nearly all of the values (N,), found from at most 512 of them: stragglers stay outside."""
    sample = np.sort(values[:: 1 + len(values) // 512])
    last = len(sample) - 1
    low, high = sample[last // 50], sample[last - last // 50]
    reach = 0.25 * (high - low)
    return max(low - reach, values.min()), min(high + reach, values.max())


@njit(cache=True)
def _columns(width: float, size: float, limit: int) -> int:
    return int(min(width / size, float(limit))) + 1


@njit(cache=True)
def _cell(value: float, edge: float, size: float, count: int) -> int:
    return int(min((value - edge) / size, count - 1.0)) if value > edge else 0


@njit(cache=True)
def build(pos: Floats, size: float) -> Cells:
    """Sort points into cells.

    Args:
        pos: (N, 2) points [m], N >= 1.
        size: side of a cell [m]; larger ones are used where it takes more than ``CELLS_PER_POINT`` N cells.
    """
    n = len(pos)
    x, y = pos[:, 0].copy(), pos[:, 1].copy()
    left, right = _window(x)
    bottom, top = _window(y)
    width, height = right - left, top - bottom
    if not (size > 0.0 and 0.0 < width + height < np.inf):  # all in one place, or not finite
        return one_cell(pos)
    limit = CELLS_PER_POINT * n
    while True:
        columns, rows = _columns(width, size, limit), _columns(height, size, limit)
        if columns * rows <= limit:
            break
        size *= max(math.sqrt(columns * rows / limit), 1.01)

    cell = np.empty(n, np.int64)
    start = np.zeros(columns * rows + 1, np.int64)
    for i in range(n):
        cell[i] = _cell(y[i], bottom, size, rows) * columns + _cell(x[i], left, size, columns)
        start[cell[i] + 1] += 1
    for c in range(columns * rows):
        start[c + 1] += start[c]
    free = start[:-1].copy()
    order = np.empty(n, np.int64)
    for i in range(n):
        order[free[cell[i]]] = i
        free[cell[i]] += 1
    return Cells(left, bottom, size, columns, rows, start, order, x[order], y[order])


@njit(cache=True)
def build_for(pos: Floats, n: int) -> Cells:
    """Sort points (N, 2) [m] into cells of the size at which their n nearest are found fastest.

    The size follows the density that a typical point sees; stragglers do not change it. A few rounds of counting
    find it. Tight flocks very far from each other would need more cells than are allowed: theirs are larger and the
    search is slower (10,000 sheep in five flocks over 4 km: 10 times).
    """
    width = np.ptp(np.array(_window(pos[:, 0])))
    height = np.ptp(np.array(_window(pos[:, 1])))
    cells = build(pos, max(width, height) / 32.0)
    wanted = OCCUPANCY * n
    for _ in range(6):
        total = 0.0
        for c in range(len(cells.start) - 1):
            total += float(cells.start[c + 1] - cells.start[c]) ** 2
        others = total / len(pos) - 1.0
        if 0.6 * wanted <= others <= 1.6 * wanted:
            break
        before = cells.size
        cells = build(pos, before * min(max(math.sqrt(wanted / max(others, 1e-9)), 0.125), 4.0))
        if cells.size == before or len(cells.start) == 2:
            break  # as fine, or as coarse, as it gets
    return cells
