"""`Canvas`: smooth-edged drawing in pixels, without a window or a display; knows nothing of sheep.

Needs pygame-ce (``pip install "shepherd-phys[render]"``), imported when the first canvas is made.

A solid thing is a hull: the convex hull of some points, grown by a radius. A disc is one point, a wall two, a
polygon three or more. Its edge is smoothed by the distance of each pixel's centre to its surface.
"""

from __future__ import annotations

import math
import os
from functools import lru_cache
from io import BytesIO
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shepherd_phys import _pixels

Floats = NDArray[np.float64]
Picture = NDArray[np.uint8]
"""(h, w, 3) red, green, blue; row 0 at the top."""
Size = tuple[int, int]
"""(w, h) [px]."""
Surface = Any
"""A pygame surface. Not named by its type: pygame is imported only when something is drawn."""

SUBPIXELS = 4
"""Places within a pixel where a disc can stand, each way; discs are drawn once for each and kept."""
LETTERING = 3
"""How much larger lettering is set than it is put."""
LARGE = 48
"""[px]: larger discs are not kept."""

TURNS = np.linspace(0, 2 * math.pi, 180, endpoint=False)
ROUND = np.stack([np.cos(TURNS), np.sin(TURNS)], axis=1)
"""(180, 2): a circle of radius 1."""


@lru_cache(maxsize=1)
def pygame_ce() -> Any:
    """Import the drawing library.

    Raises:
        ImportError: it is missing, or is the other pygame; says how to install it.
    """
    os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")  # or it greets on stdout, where commands print JSON
    try:
        import pygame
    except ImportError as error:
        raise ImportError('drawing needs pygame-ce: pip install "shepherd-phys[render]"') from error
    if not getattr(pygame, "IS_CE", False):
        raise ImportError(
            "drawing needs pygame-ce, and pygame stands in its place: pip uninstall pygame, "
            'then pip install --force-reinstall pygame-ce "shepherd-phys[render]"'
        )
    return pygame


@lru_cache(maxsize=256)
def rgb(color: str) -> Floats:
    """Read ``#rrggbb``: (3,), 0 to 255."""
    return np.array([int(color[k : k + 2], 16) for k in (1, 3, 5)], dtype=np.float64)


@lru_cache(maxsize=1024)
def _parts(color: str) -> tuple[float, float, float]:
    red, green, blue = rgb(color).tolist()
    return red, green, blue


@lru_cache(maxsize=1024)
def mixed(color: str, other: str, share: float) -> str:
    """Mix two colours, ``share`` of the other."""
    return "#" + "".join(f"{round(c):02X}" for c in rgb(color) + share * (rgb(other) - rgb(color)))


def coverage(x: Floats, y: Floats, points: Floats, radius: float) -> Floats:
    """How much of each pixel a hull covers, 0 to 1: (h, w).

    Args:
        x: (w,) pixel centres.
        y: (h,) pixel centres.
        points: (K, 2) corners [px], in order.
        radius: by which the hull is grown [px].
    """
    ax, ay = points.T[..., None, None]  # (K, 1, 1): all sides at once
    bx, by = points[[*range(1, len(points)), 0]].T[..., None, None]
    ex, ey, dx, dy = bx - ax, by - ay, x[None, None] - ax, y[None, :, None] - ay
    along = np.minimum(np.maximum((dx * ex + dy * ey) / np.maximum(ex * ex + ey * ey, 1e-12), 0.0), 1.0)
    distance = np.sqrt(((dx - along * ex) ** 2 + (dy - along * ey) ** 2).min(axis=0))
    if len(points) > 2:
        side = dx * ey - dy * ex
        distance[(side > 0).all(axis=0) | (side < 0).all(axis=0)] *= -1
    return np.asarray(np.minimum(np.maximum(radius + 0.5 - distance, 0.0), 1.0))


def _stamp(
    size: Size, points: Floats, radius: float, color: str, edge: str, edge_width: float, alpha: float
) -> Surface:
    """Draw a hull with an edge on a see-through surface of its own."""
    x, y = (np.arange(side, dtype=np.float64) + 0.5 for side in size)
    whole = coverage(x, y, points, radius)[..., None]
    inner = np.minimum(coverage(x, y, points, radius - edge_width)[..., None], whole)
    shade = rgb(edge) * (whole - inner) + rgb(color) * inner  # multiplied by alpha, as the blitter wants it
    pixels = np.rint(np.concatenate([shade[..., ::-1], 255 * whole], axis=-1) * alpha).astype(np.uint8)
    return pygame_ce().image.frombuffer(pixels.tobytes(), size, "BGRA")


