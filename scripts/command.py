"""What the commands share: reading flags, one-line errors, who does the work, progress."""

from __future__ import annotations

import contextlib
import io
import os
import re
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import fields
from functools import partial
from typing import Any, TypeVar

import tyro
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from shepherd_phys import campaign
from shepherd_phys.cluster import Cluster
from shepherd_phys.settings import SettingsError, meant

LOG_SECONDS = 30.0
"""Progress is a line so often where standard error is no terminal [s]."""
NUMBERS = ("sheep", "trials", "seeds", "seed", "workers", "rounds", "candidates", "budget")
WANTED = {
    **dict.fromkeys(("flocks", "cohesion", "shepherds"), "whole numbers"),
    **dict.fromkeys(NUMBERS, "a whole number"),
    "timeout": "a number of seconds",
    "obstacles": "a whole number",
    "density": "a number",
    "paper-hours": "a number of hours",
}
"""What a flag takes, for the error that says so."""

UNKNOWN = "Unrecognized options:"
"""How an error of tyro about words that are no options begins."""
ADDRESS = re.compile(r"([a-z]+://)?[^\s/]+:\d+")
"""Of a scheduler."""

T = TypeVar("T")


def cpu_count() -> int:
    """Processors that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def flag(metavar: str, default: str | None = None, text: str | None = None) -> Any:
    """How ``--help`` shows a flag; ``default`` in words where the value does not tell, ``text`` for its docstring."""
    hint = f"(default: {default})" if default else default
    return tyro.conf.arg(metavar=metavar, help_behavior_hint=hint, help=text)


def parsed(cls: type[T], prog: str, argv: Sequence[str]) -> tuple[T, set[str]]:
    """The options from the command line, and the names of those that were given.

    Args:
        cls: a dataclass, which is the command line.
        prog: the command.
        argv: its words.

    Raises:
        SettingsError: the words are no such options; --scheduler is no address, or is given with --workers. One line.
        SystemExit: after ``--help``.
    """
    said = io.StringIO()
    names = [f.name for f in fields(cls)]  # type: ignore[arg-type]
    try:
        with contextlib.redirect_stderr(said):
            options = tyro.cli(cls, prog=prog, args=list(argv))
    except SystemExit as end:
        if not end.code:
            raise
        problem = _one_line(said.getvalue())
        raise SettingsError(f"{problem}{_hint(problem, names)} (see {prog} --help)") from None
    words = {word.split("=")[0].replace("_", "-") for word in argv}
    given = {name for name in names if f"--{name.replace('_', '-')}" in words}
    scheduler = getattr(options, "scheduler", None)
    if scheduler is not None and not ADDRESS.fullmatch(scheduler):
        raise SettingsError(f"scheduler: {scheduler!r} is no address; it must be like tcp://HOST:PORT")
    if {"workers", "scheduler"} <= given:
        raise SettingsError("--workers and --scheduler: the workers are the cluster's then; leave one of the two out")
    return options, given


def _hint(problem: str, names: Sequence[str]) -> str:
    """What helps with an error of the command line: the flag that was meant, or what a flag takes."""
    if problem.startswith(UNKNOWN):
        flags = [name.replace("_", "-") for name in names]
        words = [word for word in problem.removeprefix(UNKNOWN).split() if word.startswith("--")]
        hints = [meant(re.split("[=,]", word[2:])[0].replace("_", "-"), flags, before="--") for word in words]
        return "".join(hints[:1])
    wanted = [f"; --{name} takes {what}" for name, what in WANTED.items() if f"--{name}" in problem]
    return "".join(wanted[:1])


def at_least(values: Mapping[str, Any], least: Mapping[str, int]) -> None:
    """Refuse numbers, alone or in tuples, that are too small, and a ``timeout`` that is not above 0.

    Raises:
        SettingsError: names the first such option, its value and what is allowed.
    """
    for name, bound in least.items():
        for number in values[name] if isinstance(values[name], tuple) else [values[name]]:
            if number is not None and number < bound:
                raise SettingsError(f"{name}: {number} is impossible; it must be at least {bound}")
    if not values.get("timeout", 1.0) > 0:
        raise SettingsError(f"timeout: {values['timeout']} is impossible; it must be above 0 s")


def fail(prog: str, error: object, status: int) -> int:
    """Say in one line what went wrong; the exit status, handed on."""
    print(f"{prog}: {' '.join(str(error).split())}", file=sys.stderr)
    return status


def workforce(prog: str, workers: int, scheduler: str | None) -> int | campaign.Hire:
    """Who does the work of a campaign: so many processes of this machine, or a Dask cluster."""
    if scheduler is None:
        return workers
    return partial(Cluster, address=scheduler, say=lambda text: print(f"{prog}: {text}", file=sys.stderr))


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
    shown = bar.add_task("episodes", total=None, pace="starting")
    logged = time.monotonic()
    first: tuple[float, int] | None = None
    before: int | None = None

    def report(now: campaign.Progress) -> None:
        nonlocal logged, first, before
        ended = now.done + now.failed
        before = ended if before is None else before
        if first is None and ended > before:
            first = time.monotonic(), ended  # the pace is counted from here: until here workers were starting
        pace = f"continuing, {before} of {now.total} there" if before else "starting"
        if first is not None and ended > first[1]:
            rate = (ended - first[1]) / (time.monotonic() - first[0])
            pace = f"{rate:.2f} episodes/s, {clock((now.total - ended) / rate)} left"
        if now.failed:
            pace += f", {now.failed} failed"
        bar.update(shown, total=now.total, completed=ended, pace=pace)
        if not console.is_terminal and time.monotonic() - logged > LOG_SECONDS:
            logged = time.monotonic()
            print(f"{ended}/{now.total} episodes: {pace}", file=sys.stderr, flush=True)

    with bar:
        yield report


def clock(seconds: float) -> str:
    """Hours, minutes and seconds."""
    minutes, seconds = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{seconds:02d}"


def counted(n: int, thing: str) -> str:
    """So many of them: ``1 flock``, ``2 flocks``."""
    return f"{n} {thing}{'s' if n > 1 else ''}"


def _one_line(box: str) -> str:
    """What a box of tyro's says, without its title, frame and the help below the message's rule.

    Where standard output is not UTF-8, the frame is of blanks and hyphens, and the title has a rule of its own.
    """
    framed = "╭" in box
    parts: list[list[str]] = [[]]
    for line in box.splitlines():
        line = line.strip("│ ")
        if line and not line.strip("─-"):
            parts.append([])
        elif not line.startswith(("╭", "╰")):
            parts[-1].append(line)
    message = parts[0] if framed or len(parts) == 1 else parts[1]
    return " ".join(" ".join(message).split())
