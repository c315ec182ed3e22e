"""The folder of a training run: what stands in it, and its tables."""

from __future__ import annotations

import csv
import math
import sqlite3
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
import safetensors.numpy

from shepherd_phys.controllers.learned import load_policy
from shepherd_phys.controllers.network import Weights
from shepherd_phys.controllers.policy_files import PolicyError
from shepherd_phys.files import whole_file
from shepherd_phys.learning.checkpoints import Checkpoint
from shepherd_phys.learning.preset import Preset
from shepherd_phys.settings import SettingsError

PRESET = "preset.toml"
CURVE = "curve.csv"
VALIDATION = "validation.csv"
POLICY = "policy.json"
BEST = "best.json"
FIRST = "first.json"
CHECKPOINTS = "checkpoints"
TENSORBOARD = "tensorboard"
LOCK = "run.lock"
START = "start.safetensors"
"""Weights of the policy that the run began with, where its preset names one: that may be another by now."""
SETTINGS = "settings"
"""Fact of a checkpoint: what `settings_of` gives."""
UNJUDGED = "unjudged"
"""Fact of a checkpoint whose validation was its turn and failed, where it did: it is made up for."""

MEASURES = ("in_goal_end", "ever_in_goal", "mean_occupancy", "path_length", "time_to_95", "success")
"""What a validation measures, see `shepherd_phys.controllers.evaluation.run_episode`."""
MOST_TOLD = 80
"""Letters of a value in a message."""
CURVE_COLUMNS = (
    "rollout", "shepherd_steps", "decisions", "seconds", "episodes", "episode_reward", "in_goal_end", "path_length",
    "value_loss", "policy_gradient_loss", "approx_kl", "clip_fraction", "explained_variance", "std",
)  # fmt: skip
"""Of ``curve.csv``, one row a rollout: counts since the run began, and the wall-clock seconds that training alone has
taken (rollouts, learning and checkpoints; validations are left out); means over the whole episodes that ended in the
rollout, empty where none did; PPO's measures."""
VALIDATION_COLUMNS = ("checkpoint", "shepherd_steps", "n_flocks", "cohesion", "n_shepherds", "trials", *MEASURES)
"""Of ``validation.csv``, one row a validation and point."""


def begin(folder: Path, preset: Preset) -> None:
    """Make the folder of a new run, with its preset.

    Raises:
        SettingsError: it holds a run already, or cannot be made; the preset cannot be written, or holds a number that
            no checkpoint can tell; or the policy to start from cannot be had.
    """
    _refuse_a_run(folder)
    for name, number in _numbers(settings_of(preset)):  # before there is a folder
        if not math.isfinite(number):
            raise SettingsError(f"{name}: {number} cannot be kept with a run; it must be finite")
    start = preset.start()
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise SettingsError(f"{folder}: cannot be made ({error.strerror})") from None
    with alone(folder):
        _refuse_a_run(folder)  # somebody else may have begun one just now
        if start is not None:
            with whole_file(folder / START) as part:
                part.write_bytes(safetensors.numpy.save(dict(start)))
        preset.to_toml(folder / PRESET)  # comes last: where it stands there is a run


def _numbers(value: Any, name: str = "") -> Iterator[tuple[str, float]]:
    """The fractional numbers in plain data, with their dotted names."""
    if isinstance(value, float):
        yield name, value
    for key, own in value.items() if isinstance(value, Mapping) else ():
        yield from _numbers(own, f"{name}.{key}" if name else str(key))
    for own in value if isinstance(value, list | tuple) else ():
        yield from _numbers(own, name)


def start_of(folder: Path, preset: Preset) -> Weights | None:
    """Weights that the run in a folder began with; None where its preset names no policy to start from.

    Raises:
        SettingsError: they cannot be read.
    """
    if preset.init is None:
        return None
    try:
        return safetensors.numpy.load((folder / START).read_bytes())
    except (OSError, safetensors.SafetensorError) as error:
        raise SettingsError(f"{folder / START}: cannot be read ({' '.join(str(error).split())})") from None


def check_resumable(folder: Path, preset: Preset) -> None:
    """Find out whether a run without checkpoints may begin at its first rollout, which forgets what it has written.

    Raises:
        SettingsError: it got further than its first interval, so its checkpoints must have been removed.
    """
    rollouts = 0
    if (folder / CURVE).exists():
        with open(folder / CURVE, newline="", encoding="utf-8") as file:
            rollouts = sum(1 for _ in csv.reader(file)) - 1
    if rollouts > preset.checkpoint_rollouts or (folder / POLICY).exists():
        raise SettingsError(
            f"{folder}: holds {rollouts} rollouts in {CURVE} and no checkpoint to go on from; move the folder away to "
            "train this run anew"
        )


def _refuse_a_run(folder: Path) -> None:
    if (folder / PRESET).exists():
        raise SettingsError(f"{folder} holds a run: --resume continues it; another run needs another folder")


def agree(folder: Path, preset: Preset, classes: Iterable[Any] = ()) -> Preset:
    """The preset of a folder's run, which must be the one given but for its budget: a longer run is the same run.

    ``classes`` are a user's own that its scenario names.

    Raises:
        SettingsError: it is another run, or none that can be read.
    """
    kept = Preset.from_toml(folder / PRESET, classes)
    apart = list(_differences(settings_of(kept), settings_of(preset)))
    if apart:
        told = "; ".join(f"{name} is {_told(theirs)} there, {_told(ours)} here" for name, theirs, ours in apart)
        raise SettingsError(f"{folder}: holds a run with other settings: {told}")
    if kept.budget != preset.budget and kept.ppo.last_learning_rate is not None:
        raise SettingsError(f"{folder}: its learning rate falls over its budget, {kept.budget}, which stays what it is")
    return kept


