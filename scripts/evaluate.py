"""``shepherd-phys evaluate``: run controllers headless over a grid of experiments, many episodes at a time."""

from __future__ import annotations

import contextlib
import importlib.util
import io
import json
import os
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from shepherd_phys import __version__, campaign
from shepherd_phys.campaign import CampaignError, Ledger
from shepherd_phys.controllers.evaluation import ControllerError, run_episode, trial_seed
from shepherd_phys.envs.shepherding import ShepherdingEnv
from shepherd_phys.scenario import SCENARIOS
from shepherd_phys.settings import SettingsError, read_toml
from shepherd_phys.workers import explain

from .points import Point, episode, find_controller, place, points, table, tasks, write_tables

PROG = "shepherd-phys evaluate"
PICTURE = "episode.png"
PICTURE_SIZE = (900, 900)
"""[px]."""
LOG_SECONDS = 30.0
"""Progress is a line so often where standard error is no terminal [s]."""


def cpu_count() -> int:
    """Processors that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _metavar(name: str) -> Any:
    return tyro.conf.arg(metavar=name)


@dataclass(frozen=True)
class Evaluate:
    """Run controllers headless over the full cross product of the lists given, and write the tables.

    Writes episodes.csv (one row an episode), summary.csv (means with 95 % bootstrap intervals) and episode.png into the
    folder --out, with a ledger that lets a stopped campaign continue: give the same command again.
    """

    controllers: Annotated[tuple[str, ...], _metavar("NAME ..")] = ("strombom",)
    """Controllers by name, or module:Name of your own (imported from the current directory)."""
    flocks: Annotated[tuple[int, ...], _metavar("K ..")] = ()
    """Numbers of flocks (default: the scenario's)."""
    cohesion: Annotated[tuple[int, ...], _metavar("N ..")] = ()
    """Numbers of neighbours that attract a sheep (default: the scenario's)."""
    shepherds: Annotated[tuple[int, ...], _metavar("M ..")] = ()
    """Numbers of shepherds (default: the scenario's)."""
    sheep: Annotated[int | None, _metavar("N")] = None
    """Number of sheep (default: the scenario's)."""
    scenario: Annotated[str, _metavar("NAME|FILE")] = "paper"
    """A preset's name or a TOML file."""
    body: Annotated[str | None, _metavar("NAME|module:Name")] = None
    """Body of every shepherd (default: the scenario's)."""
    flock: Annotated[str | None, _metavar("NAME|module:Name")] = None
    """Flock model (default: the scenario's)."""
    trials: Annotated[int, _metavar("T")] = 100
    """Episodes a point."""
    seed: Annotated[int, _metavar("S")] = 20_000
    """Root seed: trial i has a seed derived from S and i alone, the same for every controller and point."""
    grid: Annotated[Path | None, _metavar("FILE")] = None
    """A TOML file with any of the options above, e.g. flocks = [1, 2]."""
    shard: Annotated[str | None, _metavar("I/N")] = None
    """Run only the I-th of N equal parts (1-based), for machines that share nothing."""
    workers: Annotated[int, _metavar("W")] = cpu_count()
    """Worker processes; the results do not depend on it."""
    timeout: Annotated[float, _metavar("SECONDS")] = 600.0
    """An episode that takes longer counts as hung."""
    out: Annotated[Path, _metavar("DIR")] = Path("results")
    """Folder for tables and ledger; an unfinished campaign in it is continued."""
    json: tyro.conf.FlagCreatePairsOff[bool] = False
    """Print the summary as one JSON array, and nothing else, on standard output."""


GRID_KEYS = ("controllers", "flocks", "cohesion", "shepherds", "sheep", "scenario", "body", "flock", "trials", "seed")
LISTS = {"controllers": str, "flocks": int, "cohesion": int, "shepherds": int}
LEAST = {"flocks": 1, "cohesion": 1, "shepherds": 1, "sheep": 1, "trials": 1, "seed": 0, "workers": 1}


def main(argv: Sequence[str]) -> int:
    """Run the command; the exit status: 0, 1 if episodes failed, 2 for a mistake of the user, 130 for Ctrl-C."""
    try:
        options = read_options(argv)
        part, count = read_shard(options.shard)
        grid = points(**{name: getattr(options, name) for name in GRID_KEYS if name not in ("trials", "seed")})
        seeds = list(dict.fromkeys(trial_seed(options.seed, trial) for trial in range(options.trials)))
        todo = campaign.shard(tasks(grid, seeds), part, count)
        ledger = Ledger(options.out, __version__)
    except (SettingsError, ControllerError, CampaignError) as error:
        return _fail(error, 2)
    with ledger:
        try:
            return _run(options, todo, ledger)
        except CampaignError as error:
            return _fail(error, 1)
        except KeyboardInterrupt:
            return _fail(f"stopped; what was finished is kept in {ledger.path}: the same command continues", 130)


def _run(options: Evaluate, todo: list[campaign.Task], ledger: Ledger) -> int:
    with progress_bar() as report:
        kept = ledger.rows(task.settings_hash for task in todo)
        try:
            rehearse([task for task in todo if task.key not in kept])
        except SettingsError as error:
            return _fail(error, 2)
        outcome = campaign.run(
            todo, episode, workers=options.workers, ledger=ledger, timeout=options.timeout, report=report
        )
    rows = table(todo, outcome)
    summary, paths = write_tables(options.out, rows)
    if todo and outcome.rows[0] is not None:
        paths += picture(todo[0], ledger)
    if options.json:
        print(json.dumps(summary, allow_nan=False, indent=1))
    else:
        print_table(summary)
    for path in paths:
        print(path, file=sys.stderr if options.json else sys.stdout)
    for failure in outcome.failures:
        print(f"{PROG}: no result in {failure.attempts} attempts: {failure}", file=sys.stderr)
    return 1 if outcome.failures else 0


def rehearse(todo: Sequence[campaign.Task]) -> None:
    """Find out once, and not by every episode's failing, what can be known before; compile before workers start.

    Raises:
        SettingsError: no world can be placed for a point (on three of its seeds; one may be bad luck).
    """
    if not todo:
        return
    env = ShepherdingEnv(SCENARIOS["small"], rewards={}, lidar=None)
    env.reset(seed=0)
    env.step(np.zeros((env.scenario.n_shepherds, 2)))  # compiled code is kept on disk: workers find it there
    seeds: dict[str, list[int]] = {}
    for task in todo:
        seeds.setdefault(task.settings_hash, []).append(task.seed)
    for task in {task.settings_hash: task for task in todo}.values():
        place(task.spec, seeds[task.settings_hash][:3])


def _fail(error: object, status: int) -> int:
    print(f"{PROG}: {' '.join(str(error).split())}", file=sys.stderr)
    return status


def read_options(argv: Sequence[str]) -> Evaluate:
    """The options from the command line and the grid file, checked.

    Raises:
        SettingsError: something is unknown, given twice or impossible.
        SystemExit: after ``--help``.
    """
    said = io.StringIO()
    try:
        with contextlib.redirect_stderr(said):
            options = tyro.cli(Evaluate, prog=PROG, args=list(argv))
    except SystemExit as end:
        if not end.code:
            raise
        raise SettingsError(_one_line(said.getvalue())) from None
    flags = {f.name for f in fields(Evaluate) if any(a == f"--{f.name}" or a.startswith(f"--{f.name}=") for a in argv)}
    values = {f.name: getattr(options, f.name) for f in fields(Evaluate)}
    for name in LISTS:
        if name in flags and not values[name]:
            raise SettingsError(f"--{name}: needs at least one value")
    if options.grid is not None:
        for name, value in read_grid(options.grid).items():
            if name in flags:
                raise SettingsError(f"--{name} is given and {options.grid} sets {name} too: leave one of them out")
            values[name] = value
    for name, least in LEAST.items():
        for number in values[name] if name in LISTS else [values[name]]:
            if number is not None and number < least:
                raise SettingsError(f"{name}: {number} is impossible; it must be at least {least}")
    if not values["timeout"] > 0:
        raise SettingsError(f"timeout: {values['timeout']} is impossible; it must be above 0 s")
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
            wanted = {int: "whole number", str: "text"}[kind]
            wanted = f"a list of {wanted}s" if name in LISTS and kind is int else wanted
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


def _one_line(box: str) -> str:
    """What a box of tyro's says, without the box and without the help below its first rule."""
    words = []
    for line in box.splitlines():
        line = line.strip("│ ")
        if line.startswith("───"):
            break
        if not line.startswith(("╭", "╰")):
            words.append(line)
    return " ".join(" ".join(words).split()) + f" (see {PROG} --help)"


def print_table(summary: Sequence[Mapping[str, Any]]) -> None:
    """Print what matters most of the summary on standard output."""
    shown = {
        "in_goal_end": ("in at the end %", ".1f"),
        "ever_in_goal": ("ever in %", ".1f"),
        "path_length": ("path m", ".0f"),
        "time_to_95": ("time to 95 % s", ".0f"),
        "collisions": ("collisions", ".1f"),
    }
    grid = Table(title="mean [95 % bootstrap interval]", title_justify="left")
    for name in ("controller", "scenario", "sheep", "flocks", "cohesion", "shepherds", "trials"):
        grid.add_column(name, justify="left" if name in ("controller", "scenario") else "right", no_wrap=True)
    for title, _ in shown.values():
        grid.add_column(title, justify="right", no_wrap=True)
    for row in summary:
        labels = ("controller", "scenario", "n_sheep", "n_flocks", "cohesion", "n_shepherds", "trials")
        grid.add_row(
            *("" if row[name] is None else str(row[name]) for name in labels),
            *(f"{row[f'{n}_mean']:{f}} [{row[f'{n}_low']:{f}}, {row[f'{n}_high']:{f}}]" for n, (_, f) in shown.items()),
        )
    console = Console(file=sys.stdout, markup=False, highlight=False)
    if not console.is_terminal:
        console.width = 220  # a file has no edge to wrap at
    console.print(grid)


@contextlib.contextmanager
def progress_bar() -> Iterator[Any]:
    """A bar with rate and time left on standard error; a function for `campaign.run` to report to."""
    console = Console(stderr=True)
    bar = Progress(
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[pace]}"),
        TimeElapsedColumn(),
        console=console,
        disable=not console.is_terminal,
    )
    shown = bar.add_task("episodes", total=None, pace="")
    began, last, before = time.monotonic(), time.monotonic(), None

    def report(now: campaign.Progress) -> None:
        nonlocal last, before
        before = now.done if before is None else before
        seconds = time.monotonic() - began
        rate = (now.done - before) / seconds if seconds else 0.0
        left = (now.total - now.done - now.failed) / rate if rate else None
        pace = f"{rate:.2f} episodes/s, {'?' if left is None else _clock(left)} left"
        if now.failed:
            pace += f", {now.failed} failed"
        bar.update(shown, total=now.total, completed=now.done + now.failed, pace=pace)
        if not console.is_terminal and time.monotonic() - last > LOG_SECONDS:
            last = time.monotonic()
            print(f"{now.done + now.failed}/{now.total} episodes, {pace}", file=sys.stderr, flush=True)

    with bar:
        yield report


