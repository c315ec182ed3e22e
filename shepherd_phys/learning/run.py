"""`train`: a training run in a folder, from its first rollout or its last checkpoint to its budget."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.logger import configure

from shepherd_phys.controllers.policy_files import write_policy
from shepherd_phys.learning import checkpoints
from shepherd_phys.learning.checkpoints import Checkpoint
from shepherd_phys.learning.export import spec_of, to_policy
from shepherd_phys.learning.folder import (
    BEST,
    CHECKPOINTS,
    CURVE,
    CURVE_COLUMNS,
    FIRST,
    POLICY,
    PRESET,
    TENSORBOARD,
    VALIDATION,
    VALIDATION_COLUMNS,
    Table,
    alone,
)
from shepherd_phys.learning.ppo import Learner
from shepherd_phys.learning.preset import Preset
from shepherd_phys.learning.validation import Validator, validator


class Progress(NamedTuple):
    """What a run reports after each rollout and each validation."""

    shepherd_steps: int
    budget: int
    rate: float
    """Shepherd-steps a second since this process began to train, validations left out."""
    measures: Mapping[str, float]
    """Of the rollout, see `CURVE_COLUMNS`."""
    validation: Sequence[Mapping[str, Any]]
    """The rows of a validation; empty after a rollout."""


class Chosen(NamedTuple):
    """A policy that validation has picked."""

    score: float
    shepherd_steps: int
    weights: dict[str, NDArray[np.float32]]


def train(
    folder: Path,
    n_workers: int = 1,
    report: Callable[[Progress], None] = lambda _: None,
    seconds: float = math.inf,
    classes: Iterable[Any] = (),
) -> Chosen | None:
    """Train in a folder, from its last checkpoint if it has one, until the budget is spent.

    Writes `CURVE`, `VALIDATION`, checkpoints and what TensorBoard reads; `POLICY`, the latest policy, `BEST`, the best
    by validation, and `FIRST`, the first that passed where the preset says what passing is. Killed at any moment it
    loses at most what came after the last checkpoint, and goes on from there exactly as if it had not been killed.

    Args:
        folder: of the run, made by `shepherd_phys.learning.folder.begin`.
        n_workers: processes for the worlds, and as many for validations; 1: none but this one. Results do not depend
            on it.
        report: called after each rollout and each validation.
        seconds: of training, as in the curve: the run ends with the first rollout that reaches them, too.
        classes: a user's own (of bodies, flock models, obstacles) that the preset's scenario names.

    Returns:
        the best policy.

    Raises:
        SettingsError: another process trains in the folder; or the policy to start from cannot be had.
        TrainingError: something is not finite.
        CheckpointError: a checkpoint cannot be written, or none of those there can be read.
    """
    with alone(folder):
        preset = Preset.from_toml(folder / PRESET, classes)
        saved = checkpoints.load_latest(folder / CHECKPOINTS)
        logger = configure(str(folder / TENSORBOARD), ["tensorboard"])
        learner = Learner(preset, n_workers if n_workers > 1 else 0, logger, fresh=saved is None)
        try:
            with validator(preset, n_workers) as validate:
                run = _Run(folder, learner, validate, report, saved, seconds)
                while not run.over:
                    run.interval()
                    if run.over or run.number % preset.validation.every == 0:
                        run.judge()
                    run.save()
                logger.dump(learner.model.num_timesteps)
                return run.chosen.get(BEST)
        finally:
            learner.close()
            logger.close()


class _Run:
    """A run between two checkpoints: what `train` does, in three steps."""

    def __init__(
        self,
        folder: Path,
        learner: Learner,
        validate: Validator,
        report: Callable[[Progress], None],
        saved: Checkpoint | None,
        limit: float,
    ) -> None:
        self._folder, self._learner, self._validate, self._report = folder, learner, validate, report
        self._limit = limit
        self.number = 0
        self.chosen: dict[str, Chosen] = {}
        """By the file that holds it."""
        seconds = 0.0
        if saved is not None:
            learner.restore(saved.arrays, saved.facts)
            self.number, self.chosen, seconds = saved.number, _chosen_of(saved), float(saved.facts["seconds"])
            self._export()  # the kill may have come between the two files of a policy
        self._curve = Table(folder / CURVE, CURVE_COLUMNS, learner.rollouts)
        self._validations = Table(folder / VALIDATION, VALIDATION_COLUMNS, self.number)
        self._clock = _Clock(seconds, learner.shepherd_steps)
        self._measures: dict[str, float] = {}
        self.over = saved is not None and self._spent()
        """Whether the budget is spent, or the time. It changes with a rollout only: a run ends with a validation."""

    def _spent(self) -> bool:
        seconds = self._clock.seconds()
        return self._learner.shepherd_steps >= self._learner.preset.budget or seconds >= self._limit

    def interval(self) -> None:
        """Begin anew in all worlds and learn from as many rollouts as lie between two checkpoints."""
        learner, logger = self._learner, self._learner.model.logger
        learner.restart(self.number)
        for _ in range(learner.preset.checkpoint_rollouts):
            measures = learner.learn()
            measures["in_goal_end"] = 100.0 * measures.pop("in_goal")
            self._measures = measures
            self._curve.add(
                {
                    **measures,
                    "rollout": learner.rollouts,
                    "shepherd_steps": learner.shepherd_steps,
                    "decisions": learner.model.num_timesteps,
                    "seconds": self._clock.seconds(),
                }
            )
            for name in ("episode_reward", "in_goal_end", "path_length"):
                if math.isfinite(measures[name]):
                    logger.record(f"episodes/{name}", measures[name])
            logger.record("time/shepherd_steps", learner.shepherd_steps)
            self._tell(())
            self.over = self._spent()
            if self.over:
                break
        self.number += 1

    def judge(self) -> None:
        """Validate the policy; keep it if it is the best so far, or the first that passes."""
        learner, logger = self._learner, self._learner.model.logger
        steps = learner.shepherd_steps
        policy = to_policy(learner.model, spec_of(learner.preset, steps))
        with self._clock.stopped():
            rows = self._validate(policy)
        score = self._validate.score(rows)
        if BEST not in self.chosen or score > self.chosen[BEST].score:
            self.chosen[BEST] = Chosen(score, steps, policy.weights)
        if FIRST not in self.chosen and self._validate.passes(rows):
            self.chosen[FIRST] = Chosen(score, steps, policy.weights)
        for row in rows:
            self._validations.add({**row, "checkpoint": self.number, "shepherd_steps": steps})
            point = f"{row['n_flocks']}_flocks_n_{row['cohesion']}_{row['n_shepherds']}_shepherds"
            logger.record(f"validation/in_goal_end_{point}", row["in_goal_end"])
        logger.record("validation/score", score)
        self._tell(rows)

    def save(self) -> None:
        """Write the checkpoint and the policies."""
        arrays, facts = self._learner.state()
        facts["seconds"] = self._clock.seconds()
        for file, kept in self.chosen.items():
            key = Path(file).stem
            arrays |= {f"{key}/{name}": array for name, array in kept.weights.items()}
            facts[key] = {"score": kept.score, "shepherd_steps": kept.shepherd_steps}
        checkpoints.save(self._folder / CHECKPOINTS, Checkpoint(self.number, arrays, facts))
        self._export()

    def _export(self) -> None:
        """Write the latest policy and those that were picked."""
        learner = self._learner
        to_policy(learner.model, spec_of(learner.preset, learner.shepherd_steps), self._folder / POLICY)
        for file, kept in self.chosen.items():
            if file == FIRST and (self._folder / file).exists():
                continue  # with the budget of its day: its trials are known by its checksum
            write_policy(self._folder / file, spec_of(learner.preset, kept.shepherd_steps), kept.weights)

    def _tell(self, validation: Sequence[Mapping[str, Any]]) -> None:
        steps = self._learner.shepherd_steps
        rate = self._clock.rate(steps)
        self._report(Progress(steps, self._learner.preset.budget, rate, self._measures, validation))


def _chosen_of(saved: Checkpoint) -> dict[str, Chosen]:
    chosen = {}
    for file in (BEST, FIRST):
        key = Path(file).stem
        if key in saved.facts:
            own = {name: array for name, array in saved.arrays.items() if name.startswith(f"{key}/")}
            weights = {name.removeprefix(f"{key}/"): array for name, array in own.items()}
            facts = saved.facts[key]
            chosen[file] = Chosen(float(facts["score"]), int(facts["shepherd_steps"]), weights)
    return chosen


class _Clock:
    """Wall-clock time that a run has trained over all its processes, and the pace of this one."""

    def __init__(self, seconds: float, shepherd_steps: int) -> None:
        self._before, self._steps = seconds, shepherd_steps
        self._began = time.monotonic()

    def _here(self) -> float:
        return time.monotonic() - self._began

    def seconds(self) -> float:
        """Since the run began [s]."""
        return round(self._before + self._here(), 3)

    def rate(self, shepherd_steps: int) -> float:
        """Shepherd-steps a second."""
        return (shepherd_steps - self._steps) / max(self._here(), 1e-9)

    @contextmanager
    def stopped(self) -> Iterator[None]:
        """While something is done that is not training."""
        at = time.monotonic()
        try:
            yield
        finally:
            self._began += time.monotonic() - at
