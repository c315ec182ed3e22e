"""`draw`: a `WorldState` as a picture, without a window or a display; `Camera`: which part of the plane it shows.

Needs pygame-ce (``pip install "shepherd-phys[render]"``). What stands still (grid, goal, obstacles) is drawn once
for a camera and kept, so a film from one camera is the fastest.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Iterable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import pymunk
from numpy.typing import ArrayLike, NDArray
from pydantic import BeforeValidator, Field

from shepherd_phys.canvas import Canvas, Floats, Picture, Size, lettering, mixed, png
from shepherd_phys.files import whole_file
from shepherd_phys.obstacles import Obstacle, Point, solid
from shepherd_phys.settings import Settings, settings
from shepherd_phys.state import WorldState, unit

MIN_SIZE, MAX_SIZE = 16, 8192
"""[px] of a picture's sides."""
MIN_VIEW = 8.0
"""[m]: the camera of `fit` comes no nearer."""
LOOK_AHEAD = 1.0
"""[s]: a shepherd's pointer ends where its velocity takes it in this time."""


@dataclass(frozen=True)
class Theme:
    """The colours of a picture, as ``#rrggbb``."""

    ground: str
    grid: tuple[str, str]
    """Of the fine lines and of the others."""
    goal: str
    goal_ring: str
    obstacle: str
    ink: str
    faint_ink: str
    sheep: tuple[str, str, str, str]
    """Wild and grazing, wild and threatened, arrived and grazing, arrived and threatened."""
    sheep_face: str
    shepherds: tuple[str, ...]
    """One for each shepherd, from the first again after the last."""
    shepherd_edge: str


THEMES = {
    "light": Theme(
        ground="#F7F6F2",
        grid=("#F0EEE8", "#E3E0D7"),
        goal="#D3EBD0",
        goal_ring="#5BA567",
        obstacle="#5A6270",
        ink="#2B303A",
        faint_ink="#757A85",
        sheep=("#FFFDF5", "#FFA62B", "#C3ECF5", "#2BA3B8"),
        sheep_face="#343941",
        shepherds=("#2663BF", "#E62E2E", "#9900FF", "#260F26", "#FF6685", "#4C0F00", "#1F0099", "#993D74"),
        shepherd_edge="#FFFFFF",
    ),
    "dark": Theme(
        ground="#14181F",
        grid=("#1A1F28", "#262D39"),
        goal="#1C3D2B",
        goal_ring="#4FBF73",
        obstacle="#586271",
        ink="#E8EAEE",
        faint_ink="#8F98A6",
        sheep=("#F1ECE0", "#FFB347", "#B4E6EF", "#2AA5BC"),
        sheep_face="#0B0E13",
        shepherds=("#0099FF", "#FF5C33", "#CCFF00", "#8533FF", "#33FFAD", "#8C8C8C", "#BF00BF", "#BF634D"),
        shepherd_edge="#FFFFFF",
    ),
}
"""Made for the colour-blind, too: shepherds lie 21 or more apart in CIE Lab under protanopia, deuteranopia and
tritanopia (Machado et al. 2009); wild sheep are warm, arrived ones cold."""


@settings
class Camera(Settings):
    """Which part of the plane a picture shows. Pixels count from its upper left corner, y down."""

    center: Annotated[Point, BeforeValidator(lambda at: at.tolist() if isinstance(at, np.ndarray) else at)]
    """World point in the middle of the picture [m]."""
    width: float = Field(gt=0)
    """From the left border to the right one [m]."""

    def to_pixels(self, points: ArrayLike, size: Size) -> Floats:
        """Where world points (.., 2) [m] lie in a picture of ``size`` (w, h): (.., 2) [px]."""
        w, h = size
        offsets = np.asarray(points, dtype=float) - self.center
        return np.asarray(offsets * (w / self.width, -w / self.width) + (w / 2, h / 2))

    def to_world(self, pixels: ArrayLike, size: Size) -> Floats:
        """Reverse `to_pixels`: (.., 2) [px] -> (.., 2) [m]."""
        w, h = size
        offsets = np.asarray(pixels, dtype=float) - (w / 2, h / 2)
        return np.asarray(offsets * (self.width / w, -self.width / w) + self.center)


def fit(
    state: WorldState, size: Size = (640, 640), *, trails: Iterable[ArrayLike] | None = None, margin: float = 0.06
) -> Camera:
    """Find the camera that sees all sheep, all shepherds, the goal and the trails.

    It moves as smoothly as they do. For a film, take it once, of the first state, and hand it to every `draw`.

    Args:
        state: what is to be seen.
        size: (w, h) of the picture [px].
        trails: as in `draw`.
        margin: free border on each side, as a fraction of the picture, 0 to below 0.5.

    Raises:
        ValueError: names the argument that is impossible.
    """
    if not 0 <= margin < 0.5:
        raise ValueError(f"margin: must be from 0 to below 0.5 (given: {margin!r})")
    return _fit(state, _checked_size(size), _checked_trails(trails, state), margin)


