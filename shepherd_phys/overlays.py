"""What is laid over the picture of a world: the lidar's beams, and plates with text."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from shepherd_phys.camera import Camera
from shepherd_phys.canvas import Canvas, lettering
from shepherd_phys.lidar import Scan, beam_directions
from shepherd_phys.palette import Theme
from shepherd_phys.state import Floats, WorldState

ORDER = ("goal", "obstacles", "shepherds", "sheep")
"""Channels whose beams are drawn, what matters most on top."""
STRENGTH = {"goal": 0.3, "obstacles": 0.18, "shepherds": 0.5, "sheep": 0.5}


def beam_ends(origins: Floats, readings: Floats) -> tuple[Floats, Floats]:
    """Where beams that hit something begin and end.

    Args:
        origins: (P, 2) the shepherds' places [m].
        readings: (P, B) distances along their beams [m], infinity for none.

    Returns:
        starts and ends, (K, 2) each [m], shepherd by shepherd.
    """
    p, k = np.nonzero(np.isfinite(readings))
    ways = beam_directions(readings.shape[1])[:, k].T
    return origins[p], origins[p] + ways * readings[p, k][:, None]


def draw_beams(
    canvas: Canvas, state: WorldState, camera: Camera, scan: Scan | None, earning: Floats | None, theme: Theme
) -> None:
    """Draw the beams that hit something, coloured by channel, to where they end; then those that earn, stronger.

    Args:
        canvas: to draw on.
        state: of the scan.
        camera: of the picture.
        scan: its beams; None: no others than those that earn.
        earning: (P, B) lengths of the beams that earn reward [m], infinity for the others.
        theme: the colours.
    """
    layers = [(theme.beams[name], scan[name], 1.0, STRENGTH[name]) for name in ORDER if scan and name in scan.names]
    layers += [(theme.earning, earning, 2.0, 0.9)] if earning is not None else []
    for color, readings, width, strength in layers:
        starts, ends = (camera.to_pixels(at, canvas.size) for at in beam_ends(state.shepherd_pos, readings))
        canvas.strokes(color, starts, ends, width, np.full(len(starts), strength))
        canvas.discs(color, ends, 0.5 + 0.75 * width)


def text_height(canvas: Canvas) -> int:
    """Of the largest lettering [px]."""
    return int(np.clip(min(canvas.size) / 19, 18, 36))


def draw_panel(canvas: Canvas, state: WorldState, rewards: Mapping[str, float] | None, theme: Theme) -> None:
    """Tell, in the upper left: sheep in the goal, in numbers and as a bar; time; collisions if any; the rewards."""
    w, h = canvas.size
    big = text_height(canvas)
    small, gap = max(round(big * 0.58), 14), round(big / 3)
    inside, hits = int(state.sheep_in_goal.sum()), int(state.collisions)
    count = lettering(f"{inside}/{state.n_sheep}", big, theme.ink)
    label = lettering("in the goal", small, theme.faint_ink)
    told = [(f"{state.time:.1f} s", f"{hits} collision{'s' * (hits != 1)}" if hits else " ")]
    if rewards:
        sums = [*rewards.items(), *([("reward", sum(rewards.values()))] if len(rewards) > 1 else [])]
        told += [(name if len(name) < 20 else name[:19] + "…", f"{value:+.3f}") for name, value in sums]
    lines = [tuple(lettering(text, small, theme.faint_ink) for text in line) for line in told]
    inner = max(
        count.get_width() + gap + label.get_width(),
        *(left.get_width() + 2 * gap + right.get_width() for left, right in lines),
    )
    inner = -(-inner // 8) * 8  # a digit more must not make the plate tremble
    leading = lines[0][0].get_height() + gap // 3
    height = count.get_height() + len(lines) * leading + 3 * gap + 4
    width = inner + 2 * gap
    if 20 + width > w or 20 + height > h * 0.6:
        if rewards:
            draw_panel(canvas, state, None, theme)
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
    for left, right in lines:
        canvas.put(left, x, y)
        canvas.put(right, x + inner - right.get_width(), y)
        y += leading


def draw_title(canvas: Canvas, title: str, theme: Theme) -> None:
    """Write lines of text in the upper right, the first one large; where they do not fit beside the panel, none."""
    big = text_height(canvas)
    first, *rest = title.split("\n")
    lines = [lettering(first, round(big * 0.8), theme.ink)]
    lines += [lettering(line, max(round(big * 0.58), 14), theme.faint_ink) for line in rest]
    if max(line.get_width() for line in lines) + 24 > canvas.size[0] / 2:
        return
    y = 14
    for line in lines:
        canvas.put(line, canvas.size[0] - 14 - line.get_width(), y)
        y += line.get_height() + 2


def draw_note(canvas: Canvas, text: str, theme: Theme) -> None:
    """A plate with a line of text in the lower right."""
    line = lettering(text, max(round(text_height(canvas) * 0.58), 14), theme.ink)
    gap = line.get_height() // 2
    size = line.get_width() + 2 * gap, line.get_height() + 2 * gap
    left, top = canvas.size[0] - size[0] - 10, canvas.size[1] - size[1] - 10
    canvas.plate(theme.ground, left, top, size, corner=gap / 2, edge=theme.grid[1], alpha=0.92)
    canvas.put(line, left + gap, top + gap)


def draw_table(canvas: Canvas, rows: Sequence[tuple[str, str]], theme: Theme) -> None:
    """A plate with two columns of text in the middle."""
    height = int(np.clip(canvas.size[1] / (1.4 * len(rows)), 12, 18))
    columns = [
        [lettering(text, height, color) for text in column]
        for column, color in zip(zip(*rows, strict=True), (theme.ink, theme.faint_ink), strict=True)
    ]
    first, second = (max(text.get_width() for text in column) for column in columns)
    leading, gap = round(1.25 * height), height
    size = first + second + 3 * gap, leading * len(rows) + 2 * gap
    left, top = (canvas.size[0] - size[0]) // 2, (canvas.size[1] - size[1]) // 2
    canvas.plate(theme.ground, left, top, size, corner=gap / 2, edge=theme.grid[1], alpha=0.95)
    for row, (key, what) in enumerate(zip(*columns, strict=True)):
        canvas.put(key, left + gap, top + gap + row * leading)
        canvas.put(what, left + 2 * gap + first, top + gap + row * leading)
