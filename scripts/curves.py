"""Training runs in folders of their own, and their curves gathered: what figure 1 and the ablations share."""

from __future__ import annotations

import csv
import math
import sys
import time
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from shepherd_phys.controllers.curves import COLUMNS
from shepherd_phys.learning import checkpoints
from shepherd_phys.learning.checkpoints import CheckpointError
from shepherd_phys.learning.folder import (
    CHECKPOINTS,
    CURVE,
    FIRST,
    PRESET,
    UNJUDGED,
    VALIDATION,
    agree,
    begin,
    ended,
    exported,
    is_policy_of,
)
from shepherd_phys.learning.studies import HOME, Run
from shepherd_phys.settings import SettingsError
from shepherd_phys.workers import Job, Workers, WorkersError, finished

from .command import LOG_SECONDS
from .train import pace_of, validation_of

Row = dict[str, Any]

VALIDATIONS = (
    "recipe", "reward", "seed", "checkpoint", "shepherd_steps", "seconds", "n_flocks", "cohesion", "n_shepherds",
    "trials", "in_goal_end", "path_length",
)  # fmt: skip
"""Columns of what validations say, one row a validation and point; ``seconds`` of training until then."""
TEXTS = ("recipe", "reward")
COUNTS = ("seed", "rollout", "checkpoint", "shepherd_steps", "decisions", "n_flocks", "cohesion", "n_shepherds",
          "trials")  # fmt: skip
MOST_ROWS = 400
"""Of one run in a table of curves; longer ones are averaged over neighbouring rollouts."""
MEASURES = ("episode_reward", "in_goal_end", "path_length")


class Failed(NamedTuple):
    """A run that did not reach its end."""

    run: Run
    cause: str

    def __str__(self) -> str:
        return f"{self.run.name}: {self.cause}"


def unfinished(runs: Iterable[Run], folder: Path) -> list[Run]:
    """Those of the runs whose end no checkpoint holds, or whose policy files are not those of the last one.

    Of a run that is kept without its checkpoints the tables tell whether it is whole, see `_told`.

    Raises:
        SettingsError: a folder holds a run with other settings, or checkpoints that cannot be read.
    """
    return [run for run in runs if not _whole(run, folder / run.name)]


def _whole(run: Run, place: Path) -> bool:
    if not (place / PRESET).exists():
        return False
    try:
        agree(place, run.preset)
        saved = checkpoints.load_latest(place / CHECKPOINTS)
    except SettingsError as error:
        raise SettingsError(f"{error}; another --out begins anew") from None
    except CheckpointError as error:
        raise SettingsError(str(error)) from None
    if saved is None:
        return _told(run, place)
    judged = not saved.facts.get(UNJUDGED, False)
    return ended(saved, run.preset.n_rollouts, 3600.0 * run.hours) and judged and exported(place, saved)