def _fit(state: WorldState, size: Size, trails: Floats, margin: float = 0.06) -> Camera:
    points = np.concatenate([state.sheep_pos, state.shepherd_pos, state.goal_pos[None]])
    reach = np.concatenate([state.sheep_radius, state.shepherd_radius, [state.goal_radius]])[:, None]
    low = np.concatenate([points - reach, trails.reshape(-1, 2)]).min(axis=0)
    high = np.concatenate([points + reach, trails.reshape(-1, 2)]).max(axis=0)
    aspect = size[0] / size[1]
    width, height = (high - low).tolist()
    x, y = ((low + high) / 2).tolist()
    return Camera(center=(x, y), width=max(max(width, height * aspect) / (1 - 2 * margin), MIN_VIEW * max(aspect, 1)))


def _checked_size(size: Size) -> Size:
    try:
        w, h = (operator.index(side) for side in size)
    except (TypeError, ValueError):
        w = h = 0
    if not (MIN_SIZE <= w <= MAX_SIZE and MIN_SIZE <= h <= MAX_SIZE):
        raise ValueError(f"size: must be (width, height) in whole pixels, {MIN_SIZE} to {MAX_SIZE} (given: {size!r})")
    return w, h


def _checked_trails(trails: Iterable[ArrayLike] | None, state: WorldState) -> Floats:
    """(K, P, 2): the trails with the shepherds' present places at their end; K = 0 without trails."""
    shape = state.shepherd_pos.shape
    past = [np.asarray(places, dtype=float) for places in (() if trails is None else trails)]
    for places in past:
        if places.shape != shape:
            raise ValueError(f"trails: each must be {shape}, one place a shepherd (given: {places.shape})")
    return np.stack([*past, state.shepherd_pos]) if past else np.empty((0, *shape))


# --- what stands still ---


class _Same:
    """Makes any object a key of a cache, equal to itself alone: a user's obstacle need not be hashable."""

    def __init__(self, value: Any) -> None:
        self.value = value

    def __hash__(self) -> int:
        return id(self.value)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Same) and other.value is self.value


@lru_cache(maxsize=16)
def _hulls(obstacles: _Same) -> list[tuple[Floats, float]]:
    """Points (K, 2) and radius [m] of every shape of the obstacles, whatever class they are of."""
    body = pymunk.Space().static_body
    hulls: list[tuple[Floats, float]] = []
    given: tuple[Obstacle, ...] = obstacles.value
    for shape in (shape for index, one in enumerate(given) for shape in solid(one, index, body)):
        if isinstance(shape, pymunk.Circle):
            hulls.append((np.array([shape.offset], dtype=float), shape.radius))
        elif isinstance(shape, pymunk.Segment):
            hulls.append((np.array([shape.a, shape.b], dtype=float), shape.radius))
        elif isinstance(shape, pymunk.Poly):
            hulls.append((np.array(shape.get_vertices(), dtype=float), shape.radius))
    return hulls


def _step(least: float) -> float:
    """Round up to 1, 2, 5, 10, 20, .. [m]."""
    decade = 10.0 ** math.floor(math.log10(least))
    return next(decade * k for k in (1, 2, 5, 10) if decade * k >= least * (1 - 1e-9))


@lru_cache(maxsize=4)
def _ground(size: Size, camera: Camera, goal: tuple[float, float, float], obstacles: _Same, name: str) -> Canvas:
    """Draw grid, goal (x, y, radius) [m], obstacles and scale bar."""
    theme, (w, h), scale = THEMES[name], size, size[0] / camera.width
    canvas = Canvas(size, theme.ground)
    spacing = _step(max(w / 10, 40) / scale)
    low, high = camera.to_world([(0, h), (w, 0)], size)
    for color, every in zip(theme.grid, (spacing / 5, spacing), strict=True):
        for axis in (0, 1):
            lines = np.arange(math.floor(low[axis] / every), math.ceil(high[axis] / every) + 1) * every
            at = camera.to_pixels(np.stack([lines, lines], axis=1), size)[:, axis]
            canvas.ruling(theme.ground, color, at, axis)

    middle = camera.to_pixels([goal[:2]], size)
    canvas.hull(theme.goal_ring, middle, goal[2] * scale + 1)
    canvas.hull(theme.goal, middle, goal[2] * scale - 1)
    for points, radius in _hulls(obstacles):
        canvas.hull(theme.obstacle, camera.to_pixels(points, size), max(radius * scale, 0.75))

    left, bottom, length = 12, h - 12, spacing * scale
    label = lettering(f"{spacing:g} m" if spacing < 1000 else f"{spacing / 1000:g} km", 16, theme.faint_ink)
    if left + length < w - 12 and h >= 100:
        for bar in ((left, 2, length, 2), (left, 6, 2, 6), (left + length - 2, 6, 2, 6)):
            canvas.box(theme.faint_ink, bar[0], bottom - bar[1], bar[2], bar[3])
        canvas.put(label, left + (length - label.get_width()) / 2, bottom - 6 - label.get_height())
    return canvas


