"""Compiled loops over pixels: fill a hull, lay strokes, read a picture. A pixel is 0xRRGGBB in a uint32 (h, w)."""

from __future__ import annotations

import math

import numba
import numpy as np


@numba.njit(cache=True)
def _blend(pixel, red, green, blue, share):  # type: ignore[no-untyped-def]
    old_red, old_green, old_blue = (pixel >> 16) & 0xFF, (pixel >> 8) & 0xFF, pixel & 0xFF
    r = int(old_red + (red - old_red) * share + 0.5)
    g = int(old_green + (green - old_green) * share + 0.5)
    b = int(old_blue + (blue - old_blue) * share + 0.5)
    return np.uint32((r << 16) | (g << 8) | b)


@numba.njit(cache=True)
def fill(pixels, low, high, points, radius, color, alpha):  # type: ignore[no-untyped-def]
    """Draw the convex hull of ``points`` (K, 2) [px], grown by ``radius``, on the columns and rows low to high.

    An edge is smoothed by the distance of a pixel's centre to the surface. A radius below 0 makes a polygon smaller.
    """
    red, green, blue = color
    n = len(points)
    for row in range(low[1], high[1]):
        y = row + 0.5
        for column in range(low[0], high[0]):
            x = column + 0.5
            nearest, left, right = np.inf, True, True
            for k in range(n):
                ax, ay = points[k]
                bx, by = points[(k + 1) % n]
                ex, ey, dx, dy = bx - ax, by - ay, x - ax, y - ay
                along = min(max((dx * ex + dy * ey) / max(ex * ex + ey * ey, 1e-12), 0.0), 1.0)
                nearest = min(nearest, (dx - along * ex) ** 2 + (dy - along * ey) ** 2)
                side = dx * ey - dy * ex
                left, right = left and side > 0, right and side < 0
            distance = math.sqrt(nearest)
            if n > 2 and (left or right):
                distance = -distance
            share = min(max(radius + 0.5 - distance, 0.0), 1.0) * alpha
            if share > 0.0:
                pixels[row, column] = _blend(pixels[row, column], red, green, blue, share)


@numba.njit(cache=True)
def stroke(pixels, starts, ends, half, levels, color):  # type: ignore[no-untyped-def]
    """Draw lines from ``starts`` to ``ends`` (K, 2) [px], 2 ``half`` wide, each as strong as its level (K,), 0 to 1.

    Where lines cross or join they do not add up: the strongest counts.
    """
    red, green, blue = color
    h, w = pixels.shape
    top, bottom, left, right = float(h), 0.0, float(w), 0.0
    for k in range(len(starts)):
        left, right = min(left, starts[k, 0], ends[k, 0]), max(right, starts[k, 0], ends[k, 0])
        top, bottom = min(top, starts[k, 1], ends[k, 1]), max(bottom, starts[k, 1], ends[k, 1])
    x0, x1 = int(max(left - half - 2.0, 0.0)), int(min(max(right + half + 2.0, 0.0), float(w)))
    y0, y1 = int(max(top - half - 2.0, 0.0)), int(min(max(bottom + half + 2.0, 0.0), float(h)))
    if x1 <= x0 or y1 <= y0:
        return
    mask = np.zeros((y1 - y0, x1 - x0), np.float32)
    for k in range(len(starts)):
        ax, ay = starts[k]
        ex, ey = ends[k, 0] - ax, ends[k, 1] - ay
        length = max(math.hypot(ex, ey), 1e-9)
        steep = abs(ey) > abs(ex)
        # walk along the longer axis; across it, only as many pixels as the line is wide there
        main, other = (ay, ax) if steep else (ax, ay)
        run, rise = (ey, ex) if steep else (ex, ey)
        size, breadth = (h, w) if steep else (w, h)
        slope = rise / run if abs(run) > 1e-9 else 0.0
        reach = (half + 0.5) * math.sqrt(1.0 + slope * slope) + 1.0
        first = min(max(min(main, main + run) - half - 1.0, 0.0), float(size))
        last = min(max(max(main, main + run) + half + 1.0, 0.0), float(size))
        for i in range(int(first), math.ceil(last)):
            middle = other + (min(max(i + 0.5, min(main, main + run)), max(main, main + run)) - main) * slope
            low = min(max(middle - reach, 0.0), float(breadth))
            high = min(max(middle + reach, 0.0), float(breadth))
            for j in range(int(low), math.ceil(high)):
                row, column = (i, j) if steep else (j, i)
                if not (y0 <= row < y1 and x0 <= column < x1):
                    continue
                dx, dy = column + 0.5 - ax, row + 0.5 - ay
                along = min(max((dx * ex + dy * ey) / (length * length), 0.0), 1.0)
                distance = math.hypot(dx - along * ex, dy - along * ey)
                share = np.float32(min(max(half + 0.5 - distance, 0.0), 1.0) * levels[k])
                if share > mask[row - y0, column - x0]:
                    mask[row - y0, column - x0] = share
    for row in range(y0, y1):
        for column in range(x0, x1):
            share = mask[row - y0, column - x0]
            if share > 0.0:
                pixels[row, column] = _blend(pixels[row, column], red, green, blue, share)


@numba.njit(cache=True)
def read(pixels, picture):  # type: ignore[no-untyped-def]
    """Take the pixels apart: (h, w) -> uint8 (h, w, 3)."""
    for row in range(pixels.shape[0]):
        for column in range(pixels.shape[1]):
            pixel = pixels[row, column]
            picture[row, column, 0] = (pixel >> 16) & 0xFF
            picture[row, column, 1] = (pixel >> 8) & 0xFF
            picture[row, column, 2] = pixel & 0xFF
