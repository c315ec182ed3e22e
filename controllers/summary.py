"""What many episodes say together: means with bootstrap intervals, and paired differences."""

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
    """One row a point of the experiment: its labels, ``trials``, and ``NAME_mean, NAME_low, NAME_high`` of each metric.

    Points are told apart by whichever of `LABELS` the rows have, and come in the order in which they first appear; the
    order of the rows within a point does not matter. Truth counts as 1 and 0.
    """
    summary = []
    for labels, trials in _by_point(rows).items():
        values = np.array([[float(row[name]) for row in trials] for name in metrics])
        summary.append({**dict(labels), "trials": len(trials), **_columns(metrics, intervals(values))})
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


def summary_columns(labels: Sequence[str] = LABELS, metrics: Sequence[str] = METRICS) -> tuple[str, ...]:
    """Columns of ``summary.csv``."""
    return (*labels, "trials", *(f"{name}_{part}" for name in metrics for part in ("mean", "low", "high")))


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
