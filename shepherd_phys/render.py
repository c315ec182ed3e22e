"""`draw`: a `WorldState` as a picture, without a window or a display; `paint`: the same as a canvas to draw on.

Needs pygame-ce (``pip install "shepherd-phys[render]"``). What stands still (grid, goal, obstacles) is drawn once
for a camera and kept, so a film from one camera is the fastest.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from shepherd_phys.bodies import flies
from shepherd_phys.camera import Camera, Size, checked_size, checked_trails, fit, fitted
from shepherd_phys.canvas import Canvas, Floats, Picture, lettering, mixed, png
from shepherd_phys.files import whole_file
from shepherd_phys.lidar import Scan
from shepherd_phys.outlines import Same, of_body, of_obstacles
from shepherd_phys.overlays import MATTERS, Corner, Seen, draw_beams, draw_panel, extents
from shepherd_phys.palette import THEMES, Theme
from shepherd_phys.scenario import Scenario
from shepherd_phys.state import WorldState, unit

LOOK_AHEAD = 1.0
"""[s]: a shepherd's pointer ends where its velocity takes it in this time."""
BEYOND = 1.5
"""Radii that a shepherd is drawn wide: rotors, wheels and a shadow stand out."""
BESIDE = 6.0
"""[px] that the panel keeps from a shepherd, ring and edge included."""


# --- what stands still ---


def _step(least: float) -> float:
    """Round up to 1, 2, 5, 10, 20, .. [m]."""
    decade = 10.0 ** math.floor(math.log10(least))
    return next(decade * k for k in (1, 2, 5, 10) if decade * k >= least * (1 - 1e-9))


@lru_cache(maxsize=4)
def _ground(size: Size, camera: Camera, goal: tuple[float, float, float], obstacles: Same, name: str) -> Canvas:
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
    for points, radius in of_obstacles(obstacles):
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
    """Draw lines (K, P, 2) [px] that fade towards the past."""
    for p in range(trails.shape[1] if len(trails) else 0):
        path = trails[:, p]
        age = np.linspace(0.0, 1.0, len(path))[1:]  # 0 oldest, 1 now
        canvas.strokes(theme.shepherd(p), path[:-1], path[1:], 2.5, 0.05 + 0.4 * age**1.5)


def _posed(points: Floats, at: Floats, ahead: Floats, scale: float) -> Floats:
    """Points (K, 2) [m] of a body at ``at`` [px], its nose along the unit vector ``ahead`` (2,), y down: [px]."""
    return np.asarray(at + scale * (points[:, :1] * ahead - points[:, 1:] * np.array([-ahead[1], ahead[0]])))


def _draw_sheep(
    canvas: Canvas,
    state: WorldState,
    at: Floats,
    radius: Floats,
    threatened: NDArray[np.bool_],
    bodies: tuple[Any, ...],
    theme: Theme,
) -> None:
    """Draw bodies (N, 2), (N,) [px], then the dark dots that are in front."""
    kind = 2 * state.sheep_arrived + threatened
    ahead = state.sheep_heading * (1, -1)
    radius = np.round(radius * 4) / 4
    face = at + ahead * radius[:, None] * 0.72
    is_disc = np.ones(state.n_sheep, dtype=bool)
    for body in {id(body): body for body in bodies}.values():
        if hulls := of_body(Same(body)):
            for i in (i for i, own in enumerate(bodies) if own is body):
                is_disc[i] = False
                color, scale = theme.sheep[kind[i]], radius[i] / state.sheep_radius[i]
                for points, grown in hulls:
                    corners = _posed(points, at[i], ahead[i], scale)
                    canvas.hull(mixed(color, theme.sheep_face, 0.65), corners, grown * scale)
                    canvas.hull(color, corners, grown * scale - min(max(radius[i] / 5, 0.75), 1.5))
    for size in np.unique(radius[is_disc]).tolist():
        for which in np.unique(kind[is_disc & (radius == size)]).tolist():
            color = theme.sheep[which]
            edge, width = mixed(color, theme.sheep_face, 0.65), min(max(size / 5, 0.75), 1.5)
            canvas.discs(color, at[is_disc & (kind == which) & (radius == size)], size, edge=edge, edge_width=width)
    for size in np.unique(radius).tolist():
        canvas.discs(theme.sheep_face, face[radius == size], 0.36 * size)


