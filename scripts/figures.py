"""Draw measures with intervals, the paper's figures among them. Needs matplotlib (the ``analysis`` extra)."""

from __future__ import annotations

import io
import itertools
import math
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Literal

import matplotlib.style
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from shepherd_phys.controllers.claims import LITERAL, Experiment

SIZE = (9.0, 4.4)
"""[in]. At 100 px an inch, as a page shows it, it is 900 px wide."""
DPI = 200
KINDS: dict[str, dict[str, None]] = {
    "png": {"Software": None},
    "svg": {"Date": None},
    "pdf": {"CreationDate": None, "Creator": None, "Producer": None},
}
"""Of files, and what they do not tell, so that the same rows give the same bytes: versions and dates."""
STEADY = {"svg.hashsalt": "shepherd_phys", "svg.fonttype": "path", "pdf.fonttype": 42}
"""Names within an SVG are not random; fonts of a PDF are such as journals take."""
DODGE, SPREAD = 0.11, 0.6
"""Distance of neighbouring methods at a point, so that intervals do not hide one another, and what all of them may take
together, in steps between points."""

BLUE, GREEN, ORANGE, PURPLE = "#0072B2", "#009E73", "#E69F00", "#CC79A7"
SKY, VERMILION, BLACK, GREY = "#56B4E9", "#D55E00", "#000000", "#808080"
BROWN = "#7A5230"
# Okabe and Ito's colours, which the colour-blind tell apart; as published: the tuned one's, hollow and dashed
STYLES = {
    "strombom": (BLUE, "o"),
    "pierson": (GREEN, "s"),
    "elfiqi": (ORANGE, "^"),
    "occlusion": (PURPLE, "D"),
    "original": (GREY, "X"),
    "any": (SKY, "v"),
    "wild": (VERMILION, "*"),
    "collie": (BLACK, "P"),
    "collie-obstacles": (BROWN, "p"),
    "strombom-literal": (BLUE, "o"),
    "pierson-reconstructed": (GREEN, "s"),
    "elfiqi-literal": (ORANGE, "^"),
}
OTHERS = [(color, marker) for marker in "h<>d8" for color in (BLACK, GREY)]
"""For controllers of a user's own."""


def draw(experiment: Experiment, summary: Sequence[Mapping[str, Any]]) -> bytes:
    """The experiment's figure as PNG: (a) sheep delivered at the end, (b) path length, with 95 % intervals.

    The same rows give the same bytes with the same matplotlib.

    Args:
        experiment: what is varied.
        summary: rows of its CSV; controllers are drawn in the order in which they come.
    """
    with picture() as drawn:
        left, right = drawn.figure.subplots(1, 2)
        panel(left, experiment.varied, experiment.axis, summary, "in_goal_end")
        panel(right, experiment.varied, experiment.axis, summary, "path_length")
        left.set_title("(a) sheep in the goal at the end, %", fontsize=10, loc="left")
        left.set_ylim(-4.0, 104.0)
        right.set_title("(b) path of a shepherd, m (mean of the team)", fontsize=10, loc="left")
        right.set_ylim(bottom=0.0)
        legend(drawn.figure, left)
    return drawn.content


def draw_measures(
    summary: Sequence[Mapping[str, Any]], varied: str, label: str, metrics: Mapping[str, str], about: str, kind: str
) -> bytes:
    """Measures against what is varied, a panel each, with 95 % intervals.

    Args:
        summary: as of `panel`.
        varied: the column along x.
        label: what that is called.
        metrics: the measures and what they are called.
        about: what all rows share, in words.
        kind: of `KINDS`.
    """
    columns = min(2, len(metrics))
    with picture(kind, panels_size(len(metrics))) as drawn:
        grid = drawn.figure.subplots(math.ceil(len(metrics) / columns), columns, squeeze=False).ravel()
        for axes in grid[len(metrics) :]:
            axes.set_visible(False)
        for k, (axes, (metric, title)) in enumerate(zip(grid, metrics.items(), strict=False)):
            panel(axes, varied, label, summary, metric)
            axes.set_title(f"{letter(k, len(metrics))}{title}", fontsize=10, loc="left")
            if "%" in title:
                axes.set_ylim(-4.0, 104.0)
            elif title.startswith("share"):
                axes.set_ylim(-0.04, 1.04)
            else:
                axes.set_ylim(bottom=0.0)
        heading(drawn.figure, about)
        legend(drawn.figure, grid[0])
    return drawn.content


def told(labels: Mapping[str, Any]) -> str:
    """The numbers of a point for people, as far as they are among its labels."""
    shown = {"n_flocks": "flock", "n_shepherds": "shepherd"}
    parts = [f"{labels['n_sheep']} sheep"] if labels.get("n_sheep") is not None else []
    parts += [f"{labels[name]} {word}{'s' * (labels[name] != 1)}" for name, word in shown.items() if name in labels]
    return ", ".join([*parts, *([f"n = {labels['cohesion']}"] if labels.get("cohesion") is not None else [])])


def panels_size(n: int) -> tuple[float, float]:
    """Width and height of a figure of n panels, two in a row [in]."""
    width, height = SIZE
    return (width if n > 1 else 0.65 * width), 0.5 + math.ceil(n / 2) * (height - 0.5)


def letter(k: int, n: int) -> str:
    """What stands before the title of the k-th of n panels."""
    return f"({'abcdefghijklmnopqrstuvwxyz'[k]}) " if n > 1 else ""