def _told(run: Run, place: Path) -> bool:
    """Whether a folder without checkpoints holds all that a study asks of a finished run: it is small enough to keep.

    That is the preset, the whole curve, the validations to its end and, of a timed run, the first policy that passed.
    """
    if not ((place / CURVE).exists() and (place / VALIDATION).exists()):
        return False
    rows = read_rows(place / CURVE, ("rollout", "seconds"))
    judged = read_rows(place / VALIDATION, ("checkpoint", "shepherd_steps", "in_goal_end"))
    done, interval = len(rows), run.preset.checkpoint_rollouts
    if not done or rows[-1]["rollout"] != done or done % interval:
        return False
    if done < run.preset.n_rollouts and rows[-1]["seconds"] < 3600.0 * run.hours:
        return False
    if sum(row["checkpoint"] == done // interval for row in judged) != run.preset.validation.n_points:
        return False
    first = home_at(judged) if run.timed else None
    steps = {row["shepherd_steps"] for row in judged if row["checkpoint"] == first}
    return first is None or is_policy_of(place / FIRST, shepherd_steps=steps.pop())


def home_at(rows: Iterable[Row]) -> int | None:
    """The first checkpoint of a run whose validation found `HOME` percent of the sheep delivered at every point.

    None where there is no such checkpoint.
    """
    checkpoints: dict[int, list[float]] = {}
    for row in rows:
        checkpoints.setdefault(row["checkpoint"], []).append(row["in_goal_end"])
    return min((number for number, own in checkpoints.items() if min(own) >= HOME), default=None)


def one_by_one(runs: Sequence[Run], folder: Path, workers: int) -> list[Failed]:
    """Train run after run, each with all the workers: so that its wall time is what a user would wait."""
    failures = []
    for i, run in enumerate(runs, start=1):
        print(f"{run.name}: run {i} of {len(runs)} to be trained", file=sys.stderr, flush=True)
        cause = _train(run, folder / run.name, workers)
        if cause:
            failures.append(Failed(run, cause))
            print(failures[-1], file=sys.stderr, flush=True)
    return failures


def side_by_side(runs: Sequence[Run], folder: Path, workers: int) -> list[Failed]:
    """Train as many runs at a time as there are workers, each with one: the most runs in a given time."""
    if not runs:
        return []
    if workers < 2:
        return one_by_one(runs, folder, 1)
    jobs = deque(Job(i, (run, folder / run.name), run.preset.seed) for i, run in enumerate(runs))
    causes: dict[int, str] = {}
    try:
        with Workers(_job, min(workers, len(runs)), math.inf) as crew:
            for end in finished(crew, jobs):
                causes[end.key] = end.cause
    except WorkersError as error:
        causes |= {i: str(error) for i in range(len(runs)) if i not in causes}
    return [Failed(runs[i], cause) for i, cause in sorted(causes.items()) if cause]


def _job(spec: tuple[Run, Path], seed: int) -> Mapping[str, Any]:
    """Train one run: the work of a worker."""
    cause = _train(*spec, 1)
    if cause:
        raise RuntimeError(cause)
    return {}


def _train(run: Run, place: Path, workers: int) -> str:
    """Begin or continue a run and train it to its end; why it did not get there, if it did not."""
    # imported only now: torch takes seconds to load
    from shepherd_phys.envs.team import WorkerError
    from shepherd_phys.learning.ppo import TrainingError
    from shepherd_phys.learning.run import train
    from shepherd_phys.learning.validation import ValidationError

    try:
        if not (place / PRESET).exists():
            begin(place, run.preset)
        train(place, workers, _teller(run.name), 3600.0 * run.hours, run.preset)
    except (
        CheckpointError,
        OSError,
        SettingsError,
        TrainingError,
        ValidationError,
        WorkerError,
        WorkersError,
    ) as error:
        return " ".join(str(error).split())
    return ""


def _teller(name: str) -> Callable[[Any], None]:
    """Progress of a run as lines on standard error."""
    logged = -math.inf

    def report(now: Any) -> None:
        nonlocal logged
        if now.validation:
            print(f"{name}: {validation_of(now)}", file=sys.stderr, flush=True)
        elif time.monotonic() - logged > LOG_SECONDS:
            logged = time.monotonic()
            print(f"{name}: {now.shepherd_steps:,} shepherd-steps: {pace_of(now)}", file=sys.stderr, flush=True)

    return report


def read_rows(path: Path, columns: Sequence[str]) -> list[Row]:
    """The rows of a table that this file or `train` wrote, with numbers as numbers and empty cells as None.

    Raises:
        SettingsError: it is not there, or not such a table.
    """
    rows = []
    try:
        with open(path, newline="", encoding="utf-8") as file:
            for cells in csv.DictReader(file):
                rows.append({name: _value(name, cells[name]) for name in columns})
    except OSError as error:
        raise SettingsError(f"{path}: cannot be read ({error.strerror})") from None
    except (KeyError, TypeError, ValueError) as error:
        raise SettingsError(f"{path}: is not the table that it should be ({type(error).__name__}: {error})") from None
    return rows


def _value(name: str, text: str) -> Any:
    if name in TEXTS:
        return text
    if text == "":
        return None
    return int(text) if name in COUNTS else float(text)


def gather(runs: Sequence[Run], folder: Path, stretch: int = 0) -> tuple[list[Row], list[Row]]:
    """The curves and the validations of runs, as long as they are here: a folder may hold a longer run.

    Args:
        runs: of the study.
        folder: that holds theirs.
        stretch: shepherd-steps, about, over which neighbouring rollouts are averaged, so that runs whose rollouts
            differ in length can be compared; 0: no more than `MOST_ROWS` asks for.

    Returns:
        rows with the columns `COLUMNS`, those in which whole episodes ended and the last of each run; rows with the
        columns `VALIDATIONS`.

    Raises:
        SettingsError: a table of a run cannot be read.
    """
    found: list[tuple[Run, list[Row]]] = []
    validations: list[Row] = []
    for run in runs:
        labels = {"recipe": run.recipe, "reward": run.preset.reward, "seed": run.preset.seed}
        rows = read_rows(folder / run.name / CURVE, [name for name in COLUMNS if name not in labels])
        rows = _up_to(rows, run)
        found.append((run, [{**labels, **row} for row in rows]))
        taken = {row["shepherd_steps"]: row["seconds"] for row in rows}
        columns = [name for name in VALIDATIONS if name not in (*labels, "seconds")]
        validations += [
            {**labels, **row, "seconds": taken[row["shepherd_steps"]]}
            for row in read_rows(folder / run.name / VALIDATION, columns)
            if row["shepherd_steps"] in taken
        ]
    longest = {run.recipe: max(len(rows) for r, rows in found if r.recipe == run.recipe) for run, _ in found}
    curves = []
    for run, rows in found:
        width = max(math.ceil(longest[run.recipe] / MOST_ROWS), round(stretch / run.preset.rollout_steps))
        curves += binned(rows, width)
    return curves, validations


def _up_to(rows: Sequence[Row], run: Run) -> list[Row]:
    """The rows of the rollouts that the run has: it ends with the checkpoint at which its time is up, too."""
    last = run.preset.n_rollouts
    late = [row["rollout"] for row in rows if row["seconds"] >= 3600.0 * run.hours]
    if late:
        last = min(last, run.preset.checkpoint_rollouts * math.ceil(min(late) / run.preset.checkpoint_rollouts))
    return [row for row in rows if row["rollout"] <= last]


def binned(rows: Sequence[Row], width: int) -> list[Row]:
    """Rows of one run, each ``width`` neighbouring rollouts as one: counts at its last, measures averaged.

    Rows without measures are left out, but for the last: it says how far the run got and how long it took.
    """
    bins: dict[int, list[Row]] = {}
    for row in rows:
        bins.setdefault((row["rollout"] - 1) // width, []).append(row)
    made = []
    for number, own in bins.items():
        there = {name: [row[name] for row in own if row[name] is not None] for name in MEASURES}
        means = {name: sum(values) / len(values) if values else None for name, values in there.items()}
        if means["episode_reward"] is not None or number == max(bins):
            # the bin's number aligns seeds, one of which may have ended within it
            made.append({**own[-1], **means, "rollout": number * width + width})
    return made
