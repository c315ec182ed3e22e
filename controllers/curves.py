"""Learning curves as rows of ``figure1.csv``, and when they level off.

An **evaluation** is the mean reward of the whole episodes that ended in one rollout. A curve **levels off** at the
first evaluation after which it, averaged over the last `WINDOW` evaluations and over seeds, stays within `BAND` of its
range from its final value.

Every curve comes within that band of its own last value in the end, even one that rises to its end. So a curve that
does so only in its **tail**, the last `TAIL` of its shepherd-steps and at least the last `WINDOW` evaluations, has
**not levelled off**. Where a longer run would have is not known, not even that it would not have before the tail:
another final value may put that into the band, too.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from .summary import BOOTSTRAP_SEED, LEVEL, RESAMPLES

Floats = NDArray[np.float64]
Row = Mapping[str, Any]

COLUMNS = (
    "recipe", "reward", "seed", "rollout", "shepherd_steps", "decisions", "seconds", "episode_reward", "in_goal_end",
    "path_length",
)  # fmt: skip
"""Of ``figure1.csv``, one row an evaluation; ``rollout`` aligns the seeds of a scheme."""
WINDOW = 5
"""Evaluations over which a curve is averaged."""
BAND = 0.05
"""Of the range of the averaged curve."""
TAIL = 0.1
"""Of a curve's shepherd-steps: what is still under way in there has not levelled off."""


class Curve(NamedTuple):
    """The curves of one scheme's seeds, at the evaluations that all of them have."""

    seeds: tuple[int, ...]
    rollouts: tuple[int, ...]
    """E numbers, ascending."""
    steps: Floats
    """(E,) shepherd-steps, mean over seeds."""
    values: Floats
    """(n_seeds, E)."""

    def until(self, rollout: int) -> Curve:
        """The evaluations up to a rollout."""
        n = bisect_right(self.rollouts, rollout)
        return Curve(self.seeds, self.rollouts[:n], self.steps[:n], self.values[:, :n])


def curve_of(rows: Iterable[Row], recipe: str, reward: str, measure: str = "episode_reward") -> Curve:
    """The curves of a recipe and a reward scheme; without seeds where there are no rows of them.

    Args:
        rows: of ``figure1.csv``, in any order; a measure may be None.
        recipe: e.g. "fast".
        reward: name of the scheme.
        measure: the column.
    """
    found: dict[int, dict[int, tuple[float, float]]] = {}
    for row in rows:
        if (row["recipe"], row["reward"]) == (recipe, reward):
            own = found.setdefault(int(row["seed"]), {})
            if row[measure] is not None and math.isfinite(row[measure]):
                own[int(row["rollout"])] = float(row["shepherd_steps"]), float(row[measure])
    seeds = tuple(sorted(found))
    shared = sorted(set.intersection(*(set(found[seed]) for seed in seeds))) if seeds else []
    both = np.array([[found[seed][rollout] for rollout in shared] for seed in seeds], dtype=np.float64)
    both = both.reshape(len(seeds), len(shared), 2)
    steps = both[:, :, 0].mean(axis=0) if seeds else np.zeros(0)
    return Curve(seeds, tuple(shared), steps, both[:, :, 1])


def averaged(curves: Floats) -> Floats:
    """(m, E - WINDOW + 1) means of each of m curves (m, E) over the last `WINDOW` evaluations."""
    n = curves.shape[1] - WINDOW + 1
    total = np.zeros((len(curves), n))
    for k in range(WINDOW):
        total += curves[:, k : k + n]
    return total / WINDOW


def level_off(curves: Floats) -> NDArray[np.intp]:
    """(m,) index of the evaluation at which each of m curves (m, E), E >= `WINDOW`, levels off.

    The earliest is `WINDOW` - 1, the first for which there is an average.
    """
    means = averaged(curves)
    band = BAND * (means.max(axis=1) - means.min(axis=1))
    outside = np.abs(means - means[:, -1:]) > band[:, None] + 1e-12
    # one after the last that lies outside; the final one never does
    last = means.shape[1] - 1 - np.argmax(outside[:, ::-1], axis=1)
    return np.asarray(np.where(outside.any(axis=1), last + 1, 0) + WINDOW - 1)


def steps_at(curve: Curve, at: NDArray[np.intp]) -> Floats:
    """(m,) shepherd-steps at which curves level off; infinity where that lies in the tail.

    Args:
        curve: of at least `WINDOW` evaluations.
        at: (m,) what `level_off` says of curves at its evaluations, resampled ones perhaps.
    """
    tail = min((1.0 - TAIL) * curve.steps[-1], curve.steps[-WINDOW])
    found = curve.steps[at]
    return np.where(found < tail, found, math.inf)


class Later(NamedTuple):
    """Shepherd-steps by which one curve levels off later than another."""

    ends: tuple[float, float]
    """Shepherd-steps at which the curve and the other level off, as they are; infinity where one does not."""
    low: float
    """Low end of the 95 % bootstrap percentile interval."""
    high: float

    @property
    def value(self) -> float | None:
        """Of the curves as they are; None where one of them has not levelled off."""
        return self.ends[0] - self.ends[1] if all(map(math.isfinite, self.ends)) else None


def later_by(curve: Curve, other: Curve) -> Later:
    """Shepherd-steps by which a curve levels off later than another, with a 95 % bootstrap percentile interval.

    Seeds are resampled, those of the two curves independently: runs of equal seed have nothing in common but worlds
    that they soon lead elsewhere. Of a resample in which a curve has not levelled off nothing is known: it counts as
    -infinity for the low end of the interval and as infinity for the high one.

    Args:
        curve: of at least one seed and `WINDOW` evaluations.
        other: likewise.
    """
    rng = np.random.default_rng(BOOTSTRAP_SEED)
    ends = []
    for own in (curve, other):
        chosen = rng.integers(len(own.seeds), size=(RESAMPLES, len(own.seeds)))
        means = np.zeros((RESAMPLES, own.values.shape[1]))
        for k in range(len(own.seeds)):
            means += own.values[chosen[:, k]]
        means /= len(own.seeds)
        ends.append(steps_at(own, level_off(np.vstack([own.values.mean(axis=0)[None], means]))))
    known = np.isfinite(ends[0]) & np.isfinite(ends[1])
    later = np.subtract(ends[0], ends[1], out=np.zeros(len(known)), where=known)
    tail = 50.0 * (1.0 - LEVEL)
    # no interpolation: between a number and infinity there is nothing
    low = np.percentile(np.where(known, later, -math.inf)[1:], tail, method="lower")
    high = np.percentile(np.where(known, later, math.inf)[1:], 100.0 - tail, method="higher")
    return Later((float(ends[0][0]), float(ends[1][0])), float(low), float(high))


def levels_off_at(curve: Curve) -> float | None:
    """Shepherd-steps at which the mean over seeds levels off; None: not within its length."""
    if len(curve.steps) < WINDOW:
        return None
    (steps,) = steps_at(curve, level_off(curve.values.mean(axis=0)[None]))
    return float(steps) if math.isfinite(steps) else None


def final_value(curve: Curve) -> float | None:
    """Mean of the last `WINDOW` evaluations over seeds; None where there are none."""
    return float(curve.values[:, -WINDOW:].mean()) if curve.values.size else None
