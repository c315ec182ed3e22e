"""``shepherd-phys evaluate``: run controllers headless over a grid of experiments, many episodes at a time."""

from __future__ import annotations

import contextlib
import json
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from functools import partial
from pathlib import Path
from typing import Annotated, Any, TextIO

import tyro
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

from shepherd_phys import campaign
from shepherd_phys.controllers.evaluation import LABELS, trial_seed
from shepherd_phys.settings import SettingsError, read_toml

from .campaigns import ended, lost, opened
from .command import at_least, cpu_count, fail, flag, parsed, workforce
from .pictures import picture
from .points import SCENARIO, episode, points, strangers, table, tasks, write_tables
from .replays import missing, open_folder, record_again, recorded_episode

PROG = "shepherd-phys evaluate"


@dataclass(frozen=True)
class Evaluate:
    """Run controllers headless over the full cross product of the lists given, and write the tables.

    Writes episodes.csv (one row an episode), summary.csv (means with 95 % bootstrap intervals), differences.csv (paired
    differences from a baseline, where there are several controllers) and episode.png into the folder --out, with a
    ledger that lets a stopped campaign continue: give the same command again.
    """

    controllers: Annotated[tuple[str, ...], flag("NAME ..")] = ("strombom",)
    """Controllers by name, or module:Name of your own (imported from the current directory)."""
    flocks: Annotated[tuple[int, ...], flag("K ..", "the scenario's")] = ()
    """Numbers of flocks."""
    cohesion: Annotated[tuple[int, ...], flag("N ..", "the scenario's")] = ()
    """Numbers of neighbours that attract a sheep."""
    shepherds: Annotated[tuple[int, ...], flag("M ..", "the scenario's")] = ()
    """Numbers of shepherds."""
    sheep: Annotated[int | None, flag("N", "the scenario's")] = None
    """Number of sheep."""
    scenario: Annotated[str | None, flag("NAME|FILE|module:Name", SCENARIO)] = None
    """A preset's name, a TOML file, or module:Name of a scenario of your own."""
    body: Annotated[str | None, flag("NAME|module:Name", "the scenario's")] = None
    """Body of every shepherd; those that the file describes as such keep their parameters."""
    flock: Annotated[str | None, flag("NAME|module:Name", "the scenario's")] = None
    """Flock model; if the file describes such a one, with its parameters."""
    baseline: Annotated[str | None, flag("NAME", "the first of --controllers")] = None
    """The controller from which the others' differences are told, paired by seed."""
    trials: Annotated[int, flag("T")] = 100
    """Episodes a point."""
    seed: Annotated[int, flag("S")] = 20_000
    """Root seed: trial i has a seed derived from S and i alone, the same for every controller and point."""
    grid: Annotated[Path | None, flag("FILE", "")] = None
    """A TOML file with any of the options above, e.g. flocks = [1, 2]."""
    shard: Annotated[str | None, flag("I/N", "")] = None
    """Run only the I-th of N equal parts (1-based), for machines that share nothing."""
    workers: Annotated[int, flag("W")] = cpu_count()
    """Worker processes; the results do not depend on it."""
    scheduler: Annotated[str | None, flag("ADDRESS", "")] = None
    """Instead of --workers: the scheduler of a Dask cluster, e.g. tcp://10.0.0.1:8786."""
    timeout: Annotated[float, flag("SECONDS")] = 600.0
    """An episode that takes longer counts as hung."""
    out: Annotated[Path, flag("DIR")] = Path("results")
    """Folder for tables and ledger; an unfinished campaign in it is continued."""
    gather: Annotated[tuple[Path, ...], flag("DIR ..", "")] = ()
    """Folders of other campaigns, such as shards: episodes that they have are taken over and not run."""
    save_replay: Annotated[Path | None, flag("DIR", "")] = None
    """Folder that receives a replay of every episode, of earlier runs too; those that it has are kept."""
    json: tyro.conf.FlagCreatePairsOff[bool] = False
    """Print the summary as one JSON array, and nothing else, on standard output."""


