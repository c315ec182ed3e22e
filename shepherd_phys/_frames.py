"""Kernels between a scan and an observation: plain arrays in, plain arrays out.

They write into arrays that they are given: to bring a new one back from compiled code costs more than the work.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


@njit(cache=True, error_model="numpy")
def proximities(ranges: Floats, goal_row: int, reach: float, goal_reach: float, out: Any) -> None:
    """Write proximities 1 - d/range (P, channels, beams) of the first readings (>= channels, P, beams) [m]."""
    n_shepherds, n_channels, beams = out.shape
    for c in range(n_channels):
        full = goal_reach if c == goal_row else reach
        for p in range(n_shepherds):
            for k in range(beams):
                near = 1.0 - ranges[c, p, k] / full
                out[p, c, k] = near if near > 0.0 else 0.0


@njit(cache=True, error_model="numpy")
def goal_offsets(rows: Any, row: int, directions: Floats, offsets: Ints) -> None:
    """Find the beam nearest to the circular mean of the lit goal beams.

    Args:
        rows: (P, R, beams) proximities, 0 where nothing is seen.
        row: which of the R reads the goal.
        directions: (2, 2 beams).
        offsets: (P,) overwritten, but kept where nothing is lit, or more than half of the beams: from outside the goal
            at most half of them can be.
    """
    n, _, beams = rows.shape
    for p in range(n):
        cx, cy, lit = 0.0, 0.0, 0
        for k in range(beams):
            if rows[p, row, k] > 0.0:
                lit += 1
                cx += directions[0, k]
                cy += directions[1, k]
        if lit > 0 and 2 * lit <= beams and math.hypot(cx, cy) > 1e-9:
            offsets[p] = int(np.rint(math.atan2(cy, cx) * beams / (2.0 * math.pi))) % beams


@njit(cache=True, error_model="numpy")
def rolled_sectors(rows: Any, offsets: Ints, out: Any) -> None:
    """Roll rows (P, R, beams) float32 so that beam ``offsets[p]`` comes first, and write the greatest of each sector.

    ``out`` is (P, R, sectors) float32; sector j holds beams s j - s // 2 .. of the rolled row, s = beams / sectors.
    Two stretches of 1, 2, 4 .. beams, which may overlap, make a sector.
    """
    n, n_rows, beams = rows.shape
    sectors = out.shape[2]
    size = beams // sectors
    line, spare = np.empty(beams, np.float32), np.empty(beams, np.float32)
    for p in range(n):
        start = (offsets[p] - size // 2) % beams
        for i in range(n_rows):
            row, sector = rows[p, i], out[p, i]
            _copy(row[start:], line)
            _copy(row[:start], line[beams - start :])
            greatest, other, reach = line, spare, 1
            while 2 * reach <= size:
                _greater(greatest, reach, other)
                greatest, other = other, greatest
                reach *= 2
            for j in range(sectors):
                a, b = greatest[size * j], greatest[size * (j + 1) - reach]
                sector[j] = a if a > b else b


@njit(cache=True, error_model="numpy")
def goal_sectors(rows: Any, row: int, directions: Floats, offsets: Ints, out: Any) -> None:
    """Overwrite ``offsets`` as `goal_offsets` does and roll by them as `rolled_sectors` does: one call costs less."""
    goal_offsets(rows, row, directions, offsets)
    rolled_sectors(rows, offsets, out)


@njit(cache=True, error_model="numpy")
def _copy(line: Any, out: Any) -> None:
    """Write ``line`` to where ``out`` begins."""
    for k in range(len(line)):
        out[k] = line[k]


@njit(cache=True, error_model="numpy")
def _greater(line: Any, reach: int, out: Any) -> None:
    """Write the greater of each number and the one ``reach`` further on: a loop that works on many at once."""
    further = line[reach:]
    for k in range(len(further)):
        out[k] = line[k] if line[k] > further[k] else further[k]


@njit(cache=True)
def turned(vectors: Any, cosine: Floats, sine: Floats, out: Any) -> None:
    """Write vectors (P, 2) turned by angles, whose cosines and sines are given (P,)."""
    for p in range(len(vectors)):
        x, y = vectors[p, 0], vectors[p, 1]
        out[p, 0] = cosine[p] * x - sine[p] * y
        out[p, 1] = sine[p] * x + cosine[p] * y
