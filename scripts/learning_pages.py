"""Markdown pages of the studies of learning, from what their CSV files hold: they can be made again and compared."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from shepherd_phys.controllers.curves import WINDOW, Row, curve_of, final_value, levels_off_at
from shepherd_phys.learning.studies import HOME

from .command import clock, counted
from .pages import line

Scheme = tuple[str, str]
"""(recipe, reward)."""
TIMED_SCHEME = ("fast", "wild")
"""The scheme of whose runs the time to home is told."""
STRETCH = 100_000
"""Shepherd-steps of an evaluation of the ablations, about: their rollouts differ in length."""
HALF = 50.0
"""Sheep in at the end of training episodes that count as a beginning [%]."""


def figure1_page(curves: Sequence[Row], validations: Sequence[Row], home: Sequence[Row]) -> str:
    """Figure 1 with its tables.

    Args:
        curves: rows of ``figure1.csv``.
        validations: rows of ``figure1-validation.csv``.
        home: rows of ``time-to-home.csv``, of runs of `TIMED_SCHEME` that were trained alone.
    """
    flocks = _flocks(validations)
    head = ["recipe", "reward", "seeds", "final reward", "levels off at", *(counted(n, "flock") for n in flocks),
            "rate", "time"]  # fmt: skip
    lines = [
        "# Figure 1: learning curves",
        "",
        "![Figure 1: mean episode reward, and sheep delivered in validation, against shepherd-steps](figure1.png)",
        "",
        "Made by `shepherd-phys reproduce`. Of each scheme, over its seeds: the mean reward of training episodes over "
        f"the last {WINDOW} evaluations (rollouts); where the curve levels off [M shepherd-steps], if not only in the "
        "last tenth of its length; sheep in the goal at the end of the last validation's episodes, %, mean (least to "
        "most of the seeds); shepherd-steps a second and wall-clock time of training, validations left out.",
        "",
        "The runs whose time to home is told below were trained one at a time, with all worker processes; rate and "
        "time of `fast` with `wild` are of these alone. All the others had one process each, as many of them at a "
        "time as there were workers, so that their times say nothing of the schemes and are left out: but for the one "
        "of the preset `paper`, whose training was limited to a time, not to a number of steps.",
        "",
        line(head),
        line(["---", "---", *["---:"] * (len(head) - 2)]),
    ]
    timed = {row["seed"] for row in home}
    for recipe, reward in _schemes(curves):
        curve = curve_of(curves, recipe, reward)
        lasts = _lasts(curves, recipe, reward)
        paced = [row for row in lasts if (recipe, reward) == TIMED_SCHEME and row["seed"] in timed]
        paced = paced or (lasts if recipe == "paper" else [])
        pace = [_rate(paced), clock(_total(paced, "seconds") / len(paced))] if paced else ["", ""]
        off = levels_off_at(curve)
        at_end = _at_end(validations, recipe, reward)
        lines.append(
            line(
                [
                    recipe,
                    reward,
                    str(len(curve.seeds)),
                    _number(final_value(curve), ".2f"),
                    _levels_off(off, lasts),
                    *(_spread(at_end.get(k, [])) for k in flocks),
                    *pace,
                ]
            )
        )
    return "\n".join([*lines, *_home(home), ""])


def _levels_off(at: float | None, lasts: Sequence[Row]) -> str:
    """M shepherd-steps, or those within which the curve does not level off."""
    if at is not None:
        return f"{at / 1e6:.2f}"
    return f"not within {_total(lasts, 'shepherd_steps') / len(lasts) / 1e6:.2f}"


def _home(home: Sequence[Row]) -> list[str]:
    """The table of the time to home."""
    flocks = sorted({row["n_flocks"] for row in home if row["n_flocks"] is not None})
    head = ["seed", "M shepherd-steps", "time", *(counted(n, "flock") for n in flocks)]
    lines = [
        "",
        "**Time to home**",
        "",
        f"Of the first runs of `{TIMED_SCHEME[1]}`, each trained with nothing beside it: training until the first "
        f"checkpoint whose policy delivers at least {HOME:g} % with each number of flocks in "
        "validation; that policy, judged once on reported trials: sheep in the goal at the end, %, mean [95 % "
        "bootstrap interval].",
        "",
        line(head),
        line(["---", *["---:"] * (len(head) - 1)]),
    ]
    for seed in sorted({row["seed"] for row in home}):
        own = {row["n_flocks"]: row for row in home if row["seed"] == seed}
        first = next(iter(own.values()))
        if first["checkpoint"] is None:
            lines.append(line([str(seed), "not reached", *[""] * (len(head) - 2)]))
            continue
        cells = [_confirmed(own[k]) if k in own else "" for k in flocks]
        lines.append(line([str(seed), f"{first['shepherd_steps'] / 1e6:.2f}", clock(first["seconds"]), *cells]))
    return lines


def ablations_page(curves: Sequence[Row], validations: Sequence[Row]) -> str:
    """The ablations with their table.

    Args:
        curves: rows of ``ablations.csv``.
        validations: rows of ``ablations-validation.csv``.
    """
    flocks = _flocks(validations)
    head = ["variant", "seeds", "M shepherd-steps", "decisions", *(counted(n, "flock") for n in flocks), "final reward",
            "half in at"]  # fmt: skip
    lines = [
        "# Ablations: what each ingredient buys",
        "",
        "![Sheep in the goal at the end of training episodes against shepherd-steps, by variant](ablations.png)",
        "",
        "Made by `shepherd-phys reproduce`. Of each variant, over its seeds: sheep in the goal at the end of "
        "validation episodes after training, %, mean (least to most); the mean reward of training episodes over the "
        f"last {WINDOW} evaluations, each of the rollouts of about {STRETCH / 1e6:g} M shepherd-steps; M "
        "shepherd-steps at the first evaluation whose episodes ended with half of the sheep in. Runs beside one "
        "another take each other's time: none is told.",
        "",
        line(head),
        line(["---", *["---:"] * (len(head) - 1)]),
    ]
    for recipe, reward in _schemes(curves):
        lasts = _lasts(curves, recipe, reward)
        at_end = _at_end(validations, recipe, reward)
        lines.append(
            line(
                [
                    recipe,
                    str(len(lasts)),
                    f"{_total(lasts, 'shepherd_steps') / len(lasts) / 1e6:.2f}",
                    f"{_total(lasts, 'decisions') / len(lasts):,.0f}",
                    *(_spread(at_end.get(k, [])) for k in flocks),
                    _number(final_value(curve_of(curves, recipe, reward)), ".2f"),
                    _half_in(curves, recipe, reward),
                ]
            )
        )
    return "\n".join([*lines, ""])


def _schemes(curves: Sequence[Row]) -> list[Scheme]:
    return list(dict.fromkeys((row["recipe"], row["reward"]) for row in curves))


def _of(rows: Iterable[Row], recipe: str, reward: str) -> dict[int, list[Row]]:
    """The rows of a scheme by seed."""
    found: dict[int, list[Row]] = {}
    for row in rows:
        if (row["recipe"], row["reward"]) == (recipe, reward):
            found.setdefault(row["seed"], []).append(row)
    return found


def _lasts(curves: Sequence[Row], recipe: str, reward: str) -> list[Row]:
    """The last row of each seed."""
    return [max(rows, key=lambda row: row["rollout"]) for rows in _of(curves, recipe, reward).values()]


def _at_end(validations: Sequence[Row], recipe: str, reward: str) -> dict[int, list[float]]:
    """Percent delivered in each seed's last validation, by number of flocks."""
    found: dict[int, list[float]] = {}
    for rows in _of(validations, recipe, reward).values():
        last = max(row["checkpoint"] for row in rows)
        for row in rows:
            if row["checkpoint"] == last:
                found.setdefault(row["n_flocks"], []).append(row["in_goal_end"])
    return found


