"""The folder of a training run: what stands in it, and its tables."""

from __future__ import annotations

import csv
import math
import sqlite3
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from shepherd_phys.controllers.learned import load_policy
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
SETTINGS = "settings"
"""Fact of a checkpoint: what `settings_of` gives."""

MEASURES = ("in_goal_end", "ever_in_goal", "mean_occupancy", "path_length", "time_to_95", "success")
"""What a validation measures, see `shepherd_phys.controllers.evaluation.run_episode`."""
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
        SettingsError: it holds a run already, or cannot be made; or the preset cannot be written.
    """
    _refuse_a_run(folder)
    preset.to_dict()  # refuses what cannot be written before there is a folder
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise SettingsError(f"{folder}: cannot be made ({error.strerror})") from None
    with alone(folder):
        _refuse_a_run(folder)  # somebody else may have begun one just now
        preset.to_toml(folder / PRESET)


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
    if settings_of(kept) != settings_of(preset):
        raise SettingsError(f"{folder}: holds a run with other settings")
    if kept.budget != preset.budget and kept.ppo.last_learning_rate is not None:
        raise SettingsError(f"{folder}: its learning rate falls over its budget, {kept.budget}, which stays what it is")
    return kept


def settings_of(preset: Preset) -> dict[str, Any]:
    """What stays the same as long as a run lasts, as plain data."""
    # as it is written: two objects of a user's class need not be equal where they are the same
    return {name: value for name, value in preset.to_dict().items() if name != "budget"}


def check_settings(saved: Checkpoint, preset: Preset, path: Path) -> None:
    """Find out whether a preset, read from ``path``, is still that of the run which wrote a checkpoint.

    Raises:
        SettingsError: it was changed; the message names the fields.
    """
    then, now = saved.facts.get(SETTINGS), settings_of(preset)  # earlier versions did not tell
    if then is not None and then != now:
        changed = sorted(name for name in {*then, *now} if then.get(name) != now.get(name))
        raise SettingsError(
            f"{path}: {', '.join(changed)} changed since the run began, which can go on only as it was: undo that, and "
            "train what you want in another folder, by a copy of the file given as --preset"
        )


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


def is_policy_of(path: Path, **training: int) -> bool:
    """Whether a whole policy lies there that was trained so: a kill may have come before, or in the middle."""
    try:
        told = load_policy(path).spec.training
    except PolicyError:
        return False
    return all(told.get(name) == value for name, value in training.items())


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
