"""The paper's two experiments and its claims, as tests on rows of ``episodes.csv`` and of ``figure1.csv``.

Which claims there are: "Perception-Based Rewards for Robotic Shepherd Teams Maneuvering Split Flocks", section 4. When
one holds: `shepherd_phys.controllers.verdicts`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .curves import WINDOW, Curve, curve_of, later_by
from .summary import correlation, intervals
from .verdicts import At, Claim, Part, Side

Floats = NDArray[np.float64]
Row = Mapping[str, Any]

HEURISTICS = ("strombom", "pierson", "elfiqi", "occlusion")
"""Tuned heuristics: the rivals of c4 and c5."""
PROPOSED = ("wild", "any")
"""The paper's own: learned with an occlusion reward. "Learned" means these in c4 and c5."""
LEARNED = ("original", "any", "wild", "collie")
LITERAL = ("strombom-literal", "pierson-reconstructed", "elfiqi-literal")
"""As published, without a terminal rule: never a rival, never counted."""
COUNTED = (*HEURISTICS, "original", "any", "wild")
"""Methods that c6 and c7 are about; what others show is reported beside it."""

RECIPE, PAPERS_RECIPE = "fast", "paper"
"""Training recipes that c8 is about: ours, and the paper's, which is reported beside it where it was run."""
LEAST_SEEDS = 3
"""Runs of a scheme below which c8 is not judged: too few have no interval worth the name."""


@dataclass(frozen=True)
class Experiment:
    """One of the paper's experiments: what it varies. Three shepherds and 100 sheep throughout."""

    title: str
    varied: str
    """The label that varies."""
    axis: str
    """What it is called in a figure."""
    flocks: tuple[int, ...]
    cohesion: tuple[int, ...]

    @property
    def points(self) -> tuple[At, ...]:
        """Every (flocks, n)."""
        return tuple((flocks, n) for flocks in self.flocks for n in self.cohesion)


EXPERIMENTS = {
    "figure2": Experiment(
        "Figure 2: varying number of flocks", "n_flocks", "flocks at the start", (1, 2, 3, 4, 5), (40,)
    ),
    "figure3": Experiment(
        "Figure 3: varying cohesion", "cohesion", "n, neighbours in a sheep's cohesion", (2,), (10, 25, 40, 55, 70, 85)
    ),
}
FLOCKS, COHESION = EXPERIMENTS["figure2"].points, EXPERIMENTS["figure3"].points
EVERYWHERE = tuple(dict.fromkeys((*FLOCKS, *COHESION)))


class Trials:
    """The trials of every method at every point that has all of them; and the learning curves.

    A point that lacks a trial counts as not run: episodes that failed or are still to come may be the hard ones.

    Args:
        rows: of ``episodes.csv``; in any order.
        seeds: of the trials.
        curves: rows of ``figure1.csv``.
    """

    def __init__(self, rows: Iterable[Row], seeds: Sequence[int], curves: Iterable[Row] = ()) -> None:
        self.curves = list(curves)
        found: dict[tuple[str, At], dict[int, Row]] = {}
        for row in rows:
            found.setdefault((row["controller"], (row["n_flocks"], row["cohesion"])), {})[row["seed"]] = row
        self._rows = {
            key: [own[seed] for seed in seeds] for key, own in found.items() if all(seed in own for seed in seeds)
        }
        self.methods = tuple(dict.fromkeys(method for method, _ in self._rows))

    def points(self, method: str, points: Sequence[At]) -> list[At]:
        """Those of the points that the method has run."""
        return [at for at in points if (method, at) in self._rows]

    def values(self, method: str, at: At, metric: str) -> Floats:
        """(n,) the metric of each trial, in the order of the seeds: so methods and points are paired by position."""
        return np.array([float(row[metric]) for row in self._rows[method, at]])