# --- what moves ---


def _draw_trails(canvas: Canvas, trails: Floats, theme: Theme) -> None:
    """Draw lines (K, P, 2) [px] that fade towards the past, made of dots a pixel apart."""
    for p in range(trails.shape[1] if len(trails) else 0):
        path = trails[:, p]
        walked = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(path, axis=0).T))])
        dots = np.linspace(0.0, walked[-1], int(np.clip(walked[-1], 2, 4000)))
        at = np.stack([np.interp(dots, walked, path[:, k]) for k in (0, 1)], axis=1)
        age = np.interp(dots, walked, np.linspace(0.0, 1.0, len(path)))  # 0 oldest, 1 now
        canvas.discs(_color(theme, p), at, 1.25, alpha=0.03 + 0.27 * age**1.5)


def _draw_sheep(
    canvas: Canvas, state: WorldState, at: Floats, radius: Floats, threatened: NDArray[np.bool_], theme: Theme
) -> None:
    """Draw bodies (N, 2), (N,) [px], then the dark dots that are in front."""
    kind = 2 * state.sheep_arrived + threatened
    radius = np.round(radius * 4) / 4
    face = at + state.sheep_heading * (1, -1) * radius[:, None] * 0.72
    for size in np.unique(radius).tolist():
        for which in np.unique(kind[radius == size]).tolist():
            color = theme.sheep[which]
            edge, width = mixed(color, theme.sheep_face, 0.65), min(max(size / 5, 0.75), 1.5)
            canvas.discs(color, at[(kind == which) & (radius == size)], size, edge=edge, edge_width=width)
    for size in np.unique(radius).tolist():
        canvas.discs(theme.sheep_face, face[radius == size], 0.36 * size)


def _draw_shepherds(canvas: Canvas, state: WorldState, at: Floats, radius: Floats, scale: float, theme: Theme) -> None:
    """Draw discs (P, 2), (P,) [px], a pointer along the velocity, a bright dot where the shepherd looks."""
    speeds = np.hypot(state.shepherd_vel[:, 0], state.shepherd_vel[:, 1])
    moving = speeds > 0.02 * state.shepherd_max_speed
    directions = unit(state.shepherd_vel) * (1, -1) * moving[:, None]
    for p, (middle, size, ahead) in enumerate(zip(at, radius.tolist(), directions, strict=True)):
        if moving[p]:
            beside = np.array([-ahead[1], ahead[0]]) * size * 0.65
            tip = middle + ahead * (size + speeds[p] * LOOK_AHEAD * scale)
            canvas.hull(_color(theme, p), np.stack([middle + beside, middle - beside, tip]), 0.3)
        edge = min(max(size / 5, 0.8), 2.0)
        canvas.discs(_color(theme, p), middle[None], size + edge, edge=theme.shepherd_edge, edge_width=edge)
    angle = state.shepherd_angle[:, None]  # 0 for a disc, which looks where it goes
    look = np.where(angle == 0, directions, np.concatenate([np.cos(angle), -np.sin(angle)], axis=1))
    for size in np.unique(radius).tolist():
        canvas.discs(theme.shepherd_edge, (at + look * size * 0.5)[radius == size], 0.3 * size)


def _color(theme: Theme, shepherd: int) -> str:
    return theme.shepherds[shepherd % len(theme.shepherds)]


