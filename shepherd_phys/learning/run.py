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

from shepherd_phys.controllers.learned import Policy
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
)
from shepherd_phys.learning.ppo import Learner
from shepherd_phys.learning.preset import Preset
from shepherd_phys.learning.validation import validator


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
        TrainingError: something is not finite.
        CheckpointError: a checkpoint cannot be written, or none of those there can be read.
    """
    preset = Preset.from_toml(folder / PRESET)
    logger = configure(str(folder / TENSORBOARD), ["tensorboard"])
    learner = Learner(preset, n_workers if n_workers > 1 else 0, logger)
    try:
        with validator(preset, n_workers) as validate:
            number, best, seconds = 0, None, 0.0
            saved = checkpoints.load_latest(folder / CHECKPOINTS)
            if saved is not None:
                number, best, seconds = saved.number, _best_of(saved), float(saved.facts["seconds"])
                learner.restore(dict(saved.arrays), dict(saved.facts))
                _export(folder, learner, best)
            curve = Table(folder / CURVE, CURVE_COLUMNS, learner.rollouts)
            validations = Table(folder / VALIDATION, VALIDATION_COLUMNS, number)
            clock = _Clock(seconds, learner.shepherd_steps)
            while learner.shepherd_steps < preset.budget:
                learner.restart(number)
                for _ in range(preset.checkpoint_rollouts):
                    measures = learner.learn()
                    steps = learner.shepherd_steps
                    measures |= {"in_goal_end": 100.0 * measures.pop("in_goal"), "seconds": clock.seconds()}
                    decisions = learner.model.num_timesteps
                    counts = {"rollout": learner.rollouts, "shepherd_steps": steps, "decisions": decisions}
                    curve.add({**measures, **counts})
                    for name in ("episode_reward", "in_goal_end", "path_length"):
                        if math.isfinite(measures[name]):
                            logger.record(f"episodes/{name}", measures[name])
                    logger.record("time/shepherd_steps", steps)
                    report(Progress(steps, preset.budget, clock.rate(steps), measures, ()))
                    if steps >= preset.budget:
                        break
                number += 1
                if number % preset.validation.every == 0 or steps >= preset.budget:
                    policy = to_policy(learner.model, spec_of(preset, steps))
                    rows = validate(policy)
                    score = validate.score(rows)
                    if best is None or score > best.score:
                        best = Best(score, steps, policy.weights)
                    for row in rows:
                        validations.add({**row, "checkpoint": number, "shepherd_steps": steps})
                        logger.record(f"validation/in_goal_end/{row['n_flocks']}_flocks", row["in_goal_end"])
                    logger.record("validation/score", score)
                    report(Progress(steps, preset.budget, clock.rate(steps), measures, rows))
                checkpoints.save(folder / CHECKPOINTS, _checkpoint(number, learner, best, clock.seconds()))
                _export(folder, learner, best)
            logger.dump(learner.model.num_timesteps)
            return best
    finally:
        learner.close()
        logger.close()


def _checkpoint(number: int, learner: Learner, best: Best | None, seconds: float) -> Checkpoint:
    arrays, facts = learner.state()
    facts["seconds"] = seconds
    if best is not None:
        arrays |= {f"best/{name}": array for name, array in best.weights.items()}
        facts["best"] = {"score": best.score, "shepherd_steps": best.shepherd_steps}
    return Checkpoint(number, arrays, facts)


def _best_of(saved: Checkpoint) -> Best | None:
    if "best" not in saved.facts:
        return None
    weights = {name.removeprefix("best/"): a for name, a in saved.arrays.items() if name.startswith("best/")}
    return Best(float(saved.facts["best"]["score"]), int(saved.facts["best"]["shepherd_steps"]), weights)


def _export(folder: Path, learner: Learner, best: Best | None) -> None:
    """Write the latest policy and the best one."""
    preset = learner.preset
    to_policy(learner.model, spec_of(preset, learner.shepherd_steps), folder / POLICY)
    if best is not None:
        write_policy(folder / BEST, spec_of(preset, best.shepherd_steps), best.weights)


def best_policy(folder: Path) -> Policy:
    """The best policy of a run."""
    return Policy.load(folder / BEST)


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