def judge(
    rows: Iterable[Row], seeds: Sequence[int], names: Sequence[str] | None = None, curves: Iterable[Row] = ()
) -> list[Claim]:
    """What rows of the experiments say to each claim.

    Args:
        rows: of ``episodes.csv``, of one scenario.
        seeds: of the trials that a point must have; at least one.
        names: of `CLAIMS`; all of them where it is left out.
        curves: rows of ``figure1.csv``.
    """
    trials = Trials(rows, seeds, curves)
    judged = []
    for name in CLAIMS if names is None else names:
        text, statistic, parts = CLAIMS[name]
        judged.append(Claim(name, text, statistic, tuple(parts(trials))))
    return judged


def _delivered(trials: Trials, methods: Sequence[str], points: Sequence[At], side: Side) -> Iterator[Part]:
    """c1 to c3: bounds of the mean."""

    def measured(part: Part, at: At) -> Part:
        return _with(part, trials.values(part.method, at, "in_goal_end"))

    for method in methods:
        yield from _at_each_point(trials, Part(method, side), points, measured)


def _like_the_best(trials: Trials, points: Sequence[At], side: Side) -> Iterator[Part]:
    """c4: paired difference to the heuristic that delivers most at the point; of equals the first."""

    def measured(part: Part, at: At) -> Part:
        missing = [name for name in HEURISTICS if not trials.points(name, [at])]
        if missing:
            return replace(part, note=f"not run: {', '.join(missing)}")
        best = max(HEURISTICS, key=lambda name: trials.values(name, at, "in_goal_end").mean())
        return _against(trials, part, best, at, "in_goal_end")

    for method, counts in _learned(trials):
        yield from _at_each_point(trials, Part(method, side, counts=counts), points, measured)


def _shorter(trials: Trials, points: Sequence[At], side: Side, delivers: float) -> Iterator[Part]:
    """c5: paired difference of paths, where the heuristic delivers enough on the mean."""
    for method, counts in _learned(trials):
        part = Part(method, side, counts=counts)
        if not trials.points(method, points):
            yield replace(part, note="not run")
            continue
        for rival in HEURISTICS:
            there = trials.points(rival, points)
            if not there:
                yield replace(part, rival=rival, note=f"not run: {rival}")
                continue
            for at in points:
                absent = [name for name in (method, rival) if not trials.points(name, [at])]
                if absent:
                    yield replace(part, rival=rival, at=at, note=f"not run: {', '.join(absent)}")
                elif trials.values(rival, at, "in_goal_end").mean() >= delivers:
                    yield _against(trials, part, rival, at, "path_length")


def _follows_n(trials: Trials, metric: str, side: Side) -> Iterator[Part]:
    """c6 and c7: rank correlation over the n of figure 3, bootstrapped over trials."""
    beside = [name for name in trials.methods if name not in COUNTED]
    n = np.array([n for _, n in COHESION], dtype=np.float64)
    for method in (*COUNTED, *beside):
        part = Part(method, side, counts=method in COUNTED)
        there = trials.points(method, COHESION)
        if len(there) == len(COHESION):
            values = np.array([trials.values(method, at, metric) for at in COHESION])
            value, low, high = correlation(n, values)
            if math.isnan(value):
                yield replace(part, note="the same at every n: no correlation is defined")
            else:
                yield replace(part, value=value, low=low, high=high)
        elif part.counts or there:
            missing = ", ".join(f"n = {at[1]}" for at in COHESION if at not in there)
            yield replace(part, note=f"not run: {missing}" if there else "not run")


def _levels_off_before(trials: Trials, first: str, then: str) -> Iterator[Part]:
    """c8: difference of the shepherd-steps at which two schemes level off, bootstrapped over seeds.

    Both curves end with the same rollout: where one levels off depends on its length. Where one does not by then,
    nobody knows which is earlier.
    """
    ran = {row["recipe"] for row in trials.curves}
    for recipe in (RECIPE, *([PAPERS_RECIPE] if PAPERS_RECIPE in ran else [])):
        part = Part(then, Side(least=0.0, strict=True), first, counts=recipe == RECIPE, recipe=recipe)
        curves = {name: curve_of(trials.curves, recipe, name) for name in (first, then)}
        missing = [name for name, curve in curves.items() if not curve.seeds]
        if missing:
            yield replace(part, note=f"not run: {', '.join(missing)}")
        elif min(len(curve.seeds) for curve in curves.values()) < LEAST_SEEDS:
            yield replace(part, note=f"fewer than {LEAST_SEEDS} seeds")
        else:
            last = min(max(curve.rollouts, default=0) for curve in curves.values())
            yield _later(part, *(curves[name].until(last) for name in (then, first)))


