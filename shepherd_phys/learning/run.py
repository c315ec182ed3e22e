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
from stable_baselines3.common.logger import KVWriter, Logger
from torch.utils.tensorboard import SummaryWriter

from shepherd_phys.controllers.policy_files import write_policy
from shepherd_phys.learning import checkpoints
from shepherd_phys.learning.checkpoints import Checkpoint, CheckpointError
from shepherd_phys.learning.export import actor_weights, spec_of, to_policy
from shepherd_phys.learning.folder import (
    BEST,
    CHECKPOINTS,
    CURVE,
    CURVE_COLUMNS,
    FIRST,
    POLICY,
    PRESET,
    SETTINGS,
    TENSORBOARD,
    UNJUDGED,
    VALIDATION,
    VALIDATION_COLUMNS,
    Table,
    agree,
    alone,
    check_resumable,
    check_settings,
    ended,
    is_policy_of,
    settings_of,
    start_of,
)
from shepherd_phys.learning.ppo import Learner
from shepherd_phys.learning.preset import Preset
from shepherd_phys.learning.validation import ValidationError, Validator, validator
from shepherd_phys.workers import WorkersError


class Progress(NamedTuple):
    """What a run reports after each rollout and each validation."""

    shepherd_steps: int
    length: int
    """Shepherd-steps of the whole run, not counting that the end of an episode cuts a decision short."""
    done: float
    """Part of the run's rollouts that are done."""
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
    preset: Preset | None = None,
    classes: Iterable[Any] = (),
) -> Chosen | None:
    """Train in a folder, from its last checkpoint if it has one, for as many rollouts as the preset tells.

    Writes `CURVE`, `VALIDATION`, checkpoints and what TensorBoard reads; `POLICY`, the latest policy, `BEST`, the best
    by validation, and `FIRST`, the first that passed where the preset says what passing is. Killed at any moment it
    loses at most what came after the last checkpoint, and goes on from there exactly as if it had not been killed.

    A run ends with a whole checkpoint interval, and its end is validated. Where that was not the checkpoint's turn, a
    run that is made longer goes back to the checkpoint before: so it equals the one that was longer from the start.

    Args:
        folder: of the run, made by `shepherd_phys.learning.folder.begin`.
        n_workers: processes for the worlds, and as many for validations; 1: none but this one. Results do not depend
            on it.
        report: called after each rollout and each validation.
        seconds: of training, as in the curve: the run ends with the first checkpoint that reaches them, too.
        preset: the run from now on, which may differ from the folder's in its budget alone; None: as it was. With a
            smaller budget training ends sooner, and the run stays the longer one that it is.
        classes: a user's own (of bodies, flock models, obstacles) that the folder's scenario names.

    Returns:
        the best policy.

    Raises:
        SettingsError: another process trains in the folder; it holds another run, its preset was changed, or its
            checkpoints are gone; or the policy to start from cannot be had.
        TrainingError: something is not finite.
        ValidationError, WorkersError: a validation failed; nothing learned is lost, and the run goes on with it.
        CheckpointError: a checkpoint cannot be written, or none of those there can be read, or gone on from.
    """
    with alone(folder):
        kept = Preset.from_toml(folder / PRESET, classes) if preset is None else agree(folder, preset, classes)
        n_rollouts = (preset or kept).n_rollouts
        if preset is None or preset.budget < kept.budget:
            preset = kept
        newest = saved = checkpoints.load_latest(folder / CHECKPOINTS)
        if newest is not None:
            check_settings(newest, preset, folder / PRESET, classes)
            if not ended(newest, n_rollouts, seconds):
                saved = _gone_on_from(newest, preset, folder / CHECKPOINTS)
        else:
            check_resumable(folder, preset)
        start = start_of(folder, preset) if saved is None else None
        decisions = 0 if saved is None else int(saved.facts["decisions"])
        logger = Logger(str(folder / TENSORBOARD), [_TensorBoard(folder / TENSORBOARD, decisions)])
        learner = Learner(preset, n_workers if n_workers > 1 else 0, logger, saved is None, start)
        try:
            with validator(preset, n_workers) as validate:
                # only now: until here a mistake leaves the run as it was
                if preset != kept:
                    preset.to_toml(folder / PRESET)
                if newest is not None and saved is not newest:
                    _forget(folder, newest, saved)
                run = _Run(folder, learner, validate, report, saved, n_rollouts, seconds)
                while run.unjudged or not run.over:
                    if not run.unjudged:
                        run.interval()
                    run.judge_in_turn()
                    run.save()
                return run.chosen.get(BEST)
        finally:
            learner.close()
            logger.close()


def _gone_on_from(newest: Checkpoint, preset: Preset, folder: Path) -> Checkpoint | None:
    """The last checkpoint that a longer run would have written, too; None where it lies before the first.

    Raises:
        CheckpointError: it is not there whole.
    """
    if _in_turn(newest, preset):
        return newest
    if newest.number == 1:
        return None
    before = checkpoints.load_latest(folder, before=newest.number)
    if before is None or before.number != newest.number - 1 or not _in_turn(before, preset):
        raise CheckpointError(
            f"{folder}: the run ended with checkpoint {newest.number}, and the one before, from which a longer run "
            "goes on, is not there whole: train anew in another folder"
        )
    return before


def _in_turn(saved: Checkpoint, preset: Preset) -> bool:
    """Whether a checkpoint is what it would be in a longer run, too."""
    return not saved.facts.get("out_of_turn", False)


