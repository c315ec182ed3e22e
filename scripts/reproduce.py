"""``shepherd-phys reproduce``: the paper's experiments, their figures, and what they say to its claims."""

from __future__ import annotations

import contextlib
import importlib
import json
import math
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, TextIO

import tyro
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

from shepherd_phys import __version__
from shepherd_phys.campaign import Ledger, Outcome, Task, remove, write_bytes, write_csv
from shepherd_phys.controllers import CONTROLLERS
from shepherd_phys.controllers.claims import EXPERIMENTS, HEURISTICS, LEARNED, LITERAL, judge
from shepherd_phys.controllers.evaluation import COLUMNS, trial_seed
from shepherd_phys.controllers.summary import difference_columns, paired_differences, summarise, summary_columns
from shepherd_phys.settings import SettingsError

from . import studies
from .beyond import STUDIES, run_study
from .campaigns import ended, lost, opened
from .command import at_least, cpu_count, fail, flag, parsed, workforce
from .evaluate import print_table
from .pages import PART_HEAD, claims_page, few_trials, figure_page, part_cells
from .points import points, table, tasks

PROG = "shepherd-phys reproduce"
SCENARIO = "paper"
EPISODES = (*EXPERIMENTS, "all")
"""Figures made of episodes; all of these."""
BASELINE = "collie"
"""Whom these compare the others with, trial by trial, where it is among them: the best that we have."""
CHOICES = ("figure1", *EPISODES, *STUDIES, "ablations")
GOES_WITH = {
    **dict.fromkeys(("literal", "scheduler", "gather"), EPISODES),
    "controllers": (*EPISODES, *STUDIES),
    **dict.fromkeys(("trials", "seed", "timeout"), ("figure1", *EPISODES, *STUDIES)),
    **dict.fromkeys(("seeds", "budget"), ("figure1", "ablations")),
    "paper_hours": ("figure1",),
}
"""Flags that not every figure takes."""


@dataclass(frozen=True)
class Reproduce:
    """Run the paper's experiments, draw its figures, and judge its claims.

    figure2 and figure3 compare every method that there is, and take some hours; beyond, obstacles, bodies, sensing and
    boids run some of them in worlds that the paper does not have; figure1, the learning curves, and ablations, what
    each ingredient of our recipe buys, train for many hours. all is figure2 and figure3. Writes into the folder --out,
    for each figure, its CSV, Markdown tables and drawing; claims.json and claims.md; and what lets a stopped run
    continue: give the same command again.
    """

    figure: Annotated[tyro.conf.Positional[str], flag("|".join(CHOICES), "")] = ""
    """What to reproduce; all is figure2 and figure3, which share a point that is run once."""
    literal: tyro.conf.FlagCreatePairsOff[bool] = False
    """Add the heuristics as published: strombom-literal, pierson-reconstructed, elfiqi-literal."""
    controllers: Annotated[tuple[str, ...], flag("NAME ..", "all tuned heuristics and shipped policies")] = ()
    """Only these, by name or module:Name of your own; claims on others stay undecided."""
    trials: Annotated[int, flag("T")] = 100
    """Episodes a point; in figure1, of the policies whose time to home is told."""
    seed: Annotated[int, flag("S")] = 20_000
    """Root seed: trial i has a seed derived from S and i alone, the same for every controller and point."""
    seeds: Annotated[int | None, flag("K", "5 in figure1, 3 in ablations")] = None
    """Training runs of each scheme or variant, with seeds from 1,000,000."""
    budget: Annotated[int | None, flag("N", "8,250,000 in figure1, 2,500,000 in ablations")] = None
    """Shepherd-steps of each training run, which ends with a whole checkpoint interval."""
    paper_hours: Annotated[float, flag("HOURS")] = 2.0
    """In figure1: hours of training for one run by the preset paper, drawn beside; 0: none."""
    workers: Annotated[int, flag("W")] = cpu_count()
    """Worker processes; the results do not depend on it. figure1 trains the first three runs of wild one at a time
    with all of them; all its other runs, and those of ablations, are trained as many at a time."""
    scheduler: Annotated[str | None, flag("ADDRESS", "")] = None
    """Instead of --workers: the scheduler of a Dask cluster, e.g. tcp://10.0.0.1:8786."""
    timeout: Annotated[float, flag("SECONDS")] = 600.0
    """An episode that takes longer counts as hung."""
    out: Annotated[Path, flag("DIR")] = Path("results/reproduce")
    """Folder for tables, figures and ledger; an unfinished run in it is continued."""
    gather: Annotated[tuple[Path, ...], flag("DIR ..", "")] = ()
    """Folders of other campaigns: episodes that they have are taken over and not run."""
    json: tyro.conf.FlagCreatePairsOff[bool] = False
    """Print one JSON object, the rows of each figure and the claims, and nothing else, on standard output."""