POINT_KEYS = ("controllers", "flocks", "cohesion", "shepherds", "sheep", "scenario", "body", "flock")
GRID_KEYS = (*POINT_KEYS, "baseline", "trials", "seed")
LISTS = {"controllers": str, "flocks": int, "cohesion": int, "shepherds": int}
LEAST = {"flocks": 1, "cohesion": 1, "shepherds": 0, "sheep": 1, "trials": 1, "seed": 0, "workers": 1}


def main(argv: Sequence[str]) -> int:
    """Run the command; the exit status: 0, 1 if episodes failed, 2 for a mistake of the user, 130 for Ctrl-C."""
    try:
        options = read_options(argv)
    except SettingsError as error:
        return fail(PROG, error, 2)
    out = sys.stdout
    with contextlib.redirect_stdout(sys.stderr):  # a user's classes may print wherever they are touched
        return ended(PROG, options.out, lambda: _main(options, out))


def _main(options: Evaluate, out: TextIO) -> int:
    part, count = read_shard(options.shard)
    grid = points(**{name: getattr(options, name) for name in POINT_KEYS})
    for line in strangers(grid) if options.scenario is None else ():
        print(f"{PROG}: {line}", file=sys.stderr)
    trials = {trial_seed(options.seed, trial): trial for trial in range(options.trials)}
    todo = campaign.shard(tasks(grid, [*trials]), part, count)
    replays = None if options.save_replay is None else open_folder(options.save_replay)
    work = episode if replays is None else partial(recorded_episode, str(replays), trials)
    workers = workforce(PROG, options.workers, options.scheduler)
    with opened(options.out, todo, workers=workers, timeout=options.timeout, gather=options.gather) as ours:
        outcome = ours.run(todo, work)
        failures = list(outcome.failures)
        if replays is not None:
            kept = {task.key: row for task, row in zip(todo, outcome.rows, strict=True) if row is not None}
            again = missing(replays, trials, [task for task in todo if task.key in kept])
            failures += record_again(replays, trials, again, [kept[task.key] for task in again], **ours.how)
        summary, paths = write_tables(options.out, table(todo, outcome), options.baseline)
        if todo and outcome.rows[0] is not None:
            paths += picture(todo[0], ours.ledger, PROG)
    if not summary and failures:
        paths = []  # tables of nothing are written, so that none of an earlier run stays, but not worth a word
    if options.json:
        print(json.dumps(summary, allow_nan=False, indent=1), file=out)
    elif summary:
        print_table(summary, out)
        print_differences(summary, out)
    for path in paths:
        print(path, file=sys.stderr if options.json else out)
    unrecorded = 0 if replays is None else len(missing(replays, trials, todo))
    if replays is not None:
        print(f"{len(todo) - unrecorded} replays in {options.save_replay}", file=sys.stderr if options.json else out)
        if unrecorded > len(failures):
            print(f"{PROG}: {unrecorded} are not there: workers of a cluster must share that folder", file=sys.stderr)
    for line in lost(failures):
        print(f"{PROG}: {line}", file=sys.stderr)
    return 1 if failures or unrecorded else 0


def read_options(argv: Sequence[str]) -> Evaluate:
    """The options from the command line and the grid file, checked.

    Raises:
        SettingsError: something is unknown, given twice or impossible.
        SystemExit: after ``--help``.
    """
    options, flags = parsed(Evaluate, PROG, argv)
    values = {f.name: getattr(options, f.name) for f in fields(Evaluate)}
    for name in (*LISTS, "gather"):
        if name in flags and not values[name]:
            raise SettingsError(f"--{name}: needs at least one value")
    if options.grid is not None:
        for name, value in read_grid(options.grid).items():
            if name in flags:
                raise SettingsError(f"--{name} is given and {options.grid} sets {name} too: leave one of them out")
            values[name] = value
    at_least(values, LEAST)
    controllers = tuple(dict.fromkeys(values["controllers"]))
    if values["baseline"] not in (None, *controllers):
        raise SettingsError(f"baseline: {values['baseline']!r} is not among the controllers ({', '.join(controllers)})")
    values["baseline"] = (values["baseline"] or controllers[0]) if len(controllers) > 1 else None
    return Evaluate(**values)


