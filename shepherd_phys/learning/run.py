"""`train`: a training run in a folder, from its first rollout or its last checkpoint to its budget."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
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
    """Shepherd-steps a second since this process began to train, validations included."""
    measures: Mapping[str, float]
    """Of the rollout, see `CURVE_COLUMNS`."""
    validation: Sequence[Mapping[str, Any]]
    """The rows of a validation; empty after a rollout."""


class Best(NamedTuple):
    """The best policy so far by validation."""

    score: float
    shepherd_steps: int
    weights: dict[str, NDArray[np.float32]]


def train(folder: Path, n_workers: int = 1, report: Callable[[Progress], None] = lambda _: None) -> Best | None:
    """Train in a folder, from its last checkpoint if it has one, until the budget is spent.

    Writes `CURVE`, `VALIDATION`, checkpoints and what TensorBoard reads; `POLICY`, the latest policy, and `BEST`, the
    best by validation. Killed at any moment it loses at most what came after the last checkpoint, and goes on from
    there exactly as if it had not been killed.

    Args:
        folder: of the run, made by `shepherd_phys.learning.folder.begin`.
        n_workers: processes for the worlds, and as many for validations; 1: none but this one. Results do not depend
            on it.
        report: called after each rollout and each validation.

    Returns:
        the best policy.

    Raises:
        SettingsError: another process trains in the folder; or the policy to start from cannot be had.
        TrainingError: something is not finite.
        CheckpointError: a checkpoint cannot be written, or none of those there can be read.
    """
    with alone(folder):
        preset = Preset.from_toml(folder / PRESET)
        saved = checkpoints.load_latest(folder / CHECKPOINTS)
        logger = configure(str(folder / TENSORBOARD), ["tensorboard"])
        learner = Learner(preset, n_workers if n_workers > 1 else 0, logger, fresh=saved is None)
        try:
            with validator(preset, n_workers) as validate:
                run = _Run(folder, learner, validate, report, saved)
                while not run.over:
                    run.interval()
                    if run.over or run.number % preset.validation.every == 0:
                        run.judge()
                    run.save()
                logger.dump(learner.model.num_timesteps)
                return run.best
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
    ) -> None:
        self._folder, self._learner, self._validate, self._report = folder, learner, validate, report
        self.number = 0
        self.best: Best | None = None
        seconds = 0.0
        if saved is not None:
            learner.restore(saved.arrays, saved.facts)
            self.number, self.best, seconds = saved.number, _best_of(saved), float(saved.facts["seconds"])
            self._export()  # the kill may have come between the two files of a policy
        self._curve = Table(folder / CURVE, CURVE_COLUMNS, learner.rollouts)
        self._validations = Table(folder / VALIDATION, VALIDATION_COLUMNS, self.number)
        self._clock = _Clock(seconds, learner.shepherd_steps)
        self._measures: dict[str, float] = {}

    @property
    def over(self) -> bool:
        """Whether the budget is spent."""
        return self._learner.shepherd_steps >= self._learner.preset.budget

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
            if self.over:
                break
        self.number += 1

    def judge(self) -> None:
        """Validate the policy; keep it if it is the best so far."""
        learner, logger = self._learner, self._learner.model.logger
        steps = learner.shepherd_steps
        policy = to_policy(learner.model, spec_of(learner.preset, steps))
        rows = self._validate(policy)
        score = self._validate.score(rows)
        if self.best is None or score > self.best.score:
            self.best = Best(score, steps, policy.weights)
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
        if self.best is not None:
            arrays |= {f"best/{name}": array for name, array in self.best.weights.items()}
            facts["best"] = {"score": self.best.score, "shepherd_steps": self.best.shepherd_steps}
        checkpoints.save(self._folder / CHECKPOINTS, Checkpoint(self.number, arrays, facts))
        self._export()

    def _export(self) -> None:
        """Write the latest policy and the best one."""
        learner = self._learner
        to_policy(learner.model, spec_of(learner.preset, learner.shepherd_steps), self._folder / POLICY)
        if self.best is not None:
            spec = spec_of(learner.preset, self.best.shepherd_steps)
            write_policy(self._folder / BEST, spec, self.best.weights)

    def _tell(self, validation: Sequence[Mapping[str, Any]]) -> None:
        steps = self._learner.shepherd_steps
        rate = self._clock.rate(steps)
        self._report(Progress(steps, self._learner.preset.budget, rate, self._measures, validation))


def _best_of(saved: Checkpoint) -> Best | None:
    if "best" not in saved.facts:
        return None
    weights = {name.removeprefix("best/"): a for name, a in saved.arrays.items() if name.startswith("best/")}
    return Best(float(saved.facts["best"]["score"]), int(saved.facts["best"]["shepherd_steps"]), weights)


class _Clock:
    """Wall-clock time of a run over all its processes, and the pace of this one."""

    def __init__(self, seconds: float, shepherd_steps: int) -> None:
        self._before, self._steps = seconds, shepherd_steps
        self._began = time.monotonic()

    def seconds(self) -> float:
        """Since the run began [s]."""
        return round(self._before + time.monotonic() - self._began, 3)

    def rate(self, shepherd_steps: int) -> float:
        """Shepherd-steps a second."""
        return (shepherd_steps - self._steps) / max(time.monotonic() - self._began, 1e-9)
