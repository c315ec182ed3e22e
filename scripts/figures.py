"""Draw the paper's figures from the rows of a summary. Needs matplotlib (the ``analysis`` extra)."""

from __future__ import annotations

import io
import itertools
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
DODGE, SPREAD = 0.11, 0.6
"""Distance of neighbouring methods at a point, so that intervals do not hide one another, and what all of them may take
together, in steps between points."""

BLUE, GREEN, ORANGE, PURPLE = "#0072B2", "#009E73", "#E69F00", "#CC79A7"
SKY, VERMILION, BLACK, GREY = "#56B4E9", "#D55E00", "#000000", "#808080"
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
    "collie-obstacles": (VERMILION, "P"),
    "strombom-literal": (BLUE, "o"),
    "pierson-reconstructed": (GREEN, "s"),
    "elfiqi-literal": (ORANGE, "^"),
}
OTHERS = [(color, marker) for marker in "hp<>d8" for color in (BLACK, GREY)]
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
        _panel(left, experiment, summary, "in_goal_end")
        _panel(right, experiment, summary, "path_length")
        left.set_title("(a) sheep in the goal at the end, %", fontsize=10, loc="left")
        left.set_ylim(-4.0, 104.0)
        right.set_title("(b) path of a shepherd, m (mean of the team)", fontsize=10, loc="left")
        right.set_ylim(bottom=0.0)
        drawn.figure.legend(
            *left.get_legend_handles_labels(), loc="outside lower center", ncols=4, frameon=False, fontsize=9
        )
    return drawn.png


def draw_cases(summary: Sequence[Mapping[str, Any]]) -> bytes:
    """Sheep delivered and path length of each controller in each case, with 95 % intervals, as PNG.

    Args:
        summary: rows with a ``case``, case by case; controllers are drawn in the order in which they first come.
    """
    cases = list(dict.fromkeys(row["case"] for row in summary))
    methods = list(dict.fromkeys(row["controller"] for row in summary))
    with picture((SIZE[0], 1.6 + 0.2 * len(cases) * max(2, len(methods)))) as drawn:
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
            _tidy(axes, "x")
            for border in range(len(cases) - 1):
                axes.axhline(border + 0.5, color="#eeeeee", linewidth=0.8)
        left.set_xlim(-4.0, 104.0)
        right.set_xlim(left=0.0)
        left.set_yticks(range(len(cases)), ["\n".join(textwrap.wrap(case, 26)) for case in cases])
        left.set_ylim(len(cases) - 0.5, -0.5)
        drawn.figure.legend(
            *left.get_legend_handles_labels(), loc="outside lower center", ncols=4, frameon=False, fontsize=9
        )
    return drawn.png


@dataclass
class Drawn:
    """A figure to draw into, and what it has become."""

    figure: Figure
    png: bytes = b""


@contextmanager
def picture(size: tuple[float, float] = SIZE) -> Iterator[Drawn]:
    """An empty figure [in] on which users' style sheets have no say; at the end it is PNG."""
    with matplotlib.style.context("default", after_reset=True):
        drawn = Drawn(Figure(figsize=size, dpi=DPI, layout="constrained"))
        FigureCanvasAgg(drawn.figure)
        yield drawn
        file = io.BytesIO()
        drawn.figure.savefig(file, format="png", metadata={"Software": None})  # else it names the version
        drawn.png = file.getvalue()


def _panel(axes: Axes, experiment: Experiment, summary: Sequence[Mapping[str, Any]], metric: str) -> None:
    ticks = sorted({row[experiment.varied] for row in summary})
    step = min((b - a for a, b in itertools.pairwise(ticks)), default=1)
    methods = list(dict.fromkeys(row["controller"] for row in summary))
    dodge = step * min(DODGE, SPREAD / max(1, len(methods) - 1))
    others = iter(OTHERS * len(methods))
    for k, method in enumerate(methods):
        rows = [row for row in summary if row["controller"] == method]
        x = [row[experiment.varied] + dodge * (k - 0.5 * (len(methods) - 1)) for row in rows]
        _bars(axes, rows, metric, x, method, STYLES[method] if method in STYLES else next(others))
    axes.set_xticks(ticks)
    axes.set_xlabel(experiment.axis, fontsize=10)
    _tidy(axes, "y")


def _bars(
    axes: Axes, rows: Sequence[Mapping[str, Any]], metric: str, at: Sequence[float], method: str,
    style: tuple[str, str], lying: bool = False,
) -> None:  # fmt: skip
    """One method's means with their intervals, at places on the other axis; lying: without a line between them."""
    mean = [row[f"{metric}_mean"] for row in rows]
    below = [row[f"{metric}_mean"] - row[f"{metric}_low"] for row in rows]
    above = [row[f"{metric}_high"] - row[f"{metric}_mean"] for row in rows]
    color, marker = style
    axes.errorbar(
        *((mean, at) if lying else (at, mean)),
        **{"xerr" if lying else "yerr": [below, above]},
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


def _tidy(axes: Axes, grid: Literal["x", "y"]) -> None:
    axes.tick_params(labelsize=9)
    axes.grid(axis=grid, color="#dddddd", linewidth=0.6)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