def _draw_panel(canvas: Canvas, state: WorldState, theme: Theme) -> None:
    """Tell, in the upper left: sheep in the goal, in numbers and as a bar; the time; collisions if any."""
    w, h = canvas.size
    big = int(np.clip(min(w, h) / 19, 18, 36))
    small, gap = max(round(big * 0.58), 14), round(big / 3)
    inside, hits = int(state.sheep_in_goal.sum()), int(state.collisions)
    count = lettering(f"{inside}/{state.n_sheep}", big, theme.ink)
    label = lettering("in the goal", small, theme.faint_ink)
    clock = lettering(f"{state.time:.1f} s", small, theme.faint_ink)
    counter = lettering(f"{hits} collision{'s' * (hits != 1)}" if hits else " ", small, theme.faint_ink)
    inner = max(count.get_width() + gap + label.get_width(), clock.get_width() + 2 * gap + counter.get_width())
    width, height = inner + 2 * gap, count.get_height() + clock.get_height() + 3 * gap + 4
    if 20 + width > w or 20 + height > h / 2:
        return
    # what walks behind the panel shows through
    canvas.plate(theme.ground, 10, 10, (width, height), corner=gap / 2, edge=theme.grid[1], alpha=0.85)
    x, y = 10 + gap, 10 + gap
    canvas.put(count, x, y)
    canvas.put(label, x + count.get_width() + gap, y + count.get_height() - label.get_height() - big // 12)
    y += count.get_height() + gap // 2 + 2
    canvas.box(theme.grid[1], x, y - 2, inner, 4)
    canvas.box(theme.goal_ring, x, y - 2, inner * inside / state.n_sheep, 4)
    y += gap // 2 + 2
    canvas.put(clock, x, y)
    canvas.put(counter, x + inner - counter.get_width(), y)


def draw(
    state: WorldState,
    size: Size = (640, 640),
    *,
    camera: Camera | None = None,
    trails: Iterable[ArrayLike] | None = None,
    influence_radius: float | None = None,
    start: ArrayLike | None = None,
    theme: Literal["light", "dark"] = "light",
    panel: bool = True,
) -> Picture:
    """Draw the world: the same picture for the same arguments, without a display.

    Bodies are to scale (the disc that holds them) but never smaller than can be seen. Sheep are warm while wild and
    cold once they have been in the goal, pale while they graze and strong while threatened; the dark dot is in front.

    Args:
        state: what to draw.
        size: (w, h) [px].
        camera: what to show; by default what `fit` finds, anew for each picture.
        trails: K places of the shepherds, each (P, 2) [m], oldest first: lines that fade towards the past.
        influence_radius: r_s [m]: drawn as a circle round each shepherd, and decides which sheep are threatened.
            Without it, all sheep are drawn as grazing.
        start: (N, 2) where the sheep started [m], as faint dots.
        theme: ``"light"`` or ``"dark"``.
        panel: whether to tell sheep in the goal, time and collisions.

    Returns:
        uint8 (h, w, 3), the caller's own.

    Raises:
        ValueError: names the argument that is impossible.
        ImportError: pygame-ce is missing; says how to install it.
    """
    size, walked = _checked_size(size), _checked_trails(trails, state)
    begun = np.empty((0, 2)) if start is None else np.asarray(start, dtype=float)
    if begun.ndim != 2 or begun.shape[1] != 2:
        raise ValueError(f"start: must be (N, 2) (given: {begun.shape})")
    if theme not in THEMES:
        raise ValueError(f"theme: must be one of {', '.join(THEMES)} (given: {theme!r})")
    if influence_radius is not None and not (math.isfinite(influence_radius) and influence_radius > 0):
        raise ValueError(f"influence_radius: must be finite and above 0 (given: {influence_radius!r})")
    look, camera = THEMES[theme], camera or _fit(state, size, walked)
    scale = size[0] / camera.width
    sheep, shepherds = camera.to_pixels(state.sheep_pos, size), camera.to_pixels(state.shepherd_pos, size)
    least = float(np.clip(min(size) / 200, 2.0, 4.0))  # radius of the smallest sheep [px]

    gx, gy = state.goal_pos.tolist()
    canvas = _ground(size, camera, (gx, gy, float(state.goal_radius)), _Same(state.obstacles), theme).copy()
    threatened = np.zeros(state.n_sheep, dtype=bool)
    if influence_radius is not None:
        between = state.sheep_pos[:, None] - state.shepherd_pos
        threatened |= (np.hypot(between[..., 0], between[..., 1]) <= influence_radius).any(axis=1)
        for p, middle in enumerate(shepherds):
            canvas.circle(mixed(look.ground, _color(look, p), 0.4), middle, influence_radius * scale)
    _draw_trails(canvas, camera.to_pixels(walked, size), look)
    canvas.discs(look.ink, camera.to_pixels(begun, size), 0.6 * least, alpha=0.3)
    _draw_sheep(canvas, state, sheep, np.maximum(state.sheep_radius * scale, least), threatened, look)
    _draw_shepherds(canvas, state, shepherds, np.maximum(state.shepherd_radius * scale, 1.8 * least), scale, look)
    if panel:
        _draw_panel(canvas, state, look)
    return canvas.picture()


def save_png(picture: Picture, path: str | Path) -> None:
    """Write a picture (h, w, 3) as PNG; the file appears whole or not at all.

    Raises:
        ValueError: it is not a picture.
        OSError: the file cannot be written; names it.
    """
    fits = isinstance(picture, np.ndarray) and picture.dtype == np.uint8 and picture.shape[2:] == (3,)
    if not fits or not picture.size:
        raise ValueError("picture: must be uint8 (h, w, 3), as draw gives it")
    written, path = png(picture), Path(path)
    try:
        with whole_file(path) as part:
            part.write_bytes(written)
    except OSError as error:
        raise OSError(error.errno, f"picture cannot be written ({error.strerror})", str(path)) from None