def draw_cases(summary: Sequence[Mapping[str, Any]]) -> bytes:
    """Sheep delivered and path length of each controller in each case, with 95 % intervals, as PNG.

    Args:
        summary: rows with a ``case``, case by case; controllers are drawn in the order in which they first come.
    """
    cases = list(dict.fromkeys(row["case"] for row in summary))
    methods = list(dict.fromkeys(row["controller"] for row in summary))
    with picture(size=(SIZE[0], 1.6 + 0.2 * len(cases) * max(2, len(methods)))) as drawn:
        left, right = drawn.figure.subplots(1, 2, sharey=True)
        others = iter(OTHERS * len(methods))
        for k, method in enumerate(methods):
            style = STYLES[method] if method in STYLES else next(others)
            rows = [row for row in summary if row["controller"] == method]
            y = [cases.index(row["case"]) + 0.8 * ((k + 0.5) / len(methods) - 0.5) for row in rows]
            for axes, metric in ((left, "in_goal_end"), (right, "path_length")):
                _bars(axes, rows, metric, y, method, style, lying=True)
        for axes, title in (
            (left, "sheep in the goal at the end, %"),
            (right, "path of a shepherd, m (mean of the team)"),
        ):
            axes.set_title(title, fontsize=10, loc="left")
            plain(axes, "x")
            for border in range(len(cases) - 1):
                axes.axhline(border + 0.5, color="#eeeeee", linewidth=0.8)
        left.set_xlim(-4.0, 104.0)
        right.set_xlim(left=0.0)
        # a percent sign stays with its number
        labels = ["\n".join(textwrap.wrap(case.replace(" %", "\N{NO-BREAK SPACE}%"), 26)) for case in cases]
        left.set_yticks(range(len(cases)), labels)
        left.set_ylim(len(cases) - 0.5, -0.5)
        legend(drawn.figure, left)
    return drawn.content


@dataclass
class Drawn:
    """A figure to draw into, and what it has become."""

    figure: Figure
    content: bytes = b""
    """Of the file."""


@contextmanager
def picture(kind: str = "png", size: tuple[float, float] = SIZE) -> Iterator[Drawn]:
    """An empty figure on which users' style sheets have no say; at the end it is a file's content.

    Args:
        kind: of `KINDS`.
        size: [in].
    """
    with matplotlib.style.context(["default", STEADY], after_reset=True):
        drawn = Drawn(Figure(figsize=size, dpi=DPI, layout="constrained"))
        FigureCanvasAgg(drawn.figure)
        yield drawn
        file = io.BytesIO()
        drawn.figure.savefig(file, format=kind, metadata=KINDS[kind])
        drawn.content = file.getvalue()


def heading(figure: Figure, text: str) -> None:
    """Say above all panels what they are of, in as many lines as that takes."""
    lines = [textwrap.fill(line, int(12.5 * figure.get_figwidth())) for line in text.splitlines()]
    figure.suptitle("\n".join(lines), fontsize=9, x=0.01, ha="left")


def legend(figure: Figure, axes: Axes) -> None:
    """Name what is in ``axes`` below all panels, as wide as the figure allows."""
    handles, labels = axes.get_legend_handles_labels()
    longest = max(map(len, labels), default=0)
    columns = max(1, min(4, len(labels), int(figure.get_figwidth() * 12 / (longest + 6))))
    figure.legend(handles, labels, loc="outside lower center", ncols=columns, frameon=False, fontsize=9)


def plain(axes: Axes, lines: Literal["x", "y"] = "y") -> None:
    """Light lines at the ticks of one axis, no box."""
    axes.tick_params(labelsize=9)
    axes.grid(axis=lines, color="#dddddd", linewidth=0.6)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)


def panel(axes: Axes, varied: str, label: str, summary: Sequence[Mapping[str, Any]], metric: str) -> None:
    """Means with intervals, a line a controller, side by side at a point so that equal ones stay visible.

    Args:
        axes: to draw into.
        varied: the column along x.
        label: what that is called.
        summary: rows with ``controller``, ``varied`` and the metric's ``_mean``, ``_low`` and ``_high``.
        metric: the measure along y.
    """
    ticks = sorted({row[varied] for row in summary})
    step = min((b - a for a, b in itertools.pairwise(ticks)), default=1)
    methods = list(dict.fromkeys(row["controller"] for row in summary))
    dodge = step * min(DODGE, SPREAD / max(1, len(methods) - 1))
    others = iter(OTHERS * len(methods))
    for k, method in enumerate(methods):
        rows = sorted((row for row in summary if row["controller"] == method), key=lambda row: row[varied])
        x = [row[varied] + dodge * (k - 0.5 * (len(methods) - 1)) for row in rows]
        _bars(axes, rows, metric, x, method, STYLES[method] if method in STYLES else next(others))
    axes.set_xticks(ticks)
    axes.set_xlabel(label, fontsize=10)
    plain(axes)


def _bars(
    axes: Axes, rows: Sequence[Mapping[str, Any]], metric: str, at: Sequence[float], method: str,
    style: tuple[str, str], lying: bool = False,
) -> None:  # fmt: skip
    """One method's means with their intervals, at places on the other axis; lying: without a line between them."""
    mean = [row[f"{metric}_mean"] for row in rows]
    below = [row[f"{metric}_mean"] - row[f"{metric}_low"] for row in rows]
    above = [row[f"{metric}_high"] - row[f"{metric}_mean"] for row in rows]
    color, marker = style
    spread = [below, above]
    axes.errorbar(
        x=mean if lying else at,
        y=at if lying else mean,
        xerr=spread if lying else None,
        yerr=None if lying else spread,
        label=method,
        color=color,
        marker=marker,
        markersize=7 if marker == "*" else 4.5,
        markerfacecolor="white" if method in LITERAL else color,
        linestyle="none" if lying else "--" if method in LITERAL else "-",
        linewidth=0.8,
        elinewidth=1.3,
        capsize=2,
        clip_on=False,
    )
