"""``shepherd-phys reproduce figure1`` and ``ablations``: the paper's learning curves, and what each ingredient buys."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from shepherd_phys import __version__
from shepherd_phys.campaign import Outcome, Task, write_bytes, write_csv
from shepherd_phys.controllers.claims import judge
from shepherd_phys.controllers.curves import COLUMNS
from shepherd_phys.controllers.evaluation import trial_seed
from shepherd_phys.controllers.summary import intervals
from shepherd_phys.learning import studies
from shepherd_phys.learning.folder import FIRST
from shepherd_phys.learning.studies import Run
from shepherd_phys.settings import SettingsError

from .campaigns import lost, opened
from .curves import VALIDATIONS, Row, gather, home_at, one_by_one, read_rows, side_by_side, unfinished
from .learning_pages import STRETCH, ablations_page, figure1_page
from .pages import claims_page
from .points import points, tasks
from .train import check_libraries

TRAINING = "training"
"""Where the runs' folders lie."""
SEEDS = {"figure1": 5, "ablations": 3}
"""Runs of each scheme or variant."""
BUDGETS = {"figure1": 8_250_000, "ablations": 2_500_000}
"""Shepherd-steps of each run, which ends with a whole checkpoint interval: 9 of `fast`, and 3."""
HOME_COLUMNS = ("seed", "checkpoint", "shepherd_steps", "seconds", "n_flocks", "validated", "trials", "confirmed_mean",
                "confirmed_low", "confirmed_high")  # fmt: skip
"""Of ``time-to-home.csv``, see `time_to_home`."""


class Result(NamedTuple):
    """What a study came to."""

    tables: dict[str, Any]
    """Plain data, by name."""
    page: str
    """Markdown."""
    paths: list[Path]
    """Of the files written."""
    failures: list[str]
    """Runs and episodes that have no result, and why."""


class Reported(NamedTuple):
    """How a policy is judged in the end: once, on trials that nothing was chosen by."""

    scenario: str
    trials: int
    seed: int
    workers: int
    timeout: float

    def seeds(self) -> list[int]:
        """Of the trials."""
        return [trial_seed(self.seed, trial) for trial in range(self.trials)]

    def run(self, folder: Path, todo: Sequence[Task]) -> tuple[Outcome, list[str]]:
        """Run what the folder's ledger lacks of the tasks: what came of all, and which have no result, and why.

        Raises:
            SettingsError: no world can be placed for a point, or the ledger is not to be had.
            CampaignError: the ledger cannot be written, or no worker can be started.
        """
        with opened(folder, todo, workers=self.workers, timeout=self.timeout) as ours:
            outcome = ours.run(todo)
        return outcome, lost(outcome.failures)


def figure1(folder: Path, *, n_seeds: int, budget: int, paper_hours: float, workers: int, reported: Reported) -> Result:
    """Train the runs of figure 1 that are not there yet, and write its tables, page and drawing, and claim c8.

    Raises:
        SettingsError: the folder holds other runs or broken tables; or a library is missing.
        CampaignError: a file cannot be written, or the reported trials cannot be run.
    """
    from .learning_figures import draw_figure1

    training = folder / TRAINING
    runs = studies.figure1(n_seeds, budget, paper_hours)
    todo = unfinished(runs, training)
    read_claims(folder, reported)  # before hours of training: can it be read
    if todo:
        check_libraries()
    failed = one_by_one([run for run in todo if run.timed], training, workers)
    failed += side_by_side([run for run in todo if not run.timed], training, workers)
    runs = [run for run in runs if run not in [failure.run for failure in failed]]
    if not runs:
        return Result({}, "", [], [str(failure) for failure in failed])
    runs.sort(key=lambda run: (run.recipe != "fast", studies.SCHEMES.index(run.preset.reward), run.preset.seed))
    curves, validations = gather(runs, training)
    timed = [run for run in runs if run.timed]
    home = time_to_home(timed, validations)
    failures = [*map(str, failed), *confirm(home, timed, folder, reported)]
    judged = judge([], [], ["c8"], curves)[0].to_dict()
    claims = read_claims(folder, reported)  # as they are now: figures 2 and 3 may have been made meanwhile
    claims["claims"] = [judged if claim["claim"] == "c8" else claim for claim in claims["claims"]]
    page = figure1_page(curves, validations, home)
    files = {
        "figure1.md": page.encode(),
        "figure1.png": draw_figure1(curves, validations),
        "claims.json": f"{json.dumps(claims, allow_nan=False, indent=1, ensure_ascii=False)}\n".encode(),
        "claims.md": claims_page(claims).encode(),
    }
    tables = {
        "figure1.csv": (COLUMNS, curves),
        "figure1-validation.csv": (VALIDATIONS, validations),
        "time-to-home.csv": (HOME_COLUMNS, home),
    }
    paths = _write(folder, tables, files)
    return Result({"time_to_home": home, "validations": validations, "claims": claims}, page, paths, failures)


