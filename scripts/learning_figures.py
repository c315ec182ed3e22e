"""Draw the learning curves of figure 1 and of the ablations. Needs matplotlib (the ``analysis`` extra)."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes

from shepherd_phys.controllers.curves import Floats, Row, curve_of

from .figures import (
    BLACK,
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    PURPLE,
    SKY,
    STYLES,
    VERMILION,
    legend,
    letter,
    panels_size,
    picture,
    plain,
)

MILLION = 1e6
LINES = [
    (color, style) for style in ("-", "--") for color in (BLACK, BLUE, GREEN, ORANGE, PURPLE, VERMILION, SKY, GREY)
]
"""For the variants of the ablations, in turn."""


def draw_figure1(curves: Sequence[Row], validations: Sequence[Row]) -> bytes:
    """Figure 1 as PNG: (a) mean episode reward, (b) percent of the sheep delivered in validation.

    Lines are means over seeds, bands reach from the least seed to the most. Other recipes than `fast` are dashed.

    Args:
        curves: rows of ``figure1.csv``.
        validations: rows of ``figure1-validation.csv``.
    """
    with picture() as drawn:
        left, right = drawn.figure.subplots(1, 2)
        for recipe, reward in dict.fromkeys((row["recipe"], row["reward"]) for row in curves):
            color, _ = STYLES[reward]
            style = "-" if recipe == "fast" else "--"
            label = reward if recipe == "fast" else f"{reward}, as the paper trains"
            curve = curve_of(curves, recipe, reward)
            line(left, curve.steps, curve.values, color, style, label)
            curve = curve_of(mean_over_points(validations, "in_goal_end"), recipe, reward, "in_goal_end")
            line(right, curve.steps, curve.values, color, style, label)
        left.set_title("(a) mean reward of training episodes", fontsize=10, loc="left")
        right.set_title("(b) sheep in the goal at the end, %, in validation", fontsize=10, loc="left")
        right.set_ylim(-4.0, 104.0)
        legend(drawn.figure, left)
    return drawn.content


def draw_ablations(curves: Sequence[Row]) -> bytes:
    """The ablations as PNG: percent of the sheep in at the end of training episodes, mean over seeds.

    Variants of the preset `paper` on the right, those of `fast` on the left.

    Args:
        curves: rows of ``ablations.csv``.
    """
    recipes = list(dict.fromkeys((row["recipe"], row["reward"]) for row in curves))
    with picture() as drawn:
        panels = drawn.figure.subplots(1, 2, sharex=True)
        for axes, from_paper, title in zip(
            panels, (False, True), ("(a) fast, less one ingredient", "(b) paper, one added after another"), strict=True
        ):
            own = [scheme for scheme in recipes if scheme[0].startswith("paper") == from_paper]
            for (recipe, reward), (color, style) in zip(own, itertools.cycle(LINES), strict=False):
                curve = curve_of(curves, recipe, reward, "in_goal_end")
                line(axes, curve.steps, curve.values, color, style, recipe, band=False)
            axes.set_title(f"{title}: sheep in, %", fontsize=10, loc="left")
            axes.set_ylim(-4.0, 104.0)
            if own:
                axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.16), frameon=False, fontsize=9)
    return drawn.content


def draw_runs(
    curves: Sequence[Row],
    validations: Sequence[Row],
    training_measures: Mapping[str, str],
    validation_measures: Mapping[str, str],
    kind: str,
) -> bytes:
    """Learning curves of any runs, a panel a measure; lines are means over seeds, bands reach from least to most.

    Args:
        curves: with the columns of ``figure1.csv``.
        validations: with the columns of ``validation.csv``, and recipe, reward and seed.
        training_measures: of the curves, and what they are called.
        validation_measures: of the validations, their mean over the points of each, and what they are called.
        kind: of file, see `shepherd_phys.scripts.figures.KINDS`.
    """
    panels = [(curves, measure, f"{title}, in training") for measure, title in training_measures.items()]
    panels += [
        (mean_over_points(validations, measure), measure, f"{title}, in validation")
        for measure, title in validation_measures.items()
    ]
    columns = min(2, len(panels))
    with picture(kind, panels_size(len(panels))) as drawn:
        grid = drawn.figure.subplots(math.ceil(len(panels) / columns), columns, squeeze=False).ravel()
        for axes in grid[len(panels) :]:
            axes.set_visible(False)
        for k, (axes, (rows, measure, title)) in enumerate(zip(grid, panels, strict=False)):
            for (recipe, reward), (color, style) in zip(
                dict.fromkeys((row["recipe"], row["reward"]) for row in curves), itertools.cycle(LINES), strict=False
            ):
                curve = curve_of(rows, recipe, reward, measure)
                seeds = f" ({len(curve.seeds)} seeds)" if len(curve.seeds) > 1 else ""
                line(axes, curve.steps, curve.values, color, style, f"{recipe}{seeds}")
            if not any(len(drawn_line.get_xdata()) for drawn_line in axes.lines):
                axes.text(0.5, 0.5, "nothing yet", transform=axes.transAxes, ha="center", color=GREY, fontsize=9)
                axes.set_yticks([])
            axes.set_title(f"{letter(k, len(panels))}{title}", fontsize=10, loc="left")
            if "%" in title:
                axes.set_ylim(-4.0, 104.0)
        most = max(axes.get_xlim()[1] for axes in grid[: len(panels)])
        for axes in grid[: len(panels)]:
            axes.set_xlim(0.0, most)
        legend(drawn.figure, grid[0])
    return drawn.content


def line(axes: Axes, steps: Floats, values: Floats, color: str, style: str, label: str, band: bool = True) -> None:
    """One curve; marked where it is too short for a line."""
    x = steps / MILLION
    mean = values.mean(axis=0) if len(values) else np.zeros(0)
    axes.plot(
        x,
        mean,
        color=color,
        linestyle=style,
        linewidth=1.3,
        label=label,
        marker="o" if len(x) < 2 else "",
        markersize=4,
    )
    if band and len(values) > 1:
        axes.fill_between(x, values.min(axis=0), values.max(axis=0), color=color, alpha=0.2, linewidth=0.0)
    axes.set_xlabel("shepherd-steps, millions", fontsize=10)
    plain(axes)


def mean_over_points(validations: Sequence[Row], measure: str) -> list[Row]:
    """A row a validation: a measure's mean over its points; checkpoints align the seeds as rollouts do."""
    found: dict[tuple[str, str, int, int], list[Row]] = {}
    for row in validations:
        found.setdefault((row["recipe"], row["reward"], row["seed"], row["checkpoint"]), []).append(row)
    return [
        {**rows[0], "rollout": key[-1], measure: sum(row[measure] for row in rows) / len(rows)}
        for key, rows in found.items()
    ]