def _draw_shepherds(
    canvas: Canvas,
    state: WorldState,
    at: Floats,
    radius: Floats,
    scale: float,
    bodies: tuple[Any, ...],
    chosen: int | None,
    theme: Theme,
) -> None:
    """Draw bodies (P, 2), (P,) [px], a pointer along the velocity, a bright dot where the shepherd looks."""
    speeds = np.hypot(state.shepherd_vel[:, 0], state.shepherd_vel[:, 1])
    moving = speeds > 0.02 * state.shepherd_max_speed
    directions = unit(state.shepherd_vel) * (1, -1) * moving[:, None]
    angle = state.shepherd_angle[:, None]  # 0 for a disc, which looks where it goes
    nose = np.concatenate([np.cos(angle), -np.sin(angle)], axis=1)
    for p, (middle, size, ahead) in enumerate(zip(at, radius.tolist(), directions, strict=True)):
        color, body = theme.shepherd(p), bodies[p] if p < len(bodies) else None
        edge = min(max(size / 5, 0.8), 2.0)
        if p == chosen:
            canvas.discs(theme.ground, middle[None], size + edge + 5, edge=theme.ink, edge_width=1.5)
        if body is not None and flies(body):  # its shadow: it is above all others
            canvas.discs("#000000", middle[None] + size * np.array([0.7, 1.0]), size, alpha=0.22)
        if moving[p]:
            beside = np.array([-ahead[1], ahead[0]]) * size * 0.65
            tip = middle + ahead * (size + speeds[p] * LOOK_AHEAD * scale)
            canvas.hull(color, np.stack([middle + beside, middle - beside, tip]), 0.3)
        hulls = of_body(Same(body)) if body is not None else []
        scaled = size / state.shepherd_radius[p]
        for grow, shade in ((edge, theme.shepherd_edge), (0.0, color)):
            for points, grown in hulls:
                canvas.hull(shade, _posed(points, middle, nose[p], scaled), grown * scaled + grow)
        if not hulls:
            canvas.discs(color, middle[None], size + edge, edge=theme.shepherd_edge, edge_width=edge)
        _draw_drive(canvas, body, middle, size, nose[p], theme)
    look = np.where(angle == 0, directions, nose)
    for size in np.unique(radius).tolist():
        canvas.discs(theme.shepherd_edge, (at + look * size * 0.5)[radius == size], 0.3 * size)


def _draw_drive(canvas: Canvas, body: Any, middle: Floats, size: float, nose: Floats, theme: Theme) -> None:
    """What moves a shepherd of ``size`` [px]: wheels of one that has a track, rotors of one that flies."""
    if body is not None and flies(body):
        for x, y in ((0.9, 0.9), (0.9, -0.9), (-0.9, 0.9), (-0.9, -0.9)):
            canvas.discs(
                theme.ground, middle[None] + np.array([x, y]) * size, 0.45 * size, edge=theme.ink, edge_width=1
            )
    elif hasattr(body, "track"):
        axle, half = body.track / 2 / body.radius, 0.4
        for side in (-axle, axle):
            wheel = _posed(np.array([(-half, side), (half, side)]), middle, nose, size)
            canvas.hull(theme.ink, wheel, max(0.14 * size, 0.75))


def _seen(state: WorldState, camera: Camera, size: Size, reach: Floats, sizes: Floats) -> Seen:
    """What a picture shows, by the radii of sheep and shepherds in it [px]: bodies, pointers, obstacles."""
    scale, to_pixels = size[0] / camera.width, camera.to_pixels
    at, ways = to_pixels(state.shepherd_pos, size), state.shepherd_vel * (1, -1) * LOOK_AHEAD * scale
    round_bodies = extents(at, BEYOND * sizes + BESIDE)
    round_tips = extents(at + ways, sizes + BESIDE)
    shepherds = np.stack(
        [np.minimum(round_bodies[:, 0], round_tips[:, 0]), np.maximum(round_bodies[:, 1], round_tips[:, 1])], axis=1
    )
    goal = to_pixels(state.goal_pos[None], size)
    outlines = [(to_pixels(points, size), radius * scale) for points, radius in of_obstacles(Same(state.obstacles))]
    return Seen(
        np.concatenate([extents(to_pixels(state.sheep_pos, size), reach), shepherds, extents(goal, np.zeros(1))]),
        np.repeat([1.0, MATTERS, MATTERS], [state.n_sheep, state.n_shepherds, 1]),
        np.array([(at.min(axis=0) - grown, at.max(axis=0) + grown) for at, grown in outlines]).reshape(-1, 2, 2),
    )


def draw(state: WorldState, size: Size = (640, 640), **options: Any) -> Picture:
    """Draw the world: the same picture for the same arguments, without a display.

    Args:
        state: what to draw.
        size: (w, h) [px].
        options: as of `paint`.

    Returns:
        uint8 (h, w, 3), the caller's own.

    Raises:
        ValueError: names the argument that is impossible.
        ImportError: pygame-ce is missing; says how to install it.
    """
    return paint(state, size, **options).picture()