@lru_cache(maxsize=4096)
def _disc(half: int, color: str, radius: float, edge: str, edge_width: float, alpha: float) -> list[Surface]:
    """Draw a disc at each place within the pixel ``half`` away from the corner."""
    side = 2 * half + 1
    places = [(half + x / SUBPIXELS, half + y / SUBPIXELS) for y in range(SUBPIXELS) for x in range(SUBPIXELS)]
    return [_stamp((side, side), np.array([at]), radius, color, edge, edge_width, alpha) for at in places]


@lru_cache(maxsize=64)
def _plate(size: Size, corner: float, color: str, edge: str, alpha: float) -> Surface:
    inset, (w, h) = corner + 1, size
    points = np.array([(inset, inset), (w - inset, inset), (w - inset, h - inset), (inset, h - inset)])
    return _stamp(size, points, inset, color, edge, 1.0, alpha)


@lru_cache(maxsize=32)
def _font(height: int) -> Any:
    font = pygame_ce().font
    if not font.get_init():
        font.init()
    return font.Font(None, height)


@lru_cache(maxsize=512)
def lettering(text: str, height: int, color: str) -> Surface:
    """Set a line of text, ``height`` px high.

    Letters stand on whole pixels where they are set, so they are set larger and then made small: they stand evenly.
    """
    large = _font(LETTERING * height).render(text, True, color)
    size = tuple(-(-side // LETTERING) for side in large.get_size())
    return pygame_ce().transform.smoothscale(large, size) if text else large


@lru_cache(maxsize=1)
def _kernels() -> Any:
    """The loops over pixels, compiled by now.

    While numba compiles it keeps hold of what it was called with, and a surface whose pixels are held is locked.
    """
    sheet, ends = np.zeros((4, 4), dtype=np.uint32), np.zeros((1, 2))
    _pixels.fill(sheet, (0, 0), (1, 1), ends, 1.0, (0.0, 0.0, 0.0), 1.0)
    _pixels.stroke(sheet, ends, ends, 1.0, np.ones(1), (0.0, 0.0, 0.0))
    _pixels.read(sheet, np.empty((4, 4, 3), dtype=np.uint8))
    return _pixels


class Canvas:
    """A sheet of pixels. Places are (x, y) to the right and down [px]; pixel (0, 0) covers 0 to 1."""

    def __init__(self, size: Size, color: str) -> None:
        self.size = size
        self.surface = pygame_ce().Surface(size, 0, 32, (0xFF0000, 0xFF00, 0xFF, 0))
        self.surface.fill(color)

    def copy(self) -> Canvas:
        """Copy it, pixels and all."""
        twin = Canvas.__new__(Canvas)
        twin.size, twin.surface = self.size, self.surface.copy()
        return twin

    def hull(self, color: str, points: Floats, radius: float, alpha: float = 1.0) -> None:
        """Draw the convex hull of ``points`` (K, 2), in order, grown by ``radius``."""
        low = np.clip(np.floor(points.min(axis=0) - radius - 1), 0, self.size).astype(int)
        high = np.clip(np.ceil(points.max(axis=0) + radius + 1), 0, self.size).astype(int)
        if (high <= low).any():
            return
        _kernels().fill(
            self._pixels(),
            tuple(low.tolist()),
            tuple(high.tolist()),
            np.ascontiguousarray(points, dtype=float),
            float(radius),
            _parts(color),
            float(alpha),
        )

    def strokes(self, color: str, starts: Floats, ends: Floats, width: float, levels: Floats) -> None:
        """Draw lines from ``starts`` to ``ends`` (K, 2), each as strong as its level (K,), 0 to 1.

        Where they cross or join they do not add up: the strongest counts.
        """
        far = 1e6  # of what is farther away, the direction may suffer
        if len(starts):
            starts, ends = (np.ascontiguousarray(np.clip(at, -far, far)) for at in (starts, ends))
            _kernels().stroke(self._pixels(), starts, ends, width / 2, np.asarray(levels, dtype=float), _parts(color))

    def discs(
        self,
        color: str,
        at: Floats,
        radius: float,
        *,
        edge: str = "",
        edge_width: float = 0.0,
        alpha: float | Floats = 1.0,
    ) -> None:
        """Draw equal discs at (K, 2), optionally with an edge; ``alpha`` may be (K,).

        Places and radius are rounded to quarters of a pixel, alpha to 1/64.
        """
        radius = max(round(radius * SUBPIXELS), 1) / SUBPIXELS
        seen = ((at > -radius - 1) & (at < np.array(self.size) + radius + 1)).all(axis=1)
        at, shares = at[seen], alpha[seen] if isinstance(alpha, np.ndarray) else np.full(seen.sum(), alpha)
        levels = np.rint(shares * 64).astype(int).tolist()
        if radius > LARGE:
            for middle, level in zip(at[:, None], levels, strict=True):
                if edge:
                    self.hull(edge, middle, radius, level / 64)
                self.hull(color, middle, radius - edge_width, level / 64)
            return
        half = math.ceil(radius) + 1
        drawn = {level: _disc(half, color, radius, edge or color, edge_width, level / 64) for level in set(levels)}
        places = np.rint(at * SUBPIXELS).astype(int)
        which = (places % SUBPIXELS @ (1, SUBPIXELS)).tolist()
        corners = (places // SUBPIXELS - half).tolist()
        pairs = [(drawn[level][k], corner) for level, k, corner in zip(levels, which, corners, strict=True)]
        self.surface.fblits(pairs, pygame_ce().BLEND_PREMULTIPLIED)

    def plate(
        self, color: str, left: int, top: int, size: Size, *, corner: float, edge: str, alpha: float = 1.0
    ) -> None:
        """Draw a box with round corners and an edge of 1 px."""
        sprite = _plate(size, corner, color, edge, alpha)
        self.surface.blit(sprite, (left, top), special_flags=pygame_ce().BLEND_PREMULTIPLIED)

    def circle(self, color: str, middle: Floats, radius: float) -> None:
        """Draw a line of 1 px round ``middle`` (2,)."""
        far = np.abs(middle - np.clip(middle, 0, self.size)).max() > radius
        if far or radius > 50 * max(self.size):  # out of sight, or so large that pygame would lose count
            return
        pygame_ce().draw.aalines(self.surface, color, True, (middle - 0.5 + radius * ROUND).tolist())

    def box(self, color: str, left: float, top: float, width: float, height: float) -> None:
        """Fill a box, rounded to whole pixels."""
        self.surface.fill(color, (round(left), round(top), round(width), round(height)))

    def ruling(self, ground: str, color: str, at: Floats, axis: int) -> None:
        """Draw lines of 1 px right across a plain ``ground``, at x (axis 0) or y (axis 1) ``at`` (K,).

        A line between two rows of pixels darkens both, each in its share; crossings do not add up.
        """
        flags = pygame_ce()
        blend = flags.BLEND_RGB_MIN if rgb(color).sum() < rgb(ground).sum() else flags.BLEND_RGB_MAX
        for start in (at - 0.5).tolist():
            row = math.floor(start)
            rest = round((start - row) * 16) / 16  # few shades, each mixed once
            for part, share in ((row, 1 - rest), (row + 1, rest)):
                strip = (part, 0, 1, self.size[1]) if axis == 0 else (0, part, self.size[0], 1)
                self.surface.fill(mixed(ground, color, share), strip, blend)

    def paste(self, other: Canvas, left: int, top: int) -> None:
        """Put another canvas here."""
        self.surface.blit(other.surface, (left, top))

    def put(self, surface: Surface, left: float, top: float) -> None:
        """Put lettering here."""
        self.surface.blit(surface, (round(left), round(top)))

    def picture(self) -> Picture:
        """Copy the pixels: uint8 (h, w, 3)."""
        picture = np.empty((self.size[1], self.size[0], 3), dtype=np.uint8)
        _kernels().read(self._pixels(), picture)
        return picture

    def _pixels(self) -> NDArray[np.uint32]:
        """The pixels themselves, (h, w); they must be let go before pygame draws again."""
        return np.asarray(pygame_ce().surfarray.pixels2d(self.surface)).T


def png(picture: Picture) -> bytes:
    """Encode a picture (h, w, 3) as PNG."""
    pygame, written = pygame_ce(), BytesIO()
    h, w = picture.shape[:2]
    pygame.image.save(pygame.image.frombuffer(picture.tobytes(), (w, h), "RGB"), written, "picture.png")
    return written.getvalue()