def ablations(folder: Path, *, n_seeds: int, budget: int, workers: int) -> Result:
    """Train the runs of the ablations that are not there yet, and write tables, page and drawing.

    Raises:
        SettingsError: the folder holds other runs or broken tables; or a library is missing.
        CampaignError: a file cannot be written.
    """
    from .learning_figures import draw_ablations

    training = folder / TRAINING
    runs = studies.ablations(n_seeds, budget)
    todo = unfinished(runs, training)
    if todo:
        check_libraries()
    failed = side_by_side(todo, training, workers)
    runs = [run for run in runs if run not in [failure.run for failure in failed]]
    if not runs:
        return Result({}, "", [], [str(failure) for failure in failed])
    curves, validations = gather(runs, training, STRETCH)
    order = {run.recipe: None for run in runs}
    curves.sort(key=lambda row: list(order).index(row["recipe"]))  # variant by variant, each seed after seed
    validations.sort(key=lambda row: list(order).index(row["recipe"]))
    page = ablations_page(curves, validations)
    tables = {"ablations.csv": (COLUMNS, curves), "ablations-validation.csv": (VALIDATIONS, validations)}
    files = {"ablations.md": page.encode(), "ablations.png": draw_ablations(curves)}
    paths = _write(folder, tables, files)
    return Result({"validations": validations}, page, paths, [str(failure) for failure in failed])


def _write(
    folder: Path, tables: Mapping[str, tuple[Sequence[str], Sequence[Row]]], files: Mapping[str, bytes]
) -> list[Path]:
    for name, (columns, rows) in tables.items():
        write_csv(folder / name, columns, rows)
    for name, content in files.items():
        write_bytes(folder / name, content)
    return [folder / name for name in (*tables, *files)]


def time_to_home(runs: Sequence[Run], validations: Sequence[Row]) -> list[Row]:
    """When each run's policy first delivered `HOME` percent of the sheep at every point of a validation.

    Args:
        runs: that validate at every checkpoint.
        validations: rows of theirs, and perhaps of others.

    Returns:
        a row a run and point: ``checkpoint``, ``shepherd_steps`` and ``seconds`` of training until then, ``validated``
        percent delivered; without numbers where a run never did. What is ``confirmed`` is still to be filled in.
    """
    rows: list[Row] = []
    for run in runs:
        labels = (run.recipe, run.preset.reward, run.preset.seed)
        own = [row for row in validations if (row["recipe"], row["reward"], row["seed"]) == labels]
        empty = dict.fromkeys(HOME_COLUMNS)
        first = home_at(own)
        if first is None:
            rows.append({**empty, "seed": run.preset.seed})
            continue
        for row in [row for row in own if row["checkpoint"] == first]:
            told = {name: row[name] for name in ("seed", "checkpoint", "shepherd_steps", "seconds", "n_flocks")}
            rows.append({**empty, **told, "validated": row["in_goal_end"]})
    return rows


def confirm(home: Sequence[Row], runs: Sequence[Run], folder: Path, reported: Reported) -> list[str]:
    """Run the reported trials of each run's first passing policy, and fill in what they say.

    A point counts only when all its trials have a result.

    Returns:
        episodes that have no result, and why.

    Raises:
        SettingsError: a policy cannot be read, or the ledger is not to be had.
        CampaignError: the ledger cannot be written, or no worker can be started.
    """
    names = {run.preset.seed: str(folder / TRAINING / run.name / FIRST) for run in runs}
    wanted = {(names[row["seed"]], row["n_flocks"]): row for row in home if row["checkpoint"] is not None}
    if not wanted:
        return []
    (cohesion,) = studies.FIGURE1.cohesion
    grid = points(
        controllers=list(dict.fromkeys(name for name, _ in wanted)),
        scenario=reported.scenario,
        flocks=studies.FIGURE1.flocks,
        cohesion=[cohesion],
        shepherds=studies.FIGURE1.shepherds,
    )
    todo = tasks(
        [point for point in grid if (point.controller, point.scenario.n_flocks) in wanted],
        reported.seeds(),
    )
    outcome, failures = reported.run(folder, todo)
    delivered: dict[tuple[str, int], list[float]] = {}
    for task, row in zip(todo, outcome.rows, strict=True):
        if row is not None:
            key = (task.spec.controller, task.spec.scenario.n_flocks)
            delivered.setdefault(key, []).append(row["in_goal_end"])
    for key, values in delivered.items():
        wanted[key]["trials"] = len(values)
        if len(values) == reported.trials:
            mean, low, high = (float(number) for number in intervals(np.array([values]))[0])
            wanted[key] |= {"confirmed_mean": mean, "confirmed_low": low, "confirmed_high": high}
    return failures


def read_claims(folder: Path, reported: Reported) -> dict[str, Any]:
    """The claims as they stand in the folder; none of them judged where there are none yet.

    Raises:
        SettingsError: the file is not what `reproduce` writes.
    """
    path = folder / "claims.json"
    if not path.exists():
        judged = [claim.to_dict() for claim in judge([], [0])]
        return {"trials": reported.trials, "seed": reported.seed, "version": __version__, "claims": judged}
    try:
        found: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        claims_page(found)
    except (OSError, KeyError, TypeError, ValueError) as error:
        raise SettingsError(f"{path}: is not what reproduce writes ({type(error).__name__}); remove it") from None
    return found


def kept_curves(folder: Path) -> list[Row]:
    """The learning curves that an earlier figure 1 left in the folder, for claim c8.

    Raises:
        SettingsError: the table cannot be read.
    """
    path = folder / "figure1.csv"
    return read_rows(path, COLUMNS) if path.exists() else []