LEAST = {"trials": 1, "seed": 0, "seeds": 1, "budget": 1, "workers": 1}


def main(argv: Sequence[str]) -> int:
    """Run the command; the exit status: 0, 1 if episodes failed, 2 for a mistake of the user, 130 for Ctrl-C."""
    try:
        options = read_options(argv)
    except SettingsError as error:
        return fail(PROG, error, 2)
    out = sys.stdout
    with contextlib.redirect_stdout(sys.stderr):  # a user's classes may print wherever they are touched
        return ended(PROG, options.out, lambda: (figures if options.figure in EPISODES else study)(options, out))


def study(options: Reproduce, out: TextIO) -> int:
    """Run what is no figure of episodes; the exit status."""
    figure, folder = options.figure, options.out
    reported = studies.Reported(SCENARIO, options.trials, options.seed, options.workers, options.timeout)
    check_drawing()
    if figure in STUDIES:
        result = run_study(figure, folder, controllers=options.controllers, reported=reported)
    else:
        how: dict[str, Any] = {
            "n_seeds": options.seeds or studies.SEEDS[figure],
            "budget": options.budget or studies.BUDGETS[figure],
            "workers": options.workers,
        }
        if figure == "ablations":
            result = studies.ablations(folder, **how)
        else:
            result = studies.figure1(folder, **how, paper_hours=options.paper_hours, reported=reported)
    print(json.dumps(result.tables, allow_nan=False, indent=1) if options.json else result.page, file=out)
    return _close(options, result.paths, result.failures, out)


def figures(options: Reproduce, out: TextIO) -> int:
    """Run the figures of episodes, and judge the claims; the exit status."""
    asked = list(EXPERIMENTS) if options.figure == "all" else [options.figure]
    methods = roster(options.controllers, options.literal)
    seeds = [trial_seed(options.seed, trial) for trial in range(options.trials)]
    check_drawing()
    studies.kept_curves(options.out)  # before hours of computing: can they be read
    todo, everything = work(asked, methods, seeds), work(list(EXPERIMENTS), methods, seeds)
    workers = workforce(PROG, options.workers, options.scheduler)
    with opened(options.out, todo, workers=workers, timeout=options.timeout, gather=options.gather) as ours:
        outcome = ours.run(todo)
        rows = table(everything, kept(ours.ledger, everything))
        summaries = {name: summary_of(name, rows, methods) for name in asked}
        differences = {name: differences_of(name, rows, methods) for name in asked}
        claims = {
            "trials": options.trials,
            "seed": options.seed,
            "version": __version__,
            # the curves as they are now: figure 1 may have been made meanwhile
            "claims": [claim.to_dict() for claim in judge(rows, seeds, curves=studies.kept_curves(options.out))],
        }
        paths = write_files(options.out, rows, summaries, differences, claims)
    if options.json:
        print(json.dumps({**summaries, "claims": claims}, allow_nan=False, indent=1), file=out)
    else:
        for summary in summaries.values():
            print_table(summary, out)
        print_claims(claims, out)
    return _close(options, paths, lost(outcome.failures), out)


def _close(options: Reproduce, paths: Sequence[Path], failures: Sequence[str], out: TextIO) -> int:
    """Name the files written, and what has no result; the exit status."""
    for path in paths:
        print(path, file=sys.stderr if options.json else out)
    for failure in failures:
        print(f"{PROG}: {failure}", file=sys.stderr)
    return 1 if failures else 0


def roster(controllers: Sequence[str], literal: bool) -> list[str]:
    """The methods to compare: those asked for, or the tuned heuristics and the policies as far as they exist."""
    known = [name for name in (*HEURISTICS, *LEARNED) if name in CONTROLLERS]
    return list(dict.fromkeys([*(controllers or known), *(LITERAL if literal else ())]))


def work(names: Sequence[str], controllers: Sequence[str], seeds: Sequence[int]) -> list[Task]:
    """The tasks of some experiments; a point that two of them share comes once.

    Raises:
        SettingsError, ControllerError: a controller is unknown or none.
    """
    grid = [
        point
        for experiment in (EXPERIMENTS[name] for name in names)
        for point in points(
            controllers=controllers, scenario=SCENARIO, flocks=experiment.flocks, cohesion=experiment.cohesion
        )
    ]
    return list({task.key: task for task in tasks(grid, seeds)}.values())


def kept(ledger: Ledger, tasks: Sequence[Task]) -> Outcome:
    """What the ledger holds of the tasks, of earlier runs for another figure too."""
    rows = ledger.rows(task.settings_hash for task in tasks)
    return Outcome(rows=[rows.get(task.key) for task in tasks], failures=[], computed=0)