def read_grid(path: Path) -> dict[str, Any]:
    """The options that a grid file sets.

    Raises:
        SettingsError: it cannot be read, or sets something that is no option of a grid.
    """
    values: dict[str, Any] = {}
    for name, value in read_toml(path).items():
        if name not in GRID_KEYS:
            raise SettingsError(f"{path}: {name} is unknown; a grid sets {', '.join(GRID_KEYS)}")
        kind: type = LISTS.get(name, int if name in ("sheep", "trials", "seed") else str)
        items = value if isinstance(value, list) else [value]
        wrong = any(not isinstance(item, kind) or isinstance(item, bool) for item in items)
        if wrong or not items or (isinstance(value, list) and name not in LISTS):
            wanted = {int: "a whole number", str: "text"}[kind]
            wanted = "a list of whole numbers" if name in LISTS and kind is int else wanted
            raise SettingsError(f"{path}: {name} must be {wanted} (given: {value!r})")
        values[name] = tuple(items) if name in LISTS else value
    return values


def read_shard(text: str | None) -> tuple[int, int]:
    """(I, N) from "I/N".

    Raises:
        SettingsError: it is not 1 <= I <= N.
    """
    if text is None:
        return 1, 1
    number, _, count = text.partition("/")
    if not (number.isdecimal() and count.isdecimal() and 1 <= int(number) <= int(count)):
        raise SettingsError(f"shard: {text!r} is impossible; it must be I/N with 1 <= I <= N, e.g. 2/4")
    return int(number), int(count)


METRICS = {
    "in_goal_end": ("in at the end %", ".1f"),
    "path_length": ("path m", ".0f"),
    "time_to_95": ("95 % in after s", ".0f"),
}
"""What matters most, its title and its format."""


def print_table(summary: Sequence[Mapping[str, Any]], out: TextIO) -> None:
    """Print what matters most of the summary; what is the same in all rows stands above it."""
    _print_rows(summary, "mean [95 % bootstrap interval]", "", out)


def print_differences(summary: Sequence[Mapping[str, Any]], out: TextIO) -> None:
    """Print what matters most of the differences from the baseline, where there are any."""
    rows = [{**row, **row["differences"]} for row in summary if row["differences"] is not None]
    if rows:
        _print_rows(rows, f"difference from {rows[0]['baseline']} on the same seeds", "_diff", out)


def _print_rows(rows: Sequence[Mapping[str, Any]], title: str, suffix: str, out: TextIO) -> None:
    sign = "+" if suffix else ""
    labels = [name for name in (*LABELS, "trials") if name == "controller" or len({row[name] for row in rows}) > 1]
    same = [f"{name} {rows[0][name]}" for name in (*LABELS, "trials") if rows and name not in labels]
    grid = Table(
        title="\n".join([", ".join(same), title]),
        title_justify="left",
        box=SIMPLE_HEAD,
        padding=(0, 1, 0, 0),
        pad_edge=False,
    )
    for name in labels:
        grid.add_column(name.removeprefix("n_"), justify="left" if name in ("controller", "scenario") else "right")
    for heading, _ in METRICS.values():
        grid.add_column(heading, justify="right", no_wrap=True)
    for row in rows:
        numbers = [
            [f"{row[f'{n}{suffix}_{part}']:{sign}{f}}" for part in ("mean", "low", "high")]
            for n, (_, f) in METRICS.items()
        ]
        grid.add_row(
            *("" if row[name] is None else str(row[name]) for name in labels),
            *(f"{mean} [{low}, {high}]" for mean, low, high in numbers),
        )
    console = Console(file=out, markup=False, highlight=False)
    if not console.is_terminal:
        console.width = 200  # a file has no edge to wrap at
    console.print(grid)
