"""Episodes a second of a campaign with one worker and with two, measured in turn on the same episodes."""

from __future__ import annotations

import statistics
import sys
import time
from collections import deque
from contextlib import ExitStack
from typing import Any

from shepherd_phys.controllers.evaluation import trial_seed
from shepherd_phys.workers import Job, Workers, finished

from .points import Point, episode, points

CONTROLLERS = ("strombom", "pierson", "elfiqi", "occlusion")
FLOCKS = 2
ROOT_SEED = 0
"""Of the episodes that are timed (tuning seeds)."""
TIMEOUT = 600.0
"""[s]"""


def throughput(runs: int, n_seeds: int, scenario: str = "paper") -> dict[str, Any]:
    """Time the same episodes of the heuristics with one worker and with two, in turn.

    Workers are started before and do one episode of every controller each, so that the figures are those of a long
    campaign; how long that took is a figure of its own. There is no ledger.

    Args:
        runs: how often each is timed; the order changes from run to run.
        n_seeds: episodes of each controller in a run.
        scenario: a preset's name or a TOML file.

    Returns:
        medians over the runs: ``worker_ratio``, episodes a second of two workers over those of one;
        ``episodes_per_second_one_worker`` and ``.._two_workers`` of all together, ``.._by_controller`` with one worker;
        ``start_seconds`` of one and of two workers; ``episodes`` timed in a run and ``runs``.

    Raises:
        RuntimeError: an episode fails.
    """
    grid = points(controllers=CONTROLLERS, scenario=scenario, flocks=[FLOCKS])
    seeds = [trial_seed(ROOT_SEED, trial) for trial in range(n_seeds)]
    episodes = {point.controller: [Job(f"{point}, {seed}", [point], seed) for seed in seeds] for point in grid}
    every = [job for jobs in episodes.values() for job in jobs]
    start_seconds: dict[str, float] = {}
    pools: dict[int, Workers] = {}
    whole: dict[int, list[float]] = {1: [], 2: []}
    by_controller: dict[str, list[float]] = {name: [] for name in CONTROLLERS}
    with ExitStack() as stack:
        for n in (1, 2):
            begun = time.perf_counter()
            pools[n] = stack.enter_context(Workers(one_after_another, n, TIMEOUT))
            # one job of everything for each: the second starts before the first is through
            _seconds(pools[n], [Job(f"worker {i}", grid, ROOT_SEED) for i in range(n)])
            start_seconds[str(n)] = time.perf_counter() - begun
        for run in range(runs):
            for n in (1, 2) if run % 2 == 0 else (2, 1):
                if n == 1:
                    parts = {name: _seconds(pools[n], jobs) for name, jobs in episodes.items()}
                    for name, seconds in parts.items():
                        by_controller[name].append(n_seeds / seconds)
                    whole[n].append(len(every) / sum(parts.values()))
                else:
                    whole[n].append(len(every) / _seconds(pools[n], every))
            print(f"run {run + 1}/{runs}: {whole[1][-1]:.2f}, {whole[2][-1]:.2f} episodes/s", file=sys.stderr)
    return {
        "worker_ratio": statistics.median(two / one for one, two in zip(whole[1], whole[2], strict=True)),
        "episodes_per_second_one_worker": statistics.median(whole[1]),
        "episodes_per_second_two_workers": statistics.median(whole[2]),
        "episodes_per_second_by_controller": {name: statistics.median(by_controller[name]) for name in CONTROLLERS},
        "start_seconds": start_seconds,
        "episodes": len(every),
        "runs": runs,
    }


def one_after_another(points: list[Point], seed: int) -> dict[str, int]:
    """Episodes of several points, the work of the workers; how many control steps they had."""
    return {"steps": sum(episode(point, seed)["steps"] for point in points)}


def _seconds(pool: Workers, todo: list[Job]) -> float:
    """Time that a pool takes."""
    begun = time.perf_counter()
    for ended in finished(pool, deque(todo)):
        if ended.result is None:
            raise RuntimeError(f"{ended.key}: {ended.cause}")
    return time.perf_counter() - begun