def settings_of(preset: Preset) -> dict[str, Any]:
    """What stays the same as long as a run lasts, as plain data."""
    # as it is written: two objects of a user's class need not be equal where they are the same
    return {name: value for name, value in preset.to_dict().items() if name != "budget"}


def check_settings(saved: Checkpoint, preset: Preset, path: Path, classes: Iterable[Any] = ()) -> None:
    """Find out whether a preset, read from ``path``, is still that of the run which wrote a checkpoint.

    ``classes`` are a user's own that its scenario and its reward name.

    Raises:
        SettingsError: it was changed; the message names the fields.
    """
    then = saved.facts[SETTINGS]
    with suppress(SettingsError):  # what an earlier version did not know has its default
        then = settings_of(Preset.from_dict(then, classes))
    apart = list(_differences(then, settings_of(preset)))
    if apart:
        told = "; ".join(f"{name}, now {_told(now)}, was {_told(before)}" for name, before, now in apart)
        raise SettingsError(
            f"{path}: changed since the run began, which can go on only as it was: {told}. Undo that, and train what "
            "you want in another folder, by a copy of the file given as --preset"
        )


def _differences(one: Mapping[str, Any], other: Mapping[str, Any], place: str = "") -> Iterator[tuple[str, Any, Any]]:
    """Dotted name and both values of what differs between plain data; None where one of them has it not."""
    for name in sorted({*one, *other}):
        a, b = one.get(name), other.get(name)
        if isinstance(a, Mapping) and isinstance(b, Mapping):
            yield from _differences(a, b, f"{place}{name}.")
        elif a != b:
            yield f"{place}{name}", a, b


def _told(value: Any) -> str:
    """A value in a message."""
    text = "not given" if value is None else repr(value)
    return text if len(text) <= MOST_TOLD else f"{text[:MOST_TOLD]}.."


@contextmanager
def alone(folder: Path) -> Iterator[None]:
    """While nobody else trains in the folder.

    The lock is an exclusive transaction on an empty SQLite file, which the system ends whatever ends the process.

    Raises:
        SettingsError: somebody does, or the folder cannot be written.
    """
    lock = None
    try:
        lock = sqlite3.connect(folder / LOCK, isolation_level=None, timeout=0.0)
        lock.execute("BEGIN EXCLUSIVE")
    except sqlite3.Error as error:
        if lock is not None:
            lock.close()
        busy = getattr(error, "sqlite_errorname", "").startswith(("SQLITE_BUSY", "SQLITE_LOCKED"))
        raise SettingsError(f"{folder}: {'another process trains in it' if busy else error}") from None
    try:
        yield
    finally:
        lock.close()


def ended(saved: Checkpoint, n_rollouts: int, seconds: float = math.inf) -> bool:
    """Whether a run needs no further training: so many rollouts are done, or so many seconds of it."""
    return bool(saved.facts["rollouts"] >= n_rollouts or saved.facts["seconds"] >= seconds)


def is_policy_of(path: Path, weights: Weights | None = None, **training: int) -> bool:
    """Whether a whole policy lies there that was trained so: a kill may have come before, or in the middle.

    With ``weights``, also whether they are its: two runs count the same shepherd-steps, whatever they learned.
    """
    try:
        policy = load_policy(path)
    except PolicyError:
        return False
    if any(policy.spec.training.get(name) != value for name, value in training.items()):
        return False
    own = policy.weights
    return weights is None or (
        set(own) == set(weights) and all(np.array_equal(own[name], weights[name]) for name in own)
    )


def exported(folder: Path, saved: Checkpoint) -> bool:
    """Whether the policy files are those of a checkpoint."""
    wanted = {POLICY: saved.facts["shepherd_steps"]}
    for file in (BEST, FIRST):
        if Path(file).stem in saved.facts:
            wanted[file] = saved.facts[Path(file).stem]["shepherd_steps"]
    return all(is_policy_of(folder / file, shepherd_steps=steps) for file, steps in wanted.items())


class Table:
    """A CSV file that grows row by row; what a killed run wrote after its checkpoint is cut off.

    Args:
        path: of the file.
        columns: its columns; the first one counts.
        last: rows that count further are cut off, and a torn one.
    """

    def __init__(self, path: Path, columns: Sequence[str], last: int) -> None:
        self._path, self._columns = path, columns
        rows: list[list[str]] = []
        if path.exists():
            with open(path, newline="", encoding="utf-8") as file:
                rows = list(csv.reader(file))[1:]
        kept = [row for row in rows if len(row) == len(columns) and row[0].isdecimal() and int(row[0]) <= last]
        with whole_file(path) as part, open(part, "w", newline="", encoding="utf-8") as file:
            csv.writer(file, lineterminator="\n").writerows([list(columns), *kept])

    def add(self, row: Mapping[str, Any]) -> None:
        """Append a row; what is NaN or missing stays empty."""
        cells = [row.get(name) for name in self._columns]
        cells = ["" if cell is None or (isinstance(cell, float) and math.isnan(cell)) else cell for cell in cells]
        with open(self._path, "a", newline="", encoding="utf-8") as file:
            csv.writer(file, lineterminator="\n").writerow(cells)