def _clock(seconds: float) -> str:
    minutes, seconds = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{seconds:02d}"


def picture(task: campaign.Task, ledger: Ledger) -> list[Path]:
    """Draw how a task's episode ended beside the ledger, unless that picture is there; its path, if there is one."""
    path = ledger.folder / PICTURE
    if importlib.util.find_spec("pygame") is None:
        print(f"{PROG}: no {PICTURE}: pygame-ce is missing (pip install 'shepherd-phys[render]')", file=sys.stderr)
        return []
    drawn = f"{task.settings_hash} {task.seed}"
    if path.exists() and ledger.note(PICTURE) == drawn:
        return [path]
    try:
        draw_episode(task.spec, task.seed, path)
    except Exception as error:  # the tables do not hang on a picture
        print(f"{PROG}: no {PICTURE}: {explain(error)}", file=sys.stderr)
        return []
    ledger.leave_note(PICTURE, drawn)
    return [path]


def draw_episode(point: Point, seed: int, path: Path) -> None:
    """Run an episode again in this process and draw its end, with trails and where the sheep began."""
    from shepherd_phys.render import save_png

    controller = find_controller(point.controller)
    make_env = partial(ShepherdingEnv, point.scenario, render_mode="rgb_array", render_size=PICTURE_SIZE)
    env = make_env(rewards={}, lidar=controller.lidar)
    with contextlib.redirect_stdout(sys.stderr):
        run_episode(controller, env, seed)
        drawn = env.render()
    env.close()
    if drawn is not None:
        save_png(drawn, path)
