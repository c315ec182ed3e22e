"""Draw the learning curves of figure 1 and of the ablations. Needs matplotlib (the ``analysis`` extra)."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes

from shepherd_phys.controllers.curves import Floats, Row, curve_of

from .figures import BLACK, BLUE, GREEN, GREY, ORANGE, PURPLE, SKY, STYLES, VERMILION, picture

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
            _line(left, curve.steps, curve.values, color, style, label)
            curve = curve_of(_mean_over_points(validations), recipe, reward, "in_goal_end")
            _line(right, curve.steps, curve.values, color, style, label)
        left.set_title("(a) mean reward of training episodes", fontsize=10, loc="left")
        right.set_title("(b) sheep in the goal at the end, %, in validation", fontsize=10, loc="left")
        right.set_ylim(-4.0, 104.0)
        drawn.figure.legend(
            *left.get_legend_handles_labels(), loc="outside lower center", ncols=4, frameon=False, fontsize=9
        )
    return drawn.png


def draw_ablations(curves: Sequence[Row]) -> bytes:
    """The ablations as PNG: percent of the sheep in at the end of training episodes, mean over seeds.

    Args:
        curves: rows of ``ablations.csv``.
    """
    with picture() as drawn:
        axes = drawn.figure.subplots()
        for (recipe, reward), (color, style) in zip(
            dict.fromkeys((row["recipe"], row["reward"]) for row in curves), itertools.cycle(LINES), strict=False
        ):
            curve = curve_of(curves, recipe, reward, "in_goal_end")
            _line(axes, curve.steps, curve.values, color, style, recipe, band=False)
        axes.set_title("sheep in the goal at the end of training episodes, %", fontsize=10, loc="left")
        axes.set_ylim(-4.0, 104.0)
        drawn.figure.legend(
            *axes.get_legend_handles_labels(), loc="outside right center", ncols=1, frameon=False, fontsize=9
        )
    return drawn.png


def _line(axes: Axes, steps: Floats, values: Floats, color: str, style: str, label: str, band: bool = True) -> None:
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
    axes.tick_params(labelsize=9)
    axes.grid(axis="y", color="#dddddd", linewidth=0.6)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)


def _mean_over_points(validations: Sequence[Row]) -> list[Row]:
    """A row a validation: percent delivered, mean over its points; checkpoints align the seeds as rollouts do."""
    found: dict[tuple[str, str, int, int], list[Row]] = {}
    for row in validations:
        found.setdefault((row["recipe"], row["reward"], row["seed"], row["checkpoint"]), []).append(row)
    return [
        {**rows[0], "rollout": key[-1], "in_goal_end": sum(row["in_goal_end"] for row in rows) / len(rows)}
        for key, rows in found.items()
    ]