def summary_of(name: str, rows: Sequence[Mapping[str, Any]], methods: Sequence[str]) -> list[dict[str, Any]]:
    """The rows of an experiment's CSV: method by method."""
    there = EXPERIMENTS[name].points
    hashes = {(row["controller"], row["n_flocks"], row["cohesion"]): row["settings_hash"] for row in rows}
    summary = [
        {**row, "settings_hash": hashes[row["controller"], row["n_flocks"], row["cohesion"]]}
        for row in summarise(row for row in rows if (row["n_flocks"], row["cohesion"]) in there)
    ]
    return _by_method(summary, methods)


def differences_of(name: str, rows: Sequence[Mapping[str, Any]], methods: Sequence[str]) -> list[dict[str, Any]]:
    """The rows of an experiment's CSV of differences from `BASELINE`, method by method; none without it."""
    mine = [row for row in rows if (row["n_flocks"], row["cohesion"]) in EXPERIMENTS[name].points]
    if not any(row["controller"] == BASELINE for row in mine):
        return []
    return _by_method(paired_differences(mine, BASELINE), methods)


def _by_method(rows: Iterable[dict[str, Any]], methods: Sequence[str]) -> list[dict[str, Any]]:
    return sorted(rows, key=lambda row: (methods.index(row["controller"]), row["n_flocks"], row["cohesion"]))


def check_drawing() -> None:
    """Find out before hours of computing whether figures can be drawn.

    Raises:
        SettingsError: matplotlib is missing.
    """
    try:
        importlib.import_module("matplotlib")
    except ImportError as error:
        raise SettingsError(f"the figures need matplotlib: pip install 'shepherd-phys[analysis]' ({error})") from None


def write_files(
    folder: Path,
    rows: Sequence[Mapping[str, Any]],
    summaries: Mapping[str, Sequence[Mapping[str, Any]]],
    differences: Mapping[str, Sequence[Mapping[str, Any]]],
    claims: Mapping[str, Any],
) -> list[Path]:
    """Write every table, page and figure; their paths.

    Raises:
        CampaignError: one cannot be written. It is as it was before.
    """
    from .figures import draw

    episodes = folder / "episodes.csv"
    write_csv(episodes, COLUMNS, rows)
    paths = [episodes]
    for name, summary in summaries.items():
        own = [folder / f"{name}.{kind}" for kind in ("csv", "md", "png")]
        apart = folder / f"{name}-differences.csv"
        if not differences[name]:
            remove([apart])
        if not summary:  # every episode failed, which is reported; what an earlier run drew must not stand for it
            remove(own)
            continue
        write_csv(own[0], (*summary_columns(), "settings_hash"), summary)
        write_bytes(own[1], figure_page(name, summary, differences[name]).encode())
        write_bytes(own[2], draw(EXPERIMENTS[name], summary))
        paths += own
        if differences[name]:
            write_csv(apart, difference_columns(), differences[name])
            paths.append(apart)
    text = json.dumps(claims, allow_nan=False, indent=1, ensure_ascii=False)
    write_bytes(folder / "claims.json", f"{text}\n".encode())
    write_bytes(folder / "claims.md", claims_page(claims).encode())
    return [*paths, folder / "claims.json", folder / "claims.md"]


def print_claims(claims: Mapping[str, Any], out: TextIO) -> None:
    """Print what each claim rests on, then the verdicts."""
    parts = Table(*("claim", *PART_HEAD), box=SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False)
    verdicts = Table("claim", "says", "verdict", box=SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False)
    for claim in claims["claims"]:
        for part in claim["parts"]:
            parts.add_row(claim["claim"], *part_cells(part))
        verdicts.add_row(claim["claim"], claim["text"], claim["verdict"])
    console = Console(file=out, markup=False, highlight=False)
    if not console.is_terminal:
        console.width = 200  # a file has no edge to wrap at
    console.print(parts)
    console.print(verdicts)
    for line in few_trials(claims):
        console.print(line)


def read_options(argv: Sequence[str]) -> Reproduce:
    """The options from the command line, checked.

    Raises:
        SettingsError: something is unknown or impossible.
        SystemExit: after ``--help``.
    """
    options, given = parsed(Reproduce, PROG, argv)
    if options.figure not in CHOICES:
        given_one = f"{options.figure!r} is unknown" if options.figure else "none was given"
        raise SettingsError(f"figure: {given_one}; there are {', '.join(CHOICES)}")
    for name in ("controllers", "gather"):
        if name in given and not getattr(options, name):
            raise SettingsError(f"--{name}: needs at least one value")
    for name, figures in GOES_WITH.items():
        if name in given and options.figure not in figures:
            shown = name.replace("_", "-")
            raise SettingsError(f"--{shown}: goes with {', '.join(figures)}, not with {options.figure}")
    at_least(vars(options), LEAST)
    if not 0.0 <= options.paper_hours < math.inf:
        raise SettingsError(f"paper-hours: {options.paper_hours} is impossible; it must be a number of at least 0")
    return options
