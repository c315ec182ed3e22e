"""Draw the paths of an episode, and maps of where many go. Needs matplotlib (the ``analysis`` extra)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import LinearSegmentedColormap, LogNorm, Normalize
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Polygon

from shepherd_phys.obstacles import Obstacle, outlines
from shepherd_phys.outlines import edge
from shepherd_phys.placement import flock_of
from shepherd_phys.render import THEMES
from shepherd_phys.state import Floats

from .figures import BLUE, GREEN, GREY, ORANGE, PURPLE, SKY, heading, picture, told
from .paths import REACH, Frame, Map, Walks, Who
from .points import Point

LOOK = THEMES["light"]
"""The colours of the pictures of `shepherd_phys.render`: a shepherd is the same in all of them."""
FLOCKS = (ORANGE, SKY, GREEN, PURPLE, GREY, BLUE)
TIME = LinearSegmentedColormap.from_list("time", ["#F6D98B", "#F0A24B", "#8FBF9F", "#3A9AB0", "#1D5C7A"])
"""Of the sheep: warm while the episode is young, cold when it is old; lighter than any shepherd."""
ARC = 36
"""Corners of a full turn of what is round."""
PIECES = 60
"""Of a sheep's path, each of one colour."""
DECADES = 1e5
"""Places are told apart that differ by up to this factor."""
SIDE = 7.0
"""Of the longer side of what is shown [in]."""

Coloring = Literal["time", "flock"]


def draw_trajectories(point: Point, seed: int, walk: Walks, coloring: Coloring, kind: str) -> bytes:
    """One episode's paths, overlaid: sheep faint, shepherds strong; starts hollow, ends solid.

    Args:
        point: what was run.
        seed: the env's.
        walk: its paths.
        coloring: of the sheep: by time, or by the flock in which each began.
        kind: of file, see `shepherd_phys.scripts.figures.KINDS`.
    """
    goal, radius = walk.start.goal_pos, walk.start.goal_radius
    seen = np.concatenate(
        [walk.sheep.reshape(-1, 2), walk.shepherds.reshape(-1, 2), goal - radius, goal + radius], axis=None
    )
    low, high = seen.reshape(-1, 2).min(axis=0) - 1.5, seen.reshape(-1, 2).max(axis=0) + 1.5
    width, height = SIDE * (high - low) / max(high - low)
    with picture(kind, (max(width, 4.2) + (1.6 if coloring == "time" else 0.8), max(height, 2.5) + 1.6)) as drawn:
        axes = drawn.figure.subplots()
        _ground(axes, goal, radius, corners(walk.start.obstacles))
        if coloring == "time":
            _by_time(axes, walk)
        else:
            flocks = flock_of(walk.start.n_sheep, point.scenario.n_flocks, point.scenario.flock_sizes)
            for k in range(point.scenario.n_flocks):
                own = [walk.sheep[:, i] for i in np.flatnonzero(flocks == k)]
                color = FLOCKS[k % len(FLOCKS)]
                axes.add_collection(LineCollection(own, colors=color, linewidths=0.5, alpha=0.45, zorder=3))
                _dots(
                    axes,
                    walk.sheep[0, flocks == k],
                    s=7,
                    facecolors="white",
                    edgecolors=color,
                    linewidths=0.6,
                    zorder=4,
                )
                _dots(axes, walk.sheep[-1, flocks == k], s=7, color=color, linewidths=0.0, zorder=4)
        handles = [_mark("white", LOOK.ink, "start"), _mark(LOOK.ink, LOOK.ink, "end")]
        for p in range(walk.start.n_shepherds):
            color, path = LOOK.shepherds[p % len(LOOK.shepherds)], walk.shepherds[:, p]
            axes.plot(*path.T, color="white", linewidth=2.6, alpha=0.6, zorder=5)
            axes.plot(*path.T, color=color, linewidth=1.2, zorder=6)
            _dots(axes, path[0], s=55, facecolors="white", edgecolors=color, linewidths=1.6, zorder=7)
            _dots(axes, path[-1], s=55, color=color, edgecolors="white", linewidths=0.8, zorder=8)
            handles.append(Line2D([], [], color=color, linewidth=1.6, label=f"shepherd {p + 1}"))
        if coloring == "flock":
            handles += [
                Line2D([], [], color=FLOCKS[k % len(FLOCKS)], linewidth=1.6, label=f"flock {k + 1}")
                for k in range(point.scenario.n_flocks)
            ]
        handles.append(_mark(LOOK.goal, LOOK.goal_ring, "goal"))
        if walk.start.obstacles:
            handles.append(Line2D([], [], color=LOOK.obstacle, linewidth=4.0, label="obstacle"))
        _metres(axes, "x, m", "y, m")
        axes.set_xlim(low[0], high[0])
        axes.set_ylim(low[1], high[1])
        heading(drawn.figure, _told(point, seed, walk))
        columns = max(2, min(len(handles), int(drawn.figure.get_figwidth() * 0.85)))
        drawn.figure.legend(handles=handles, loc="outside lower center", ncols=columns, frameon=False, fontsize=9)
    return drawn.content


