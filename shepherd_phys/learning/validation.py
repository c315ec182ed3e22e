"""Judging a policy during training: as deployed, on validation seeds, in processes of its own or in this one."""

from __future__ import annotations

import json
from collections import deque
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any, NamedTuple

import numpy as np

from shepherd_phys.controllers.evaluation import run_episode, trial_seed
from shepherd_phys.controllers.learned import Policy
from shepherd_phys.envs._team_world import with_team
from shepherd_phys.envs.shepherding import ShepherdingEnv
from shepherd_phys.learning.folder import MEASURES
from shepherd_phys.learning.preset import Preset
from shepherd_phys.scenario import Scenario, with_neighbours
from shepherd_phys.workers import Job, Workers, explain, finished

TIMEOUT = 600.0
"""An episode that takes longer is lost [s]."""


class ValidationError(RuntimeError):
    """An episode of a validation did not end; the message says why."""


class Play(NamedTuple):
    """A policy in a world: what a worker is sent."""

    policy: Policy
    scenario: Scenario


def episode(play: Play, seed: int) -> Mapping[str, Any]:
    """Run one episode."""
    env = ShepherdingEnv(play.scenario, rewards={}, lidar=play.policy.lidar)
    return run_episode(play.policy, env, seed)


class Validator:
    """Runs the validation of a preset.

    Args:
        preset: the run.
        workers: processes that run episodes; None: this process does.
    """

    def __init__(self, preset: Preset, workers: Workers | None = None) -> None:
        self._settings = preset.validation
        self._workers = workers
        self.points = points(preset)
        """What the worlds are, in order."""
        self._scenarios = scenarios(preset)
        self._seeds = [trial_seed(self._settings.seed, trial) for trial in range(self._settings.trials)]

    def __call__(self, policy: Policy) -> list[dict[str, Any]]:
        """Mean measures of the policy at each point; see `shepherd_phys.controllers.evaluation.run_episode`.

        Raises:
            ValidationError: an episode did not end.
        """
        jobs = [
            Job((i, seed), Play(policy, scenario), seed)
            for i, scenario in enumerate(self._scenarios)
            for seed in self._seeds
        ]
        rows: dict[tuple[int, int], Mapping[str, Any]] = {}
        if self._workers is None:
            for job in jobs:
                try:
                    rows[job.key] = episode(job.spec, job.seed)
                except Exception as error:  # a user's own code may raise anything
                    raise ValidationError(f"validation, seed {job.seed}: {explain(error)}") from error
        else:
            for ended in finished(self._workers, deque(jobs)):
                if ended.result is None:
                    raise ValidationError(f"validation, seed {ended.key[1]}: {ended.cause}")
                rows[ended.key] = json.loads(ended.result)
        return [
            {
                **point,
                "trials": len(self._seeds),
                **{name: float(np.mean([rows[i, seed][name] for seed in self._seeds])) for name in MEASURES},
            }
            for i, point in enumerate(self.points)
        ]

    def score(self, rows: list[dict[str, Any]]) -> float:
        """What the best policy has most of: percent of the sheep in at the end, mean over the points, less walking."""
        delivered = float(np.mean([row["in_goal_end"] for row in rows]))
        return delivered - self._settings.path_cost * float(np.mean([row["path_length"] for row in rows]))

    def passes(self, rows: list[dict[str, Any]]) -> bool:
        """Whether every point has reached what the preset asks for, if it asks for something."""
        wanted = self._settings.passes
        return wanted is not None and all(row["in_goal_end"] >= wanted for row in rows)


@contextmanager
def validator(preset: Preset, n_workers: int) -> Iterator[Validator]:
    """A `Validator` with ``n_workers`` processes of its own; with fewer than 2, this process does it."""
    if n_workers < 2:
        yield Validator(preset)
        return
    with Workers(episode, n_workers, TIMEOUT) as workers:
        yield Validator(preset, workers)


def points(preset: Preset) -> list[dict[str, Any]]:
    """What the worlds of a preset's validation are, in order; ``cohesion`` is None where the flock model has no n."""
    asked = preset.validation
    return [
        {"n_flocks": n_flocks, "cohesion": cohesion, "n_shepherds": n_shepherds}
        for n_flocks in asked.flocks
        for cohesion in (asked.cohesion if hasattr(preset.scenario.flock, "n_neighbours") else (None,))
        for n_shepherds in asked.shepherds
    ]


def scenarios(preset: Preset) -> list[Scenario]:
    """The scenarios of a preset's `points`.

    Raises:
        SettingsError: a point cannot be.
    """
    return [_scenario(preset.scenario, point) for point in points(preset)]


def _scenario(base: Scenario, point: Mapping[str, Any]) -> Scenario:
    """The scenario of a point."""
    if point["cohesion"] is not None:
        base = with_neighbours(base, point["cohesion"])
    return with_team(base.but(n_flocks=point["n_flocks"]), point["n_shepherds"])