def _later(part: Part, curve: Curve, other: Curve) -> Part:
    """What is known of a curve's levelling off later than another's."""
    if min(len(own.steps) for own in (curve, other)) < WINDOW:
        return replace(part, note=f"fewer than {WINDOW} evaluations")
    part = replace(part, budget=float(max(own.steps[-1] for own in (curve, other))))
    later = later_by(curve, other)
    if later.value is None:
        late = [name for name, end in zip((part.method, part.rival), later.ends, strict=True) if math.isinf(end)]
        return replace(part, note="neither levels off" if len(late) == 2 else f"{late[0]} does not level off")
    return replace(part, value=later.value / 1e6, low=later.low / 1e6, high=later.high / 1e6)


def _learned(trials: Trials) -> list[tuple[str, bool]]:
    """The methods of c4 and c5, and whether they count."""
    return [(name, True) for name in PROPOSED] + [("collie", False)] * ("collie" in trials.methods)


def _at_each_point(
    trials: Trials, part: Part, points: Sequence[At], measured: Callable[[Part, At], Part]
) -> Iterator[Part]:
    there = trials.points(part.method, points)
    if not there:
        yield replace(part, note="not run")
        return
    for at in points:
        yield measured(replace(part, at=at), at) if at in there else replace(part, at=at, note="not run")


def _against(trials: Trials, part: Part, rival: str, at: At, metric: str) -> Part:
    difference = trials.values(part.method, at, metric) - trials.values(rival, at, metric)
    return _with(replace(part, rival=rival, at=at), difference)


def _with(part: Part, values: Floats) -> Part:
    value, low, high = (float(number) for number in intervals(values[None])[0])
    return replace(part, value=value, low=low, high=high)


_MEAN = "mean delivered at the end [%]"
CLAIMS: dict[str, tuple[str, str, Callable[[Trials], Iterable[Part]]]] = {
    "c1": (
        "wild and any deliver at least 95 % with one flock",
        _MEAN,
        lambda trials: _delivered(trials, PROPOSED, FLOCKS[:1], Side(least=95.0)),
    ),
    "c2": (
        "wild and any deliver at least 80 % with each of 2 to 5 flocks",
        _MEAN,
        lambda trials: _delivered(trials, PROPOSED, FLOCKS[1:], Side(least=80.0)),
    ),
    "c3": (
        "original delivers less than 50 % throughout",
        _MEAN,
        lambda trials: _delivered(trials, ("original",), EVERYWHERE, Side(most=50.0, strict=True)),
    ),
    "c4": (
        "wild and any deliver at least as much as the best heuristic with 2 to 5 flocks and at n = 10",
        "mean paired difference to the heuristic with the highest mean [percentage points]",
        lambda trials: _like_the_best(trials, (*FLOCKS[1:], COHESION[0]), Side(least=-1.0)),
    ),
    "c5": (
        "the paths of wild and any are 50 to 150 m shorter than of each heuristic that delivers at least 50 %",
        "mean paired difference of path lengths [m]",
        lambda trials: _shorter(trials, EVERYWHERE, Side(least=-150.0, most=-50.0), delivers=50.0),
    ),
    "c6": (
        "every method delivers less as n falls",
        "Spearman correlation of mean delivered with n",
        lambda trials: _follows_n(trials, "in_goal_end", Side(least=0.0, strict=True)),
    ),
    "c7": (
        "the paths of every method are longer for small n",
        "Spearman correlation of mean path length with n",
        lambda trials: _follows_n(trials, "path_length", Side(most=0.0, strict=True)),
    ),
    "c8": (
        "wild levels off before any",
        "difference of the shepherd-steps at which they level off [millions]",
        lambda trials: _levels_off_before(trials, "wild", "any"),
    ),
}
"""By name: what is claimed, what the numbers of its parts are, and the parts."""
