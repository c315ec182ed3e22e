"""What is laid over the picture of a world: the lidar's beams, and plates with text."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from shepherd_phys.camera import Camera
from shepherd_phys.canvas import Canvas, Size, lettering
from shepherd_phys.lidar import Scan, beam_directions
from shepherd_phys.palette import Theme
from shepherd_phys.state import Floats, WorldState

ORDER = ("goal", "obstacles", "shepherds", "sheep")
"""Channels whose beams are drawn, what matters most on top."""
STRENGTH = {"goal": 0.3, "obstacles": 0.18, "shepherds": 0.5, "sheep": 0.5}

CORNERS = ("upper left", "upper right", "lower left", "lower right")
Box = tuple[int, int, int, int]
"""Left, top, width, height [px]."""
EDGE = 10
"""[px] between a plate and the picture's border."""
FOOT = 44
"""[px] from the lower border, for the scale bar and a note."""
CALM = 24.0
"""[px]: what is so near to a panel may soon be behind it."""
MATTERS = 10.0
"""Sheep that a shepherd, or the goal, counts for."""


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


@dataclass(frozen=True)
class Seen:
    """What there is to see in a picture, as the boxes round what is drawn: (.., 2, 2) [px], least and greatest x, y.

    Attributes:
        moving: (K, 2, 2) sheep, shepherds, the goal.
        weights: (K,) how much each of them matters.
        obstacles: (O, 2, 2).
    """

    moving: Floats
    weights: Floats
    obstacles: Floats


class Corner:
    """The corner in which the panel stands, from picture to picture: it stays until something walks in behind it.

    Then, as in the first picture, it goes where least is hidden; of such corners to the one with the fewest obstacles,
    which stay there for good; of those to the one with least within `CALM` pixels. So it neither hides what there is
    to see nor jumps to and fro.
    """

    def __init__(self) -> None:
        self.name = ""

    def __call__(self, boxes: Mapping[str, Box], seen: Seen) -> str:
        """Choose one.

        Args:
            boxes: what the panel would cover, of each corner.
            seen: what is to be seen.

        Returns:
            its name.
        """
        covered = hidden(boxes[self.name], seen.moving, seen.weights) if self.name else np.inf
        if covered > 0.0:
            each = np.ones(len(seen.obstacles))
            costs = {
                name: (
                    hidden(box, seen.moving, seen.weights),
                    hidden(box, seen.obstacles, each),
                    hidden(box, seen.moving, seen.weights, CALM),
                )
                for name, box in boxes.items()
            }
            best = min(costs, key=costs.__getitem__)
            if costs[best][0] < covered:
                self.name = best
        return self.name


def hidden(box: Box, extents: Floats, weights: Floats, around: float = 0.0) -> float:
    """The weight (K,) of those extents (K, 2, 2), of which a part is within ``around`` of a box [px]."""
    left, top, width, height = box
    low, high = (left - around, top - around), (left + width + around, top + height + around)
    return float(weights[((extents[:, 1] > low) & (extents[:, 0] < high)).all(axis=1)].sum())


def extents(at: Floats, reach: Floats) -> Floats:
    """The boxes (K, 2, 2) round discs: their middles (K, 2), their radii (K,) [px]."""
    return np.stack([at - reach[:, None], at + reach[:, None]], axis=1)


def text_height(canvas: Canvas) -> int:
    """Of the largest lettering [px]."""
    return int(np.clip(min(canvas.size) / 19, 18, 36))


def small_height(canvas: Canvas) -> int:
    """Of the other lettering [px]."""
    return max(round(text_height(canvas) * 0.58), 15)