def _half_in(curves: Sequence[Row], recipe: str, reward: str) -> str:
    """Mean over the seeds that came so far, and how many they are where not all did."""
    runs = _of(curves, recipe, reward).values()
    first = [
        min(there)
        for rows in runs
        if (there := [r["shepherd_steps"] for r in rows if r["in_goal_end"] is not None and r["in_goal_end"] >= HALF])
    ]
    if not first:
        return "never"
    of = "" if len(first) == len(runs) else f" ({len(first)} of {len(runs)})"
    return f"{sum(first) / len(first) / 1e6:.2f}{of}"


def _flocks(validations: Sequence[Row]) -> list[int]:
    return sorted({row["n_flocks"] for row in validations})


def _total(rows: Sequence[Row], name: str) -> float:
    return float(sum(row[name] for row in rows))


def _rate(lasts: Sequence[Row]) -> str:
    return f"{_total(lasts, 'shepherd_steps') / max(_total(lasts, 'seconds'), 1e-9):,.0f}"


def _mean(values: Sequence[float]) -> float | None:
    return sum(values) / len(values) if values else None


def _spread(values: Sequence[float]) -> str:
    mean = _mean(values)
    spread = f" ({min(values):.1f} to {max(values):.1f})" if len(values) > 1 else ""
    return "" if mean is None else f"{mean:.1f}{spread}"


def _number(value: float | None, digits: str) -> str:
    return "" if value is None else f"{value:{digits}}"


def _confirmed(row: Row) -> str:
    if row["confirmed_mean"] is None:
        return "not confirmed"
    return f"{row['confirmed_mean']:.1f} [{row['confirmed_low']:.1f}, {row['confirmed_high']:.1f}]"