def paint(
    state: WorldState,
    size: Size = (640, 640),
    *,
    camera: Camera | None = None,
    scenario: Scenario | None = None,
    trails: Iterable[ArrayLike] | None = None,
    influence_radius: float | None = None,
    start: ArrayLike | None = None,
    scan: Scan | None = None,
    earning: Floats | None = None,
    chosen: int | None = None,
    theme: Literal["light", "dark"] = "light",
    panel: bool | Corner = True,
    rewards: Mapping[str, float] | None = None,
    title: str = "",
) -> Canvas:
    """Draw the world on a canvas of its own, on which the caller may go on drawing.

    Bodies are to scale but never smaller than can be seen. Sheep are warm while wild and cold once they have been in
    the goal, pale while they graze and strong while threatened; the dark dot is in front.

    Args:
        state: what to draw.
        size: (w, h) [px].
        camera: what to show; by default what `fit` finds, anew for each picture.
        scenario: of the state: bodies are drawn by their own shapes. Without it each is the disc that holds it. A state
            does not hold which way a sheep's body is turned: one with corners is drawn along its heading.
        trails: K places of the shepherds, each (P, 2) [m], oldest first: lines that fade towards the past.
        influence_radius: r_s [m]: drawn as a circle round each shepherd, and decides which sheep are threatened.
            Without it, all sheep are drawn as grazing.
        start: (N, 2) where the sheep started [m], as faint dots.
        scan: of the state: beams that hit something, coloured by channel, end where it says.
        earning: (P, B) lengths of the beams that earn reward [m], infinity for the others; drawn stronger.
        chosen: a shepherd to be ringed.
        theme: ``"light"`` or ``"dark"``.
        panel: whether to tell sheep in the goal, time and collisions, in the corner where that hides least. For a film,
            a `Corner` of its own, handed to every picture, changes seldom.
        rewards: what each term has given so far, weighted, for the panel.
        title: lines of text for the upper right; left out where they do not fit beside the panel.

    Raises:
        ValueError: names the argument that is impossible.
        ImportError: pygame-ce is missing; says how to install it.
    """
    size, walked = checked_size(size), checked_trails(trails, state)
    begun = np.empty((0, 2)) if start is None else np.asarray(start, dtype=float)
    if begun.ndim != 2 or begun.shape[1] != 2:
        raise ValueError(f"start: must be (N, 2) (given: {begun.shape})")
    if theme not in THEMES:
        raise ValueError(f"theme: must be one of {', '.join(THEMES)} (given: {theme!r})")
    if influence_radius is not None and not (math.isfinite(influence_radius) and influence_radius > 0):
        raise ValueError(f"influence_radius: must be finite and above 0 (given: {influence_radius!r})")
    if scan is not None and scan.ranges.shape[1] != state.n_shepherds:
        raise ValueError(f"scan: must be of {state.n_shepherds} shepherds (given: {scan.ranges.shape[1]})")
    if earning is not None and (earning.ndim != 2 or len(earning) != state.n_shepherds):
        raise ValueError(f"earning: must be ({state.n_shepherds}, beams) (given: {earning.shape})")
    look, camera = THEMES[theme], camera or fitted(state, size, walked)
    scale = size[0] / camera.width
    sheep, shepherds = camera.to_pixels(state.sheep_pos, size), camera.to_pixels(state.shepherd_pos, size)
    least = float(np.clip(min(size) / 200, 2.0, 4.0))  # radius of the smallest sheep [px]

    gx, gy = state.goal_pos.tolist()
    canvas = _ground(size, camera, (gx, gy, float(state.goal_radius)), Same(state.obstacles), theme).copy()
    threatened = np.zeros(state.n_sheep, dtype=bool)
    if influence_radius is not None:
        between = state.sheep_pos[:, None] - state.shepherd_pos
        threatened |= (np.hypot(between[..., 0], between[..., 1]) <= influence_radius).any(axis=1)
        for p, middle in enumerate(shepherds):
            canvas.circle(mixed(look.ground, look.shepherd(p), 0.4), middle, influence_radius * scale)
    _draw_trails(canvas, camera.to_pixels(walked, size), look)
    canvas.discs(look.ink, camera.to_pixels(begun, size), 0.6 * least, alpha=0.3)
    draw_beams(canvas, state, camera, scan, earning, look)
    flock = scenario.sheep_bodies if scenario is not None else ()
    team = scenario.shepherds if scenario is not None else ()
    reach = np.maximum(state.sheep_radius * scale, least)
    _draw_sheep(canvas, state, sheep, reach, threatened, flock, look)
    sizes = np.maximum(state.shepherd_radius * scale, 1.8 * least)
    _draw_shepherds(canvas, state, shepherds, sizes, scale, team, chosen, look)
    corner = panel if isinstance(panel, Corner) else Corner() if panel else None
    seen = _seen(state, camera, size, reach, sizes)
    draw_panel(canvas, state, seen, rewards, look, corner=corner, title=title)
    return canvas


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


__all__ = ["THEMES", "Camera", "Corner", "Theme", "draw", "fit", "paint", "save_png"]
