"""What many episodes say together: means with bootstrap intervals, paired differences, rank correlations."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .evaluation import LABELS, METRICS

RESAMPLES = 10_000
"""Bootstrap resamples of an interval."""
LEVEL = 0.95
"""Confidence of an interval."""
BOOTSTRAP_SEED = 20_140_401
"""Resampling is seeded: the same rows give the same interval."""
DELIVERED, WORST = "in_goal_end", "in_goal_end_worst"
"""The headline, and the column for its least value: a mean of 99.9 may hide a flock that was forgotten."""
BLOCK = 2_000_000
"""Numbers drawn at once, so that memory does not grow with the number of trials."""

Row = Mapping[str, Any]


def bootstrap(values: NDArray[np.float64], resamples: int = RESAMPLES) -> NDArray[np.float64]:
    """Means of seeded resamples with replacement.

    Args:
        values: (M, n) M measures of n trials; each resample takes the same trials of every measure.
        resamples: B.

    Returns:
        (M, B).
    """
    rng = np.random.default_rng(BOOTSTRAP_SEED)
    n = values.shape[1]
    means = np.empty((len(values), resamples))
    rows = max(1, BLOCK // n)
    for start in range(0, resamples, rows):
        chosen = rng.integers(n, size=(min(rows, resamples - start), n), dtype=np.int32)
        for measure, out in zip(values, means, strict=True):
            # not a product with counts: sums by BLAS depend on its threads in the last bit
            out[start : start + len(chosen)] = measure[chosen].mean(axis=1)
    return means


def intervals(values: NDArray[np.float64], resamples: int = RESAMPLES) -> NDArray[np.float64]:
    """Mean and 95 % bootstrap percentile interval of each measure.

    Args:
        values: (M, n) M measures of n >= 1 trials.
        resamples: bootstrap resamples.

    Returns:
        (M, 3) mean, low, high.
    """
    tail = 50.0 * (1.0 - LEVEL)
    low, high = np.percentile(bootstrap(values, resamples), [tail, 100.0 - tail], axis=1)
    return np.stack([values.mean(axis=1), low, high], axis=1)


def summarise(rows: Iterable[Row], metrics: Sequence[str] = METRICS) -> list[dict[str, Any]]:
    """One row a point: labels, ``trials``, ``NAME_mean, NAME_low, NAME_high`` of each metric, and `WORST` of one.

    Points are told apart by whichever of `LABELS` the rows have, and come in the order in which they first appear; the
    order of the rows within a point does not matter. Truth counts as 1 and 0.
    """
    summary = []
    for labels, trials in _by_point(rows).items():
        values = np.array([[float(row[name]) for row in trials] for name in metrics])
        row = {**dict(labels), "trials": len(trials), **_columns(metrics, intervals(values))}
        if DELIVERED in metrics:
            row[WORST] = float(values[list(metrics).index(DELIVERED)].min())
        summary.append(row)
    return summary


def paired_differences(rows: Iterable[Row], baseline: str, metrics: Sequence[str] = METRICS) -> list[dict[str, Any]]:
    """Each controller minus ``baseline`` on the same seeds of the same point.

    Returns:
        one row a point that the baseline has too: its labels, ``baseline``, ``trials`` (seeds that both have; points
        without any are left out), and ``NAME_diff_mean, NAME_diff_low, NAME_diff_high`` of each metric.

    Raises:
        ValueError: no row is the baseline's.
    """
    points = _by_point(rows)
    theirs = {
        _without_controller(labels): {row["seed"]: row for row in trials}
        for labels, trials in points.items()
        if dict(labels).get("controller") == baseline
    }
    if not theirs:
        raise ValueError(f"baseline: no row has the controller {baseline!r}")
    differences = []
    for labels, trials in points.items():
        others = theirs.get(_without_controller(labels), {})
        pairs = [(row, others[row["seed"]]) for row in trials if row["seed"] in others]
        if dict(labels).get("controller") == baseline or not pairs:
            continue
        values = np.array([[float(own[name]) - float(other[name]) for own, other in pairs] for name in metrics])
        names = [f"{name}_diff" for name in metrics]
        differences.append(
            {**dict(labels), "baseline": baseline, "trials": len(pairs), **_columns(names, intervals(values))}
        )
    return differences


def correlation(x: NDArray[np.float64], values: NDArray[np.float64]) -> tuple[float, float, float]:
    """Spearman correlation of the means of k series with ``x``, and its 95 % bootstrap percentile interval.

    A resample takes the same trials of every series. One whose means are all equal says nothing about the order: it
    counts as -1 for the low end and as 1 for the high one.

    Args:
        x: (k,).
        values: (k, n) n trials of each series, paired.

    Returns:
        value (NaN where the k means are all equal), low, high.
    """
    tail = 50.0 * (1.0 - LEVEL)
    value = float(spearman(x, _even(values.mean(axis=1))[:, None])[0])
    resampled = spearman(x, _even(bootstrap(values)))
    low = np.percentile(np.nan_to_num(resampled, nan=-1.0), tail)
    high = np.percentile(np.nan_to_num(resampled, nan=1.0), 100.0 - tail)
    return value, float(low), float(high)


def spearman(x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
    """Spearman's rank correlation, equal values sharing the average of their ranks.

    Args:
        x: (k,).
        y: (k, m) m series.

    Returns:
        (m,) in [-1, 1]; NaN where x or the series is constant.
    """
    a = ranks(x[:, None])
    b = ranks(y)
    a, b = a - a.mean(axis=0), b - b.mean(axis=0)
    size = np.sqrt((a**2).sum(axis=0) * (b**2).sum(axis=0))
    return np.asarray(np.divide((a * b).sum(axis=0), size, out=np.full(y.shape[1], np.nan), where=size > 0))


def ranks(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """(k, m) rank of each value in its column, from 1; equal values share the average of their ranks."""
    less = (values[None] < values[:, None]).sum(axis=1)
    equal = (values[None] == values[:, None]).sum(axis=1)
    return np.asarray(less + 0.5 * (equal + 1.0))


def _even(means: NDArray[np.float64]) -> NDArray[np.float64]:
    """Means without their last bits: the same trials summed in another order must be equal."""
    return np.asarray(np.round(means, 9))


def summary_columns(labels: Sequence[str] = LABELS, metrics: Sequence[str] = METRICS) -> tuple[str, ...]:
    """Columns of ``summary.csv``."""
    columns = (*labels, "trials", *(f"{name}_{part}" for name in metrics for part in ("mean", "low", "high")))
    return (*columns, WORST) if DELIVERED in metrics else columns


def difference_columns(labels: Sequence[str] = LABELS, metrics: Sequence[str] = METRICS) -> tuple[str, ...]:
    """Columns of ``differences.csv``."""
    return *labels, "baseline", *summary_columns((), [f"{name}_diff" for name in metrics])


_Labels = tuple[tuple[str, Any], ...]


def _by_point(rows: Iterable[Row]) -> dict[_Labels, list[Row]]:
    """Rows by their labels, sorted by seed: so that nothing depends on their order."""
    points: dict[_Labels, list[Row]] = {}
    for row in rows:
        points.setdefault(tuple((name, row[name]) for name in LABELS if name in row), []).append(row)
    return {labels: sorted(trials, key=lambda row: int(row["seed"])) for labels, trials in points.items()}


def _without_controller(labels: _Labels) -> _Labels:
    return tuple(pair for pair in labels if pair[0] != "controller")


def _columns(names: Sequence[str], numbers: NDArray[np.float64]) -> dict[str, float]:
    return {
        f"{name}_{part}": float(number)
        for name, triple in zip(names, numbers, strict=True)
        for part, number in zip(("mean", "low", "high"), triple, strict=True)
    }