class Panel:
    """What is told of a state: sheep in the goal, in numbers and as a bar; time; collisions if any; the rewards.

    Where it would take up too much of the canvas it tells less: first the rewards are left out, then words.

    Args:
        canvas: for which it is set.
        state: of which it tells.
        rewards: what each term has given, weighted.
        theme: the colours.

    Attributes:
        size: (w, h) [px]; (0, 0) where there is no room for any.
    """

    def __init__(self, canvas: Canvas, state: WorldState, rewards: Mapping[str, float] | None, theme: Theme) -> None:
        self._theme, self._share = theme, int(state.sheep_in_goal.sum()) / state.n_sheep
        hits, small = int(state.collisions), small_height(canvas)
        clock = f"{state.time:.1f} s"
        told = [(clock, f"{hits} collision{'s' * (hits != 1)}" if hits else " ")]
        sums = [*(rewards or {}).items()]
        sums += [("reward", sum((rewards or {}).values()))] if len(sums) > 1 else []
        terms = [(name if len(name) < 20 else name[:19] + "…", f"{value:+.3f}") for name, value in sums]
        self._gap = round(text_height(canvas) / 3)
        self._count = lettering(f"{int(state.sheep_in_goal.sum())}/{state.n_sheep}", text_height(canvas), theme.ink)
        self._label = lettering("in the goal", small, theme.faint_ink)
        for label, lines in ((True, told + terms), (True, told), (False, [(clock, "")])):
            self._labelled = label
            self._lines = [tuple(lettering(text, small, theme.faint_ink) for text in line) for line in lines]
            self.size = self._measured()
            if self.size[0] + 2 * EDGE <= 0.6 * canvas.size[0] and self.size[1] + 2 * EDGE <= 0.6 * canvas.size[1]:
                return
        self.size = (0, 0)

    @property
    def _leading(self) -> int:
        return int(self._lines[0][0].get_height() + self._gap // 2)

    def _measured(self) -> Size:
        gap, count, label = self._gap, self._count, self._label
        widths = [
            left.get_width() + 2 * gap * bool(right.get_width()) + right.get_width() for left, right in self._lines
        ]
        inner = max(count.get_width() + (gap + label.get_width()) * self._labelled, *widths)
        inner = -(-inner // 8) * 8  # a digit more must not make the plate tremble
        return inner + 2 * gap, count.get_height() + len(self._lines) * self._leading + 3 * gap + 4

    def boxes(self, canvas: Canvas, title: int) -> dict[str, Box]:
        """What it covers in each corner: under a title of so many pixels, and over the scale bar and a note."""
        w, h = self.size
        right, bottom = canvas.size[0] - EDGE - w, max(canvas.size[1] - FOOT - h, EDGE)
        places = (EDGE, EDGE), (right, EDGE + title), (EDGE, bottom), (right, max(bottom, EDGE + title))
        return {name: (x, y, w, h) for name, (x, y) in zip(CORNERS, places, strict=True)}

    def draw(self, canvas: Canvas, box: Box) -> None:
        """Draw it there; what walks behind it shows through."""
        theme, gap, inner = self._theme, self._gap, box[2] - 2 * self._gap
        canvas.plate(theme.ground, box[0], box[1], self.size, corner=gap / 2, edge=theme.grid[1], alpha=0.85)
        x, y, count, label = box[0] + gap, box[1] + gap, self._count, self._label
        canvas.put(count, x, y)
        if self._labelled:
            canvas.put(label, x + count.get_width() + gap, y + count.get_height() - label.get_height())
        y += count.get_height() + gap // 2 + 2
        canvas.box(theme.grid[1], x, y - 2, inner, 4)
        canvas.box(theme.goal_ring, x, y - 2, inner * self._share, 4)
        y += gap // 2 + 4
        for left, right in self._lines:
            canvas.put(left, x, y)
            canvas.put(right, x + inner - right.get_width(), y)
            y += self._leading


def draw_panel(
    canvas: Canvas,
    state: WorldState,
    seen: Seen,
    rewards: Mapping[str, float] | None,
    theme: Theme,
    *,
    corner: Corner | None,
    title: str,
) -> None:
    """Tell of a state in a corner, with lines of text in the upper right, the first one large.

    Args:
        canvas: to draw on.
        state: of which it tells.
        seen: what it is not to hide.
        rewards: what each term has given, weighted.
        theme: the colours.
        corner: of the panel; None: there is none.
        title: the lines; where they do not fit beside the panel, there are none.
    """
    panel = Panel(canvas, state, rewards, theme) if corner is not None else None
    beside = panel.size[0] + EDGE if panel is not None and panel.size[0] else 0
    under = draw_title(canvas, title, theme, canvas.size[0] - beside - 2 * EDGE) if title else 0
    if panel is None or corner is None or not panel.size[0]:
        return
    boxes = panel.boxes(canvas, under)
    panel.draw(canvas, boxes[corner(boxes, seen)])


def draw_title(canvas: Canvas, title: str, theme: Theme, width: float) -> int:
    """Write lines of text in the upper right, none if they are wider than ``width`` px; how high they are [px]."""
    first, *rest = title.split("\n")
    lines = [lettering(first, round(text_height(canvas) * 0.8), theme.ink)]
    lines += [lettering(line, small_height(canvas), theme.faint_ink) for line in rest]
    if max(line.get_width() for line in lines) > width:
        return 0
    y = EDGE + 4
    for line in lines:
        canvas.put(line, canvas.size[0] - EDGE - 4 - line.get_width(), y)
        y += line.get_height() + 3
    return y - EDGE + 4


def draw_note(canvas: Canvas, text: str, theme: Theme) -> None:
    """A plate with a line of text in the lower right."""
    line = lettering(text, small_height(canvas), theme.ink)
    gap = line.get_height() // 2
    size = line.get_width() + 2 * gap, line.get_height() + 2 * gap
    left, top = canvas.size[0] - size[0] - EDGE, canvas.size[1] - size[1] - EDGE
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