def draw_maps(found: Sequence[Map], who: Who, frame: Frame, about: str, goal_radius: float, kind: str) -> bytes:
    """A map a controller, of seconds per square metre, all with the same colours.

    Args:
        found: at least one.
        who: walked.
        frame: in which.
        about: the scenario in words.
        goal_radius: [m].
        kind: of file.
    """
    columns = min(3, len(found))
    rows = math.ceil(len(found) / columns)
    entered = np.concatenate([one.seconds[one.seconds > 0.0] for one in found])
    most = float(entered.max(initial=0.0)) or 1.0
    norm = LogNorm(max(float(entered.min(initial=most)), most / DECADES), 1.001 * most)
    with picture(kind, (3.4 * columns + 1.3, 3.35 * rows + 0.8)) as drawn:
        grid = drawn.figure.subplots(rows, columns, squeeze=False, sharex=True, sharey=True)
        for axes in grid.ravel()[len(found) :]:
            axes.set_visible(False)
        for k, (axes, one) in enumerate(zip(grid.ravel(), found, strict=False)):
            shown = np.ma.masked_equal(one.seconds, 0.0)
            image = axes.imshow(
                shown,
                origin="lower",
                extent=(-REACH, REACH, -REACH, REACH),
                norm=norm,
                cmap="magma_r",
                interpolation="nearest",
            )
            axes.add_patch(Circle((0.0, 0.0), goal_radius, facecolor="none", edgecolor=LOOK.goal_ring, linewidth=1.4))
            axes.set_title(f"{one.controller}: {one.in_goal_end:.1f} % home", fontsize=10, loc="left")
            last = k + columns >= len(found)
            _metres(axes, "x from the goal, m" if last else "", "y from the goal, m" if k % columns == 0 else "")
            axes.tick_params(labelbottom=last)
        bar = drawn.figure.colorbar(image, ax=grid, shrink=0.85, aspect=30, pad=0.02)
        bar.set_label(f"time of a {'sheep' if who == 'sheep' else 'shepherd'} in an episode, s per m²", fontsize=9)
        bar.ax.tick_params(labelsize=9)
        where = "; turned so that the sheep's centroid starts straight up" if frame == "flock" else ""
        heading(drawn.figure, f"{about}; {found[0].trials} episodes{where}")
    return drawn.content


def corners(obstacles: Sequence[Obstacle]) -> list[Floats]:
    """Corners (K, 2) [m] of every shape of the obstacles, round ones as polygons."""
    return [edge(shape, ARC) for index, one in enumerate(obstacles) for shape in outlines(one, index)]


def _ground(axes: Axes, goal: Floats, radius: float, stones: Sequence[Floats]) -> None:
    axes.set_axisbelow(True)
    axes.grid(color="#ececec", linewidth=0.6)
    axes.add_patch(Circle(tuple(goal), radius, facecolor=LOOK.goal, edgecolor=LOOK.goal_ring, linewidth=1.4, zorder=2))
    for stone in stones:
        axes.add_patch(Polygon(stone, facecolor=LOOK.obstacle, edgecolor=LOOK.obstacle, linewidth=1.2, zorder=9))


def _by_time(axes: Axes, walk: Walks) -> None:
    """The sheep, each path in pieces that are as old as their colour."""
    last = len(walk.sheep) - 1
    length = math.ceil(last / PIECES)
    norm = Normalize(0.0, last * walk.start.control_dt)
    pieces, times = [], []
    for begin in range(0, last, length):
        part = walk.sheep[begin : begin + length + 1]
        pieces += list(part.transpose(1, 0, 2))
        times += [begin * walk.start.control_dt] * part.shape[1]
    lines = LineCollection(pieces, array=times, cmap=TIME, norm=norm, linewidths=0.6, alpha=0.6, zorder=3)
    lines.set_rasterized(True)
    axes.add_collection(lines)
    _dots(axes, walk.sheep[0], s=8, facecolors="white", edgecolors=TIME(0.15), linewidths=0.6, zorder=4)
    _dots(axes, walk.sheep[-1], s=8, color=TIME(1.0), linewidths=0.0, zorder=4)
    scale = axes.figure.colorbar(ScalarMappable(norm, TIME), ax=axes, shrink=0.7, aspect=30, pad=0.02)
    scale.set_label("sheep: time, s", fontsize=9)
    scale.ax.tick_params(labelsize=9)


def _dots(axes: Axes, places: Floats, **look: Any) -> None:
    """Discs at (K, 2) or one at (2,)."""
    x, y = np.atleast_2d(places).T
    axes.scatter(x, y, **look)


def _mark(face: str, edge: str, label: str) -> Line2D:
    return Line2D(
        [], [], marker="o", color="none", markeredgecolor=edge, markerfacecolor=face, markersize=7, label=label
    )


def _metres(axes: Axes, x: str, y: str) -> None:
    axes.set_aspect("equal")
    axes.set_xlabel(x, fontsize=10)
    axes.set_ylabel(y, fontsize=10)
    axes.tick_params(labelsize=9)
    axes.spines[["top", "right"]].set_visible(False)


def _told(point: Point, seed: int, walk: Walks) -> str:
    row = walk.row
    home = f"{row['in_goal_end']:.0f} % of the sheep in the goal at the end"
    when = f"95 % in after {row['time_to_95']:.0f} s" if row["reached_95"] else "never 95 % in"
    path = f"a shepherd's path {row['path_length']:.0f} m"
    return f"{point.controller}, {words(point)}, seed {seed}\n{home}, {when}, {path}"


def words(point: Point) -> str:
    """The labels of a scenario for people."""
    labels = point.labels
    return f"{labels['scenario']}: {told(labels)}"