def _forget(folder: Path, newest: Checkpoint, saved: Checkpoint | None) -> None:
    """Remove the policies that only the newest checkpoint had picked, where the run goes back behind it."""
    for file in (BEST, FIRST):
        key = Path(file).stem
        if key in newest.facts and (saved is None or key not in saved.facts):
            for kind in (".json", ".safetensors"):
                (folder / file).with_suffix(kind).unlink(missing_ok=True)


class _TensorBoard(KVWriter):
    """Numbers for TensorBoard, which hides what a killed run had written of later decisions than it goes on from.

    Args:
        folder: for the event files; every process that trains adds one.
        decisions: after which the process goes on.
    """

    def __init__(self, folder: Path, decisions: int) -> None:
        self._writer = SummaryWriter(str(folder), purge_step=decisions + 1)

    def write(self, key_values: dict[str, Any], key_excluded: dict[str, tuple[str, ...]], step: int = 0) -> None:
        """Write the numbers that are meant for TensorBoard at a step, which counts decisions."""
        for name, value in key_values.items():
            if "tensorboard" in key_excluded.get(name, ()):
                continue
            self._writer.add_scalar(name, value, step)
        self._writer.flush()

    def close(self) -> None:
        """Close the file."""
        self._writer.close()


class _Run:
    """A run between two checkpoints: what `train` does, in three steps."""

    def __init__(
        self,
        folder: Path,
        learner: Learner,
        validate: Validator,
        report: Callable[[Progress], None],
        saved: Checkpoint | None,
        n_rollouts: int,
        limit: float,
    ) -> None:
        self._folder, self._learner, self._validate, self._report = folder, learner, validate, report
        self._n_rollouts, self._limit = n_rollouts, limit
        self._out_of_turn = False
        self.unjudged = saved is not None and bool(saved.facts.get(UNJUDGED, False))
        """Whether the validation that is the newest interval's failed, and is still to be made."""
        self.number = 0
        self.chosen: dict[str, Chosen] = {}
        """By the file that holds it."""
        seconds = 0.0
        if saved is not None:
            learner.restore(saved.arrays, saved.facts)
            self.number, self.chosen, seconds = saved.number, _chosen_of(saved), float(saved.facts["seconds"])
            self._export()  # the kill may have come between the two files of a policy
        self._curve = Table(folder / CURVE, CURVE_COLUMNS, learner.rollouts)
        self._validations = Table(folder / VALIDATION, VALIDATION_COLUMNS, self.number - self.unjudged)
        self._clock, self._seconds = _Clock(seconds, learner.shepherd_steps), seconds
        self._measures: dict[str, float] = {}
        self.over = saved is not None and ended(saved, n_rollouts, limit)
        """Whether all rollouts are done, or the time is up. It changes with an interval only."""

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
            logger.dump(learner.model.num_timesteps)
            self._tell(())
        self.number += 1
        self._seconds = self._clock.seconds()
        self.over = learner.rollouts >= self._n_rollouts or self._seconds >= self._limit

    def judge_in_turn(self) -> None:
        """Validate where it is the interval's turn, or the run's end.

        Raises:
            ValidationError, WorkersError: an episode did not end; the interval is saved as one that is not judged.
        """
        self._out_of_turn = self.number % self._learner.preset.validation.every != 0
        if self._out_of_turn and not self.over:
            return
        try:
            self._judge()
        except (ValidationError, WorkersError):
            self.unjudged = True
            self.save()
            raise
        self.unjudged = False

    def _judge(self) -> None:
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
            n = "" if row["cohesion"] is None else f"n_{row['cohesion']}_"
            point = f"{row['n_flocks']}_flocks_{n}{row['n_shepherds']}_shepherds"
            logger.record(f"validation/in_goal_end_{point}", row["in_goal_end"])
        logger.record("validation/score", score)
        logger.dump(learner.model.num_timesteps)
        self._tell(rows)

    def save(self) -> None:
        """Write the checkpoint and the policies."""
        arrays, facts = self._learner.state()
        facts |= {"seconds": self._seconds, "out_of_turn": self._out_of_turn and self.over}
        if self.unjudged:
            facts[UNJUDGED] = True
        facts[SETTINGS] = settings_of(self._learner.preset)
        for file, kept in self.chosen.items():
            key = Path(file).stem
            arrays |= {f"{key}/{name}": array for name, array in kept.weights.items()}
            facts[key] = {"score": kept.score, "shepherd_steps": kept.shepherd_steps}
        checkpoints.save(self._folder / CHECKPOINTS, Checkpoint(self.number, arrays, facts))
        self._export()

    def _export(self) -> None:
        """Write the latest policy and those that were picked, where they do not lie there already."""
        learner = self._learner
        weights = actor_weights(learner.policy)
        policies = {POLICY: (learner.shepherd_steps, weights)}
        policies |= {file: (kept.shepherd_steps, kept.weights) for file, kept in self.chosen.items()}
        for file, (steps, own) in policies.items():
            # the first keeps the budget of its day: its trials are known by its checksum
            same = {} if file == FIRST else {"budget": learner.preset.budget}
            if not is_policy_of(self._folder / file, own, shepherd_steps=steps, **same):
                write_policy(self._folder / file, spec_of(learner.preset, steps), own)

    def _tell(self, validation: Sequence[Mapping[str, Any]]) -> None:
        steps = self._learner.shepherd_steps
        rate = self._clock.rate(steps)
        length = self._n_rollouts * self._learner.preset.rollout_steps
        self._report(
            Progress(steps, length, self._learner.rollouts / self._n_rollouts, rate, self._measures, validation)
        )


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
