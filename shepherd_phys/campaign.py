"""Run many independent episodes on many workers and lose none.

A campaign is a list of tasks, (settings hash, seed, spec), and a function ``work(spec, seed) -> row``. It knows no
envs and no controllers. Every row is committed to a ledger (SQLite, WAL) in the campaign's folder as soon as it
exists: a run that was killed continues where it was, and a finished one costs nothing.

What the ledger holds does not depend on the number of workers or on the order in which they finish, and neither do
files made from it by `write_csv`.
"""

from __future__ import annotations

import csv
import hashlib
import io
import json
import pickle
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from shepherd_phys.files import whole_file
from shepherd_phys.ledger import LEDGER, CampaignError, Ledger, Task, gathered
from shepherd_phys.workers import Ended, Job, Pool, Work, Workers, WorkersError, attempt, finished

__all__ = [
    "LEDGER",
    "CampaignError",
    "Failure",
    "Hire",
    "Ledger",
    "Outcome",
    "Progress",
    "Task",
    "gathered",
    "run",
    "settings_hash",
    "shard",
    "write_csv",
    "write_parquet",
]

Hire = Callable[[Work, float], AbstractContextManager[Pool]]
"""Engages workers: (work, timeout of a job [s]) -> what does the jobs."""


def settings_hash(settings: Mapping[str, Any]) -> str:
    """SHA-256 of plain data (numbers, text, lists, tables), written as canonical JSON.

    Raises:
        ValueError, TypeError: something in it is not plain data, or is NaN or infinite.
    """
    text = json.dumps(settings, sort_keys=True, separators=(",", ":"), ensure_ascii=True, allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()


@dataclass(frozen=True)
class Failure:
    """An episode that has no row, after all its attempts."""

    task: Task
    cause: str
    attempts: int

    def __str__(self) -> str:
        return f"{self.task.name or self.task.settings_hash[:12]}, seed {self.task.seed}: {self.cause}"


@dataclass(frozen=True)
class Progress:
    """How far a run is."""

    total: int
    """Tasks."""
    done: int
    """Tasks that have a row, those of earlier runs included."""
    failed: int


@dataclass(frozen=True)
class Outcome:
    """What a run left."""

    rows: list[dict[str, Any] | None]
    """One a task, in the order of the tasks, as ``work`` returned it; None where it failed."""
    failures: list[Failure]
    """In the order of the tasks."""
    computed: int
    """Rows that this run had to make."""


def run(
    tasks: Iterable[Task],
    work: Work,
    *,
    workers: int | Hire,
    ledger: Ledger,
    timeout: float = 600.0,
    retries: int = 2,
    report: Callable[[Progress], None] | None = None,
) -> Outcome:
    """Run what the ledger does not hold yet.

    A worker that dies, hangs or throws loses only its episode, which is tried again after all others and, when its
    attempts are used up, reported; the rest completes. A failure is not kept: the next run tries anew.

    Args:
        tasks: two with the same key count as one.
        work: ``work(spec, seed)`` -> row of plain data (JSON); a function of a module.
        workers: processes. One too is a process of its own, because an engine may abort the process that it is in.
            With 0 the work is done in this process, unprotected and without timeout: for debuggers.
            Or what engages workers elsewhere, such as a `Cluster`.
        ledger: where rows are kept.
        timeout: of one episode [s].
        retries: further attempts of an episode that failed.
        report: called at the start and whenever an episode ends.

    Raises:
        CampaignError: the ledger cannot be written, or no worker can be started or reached.
    """
    if (isinstance(workers, int) and workers < 0) or retries < 0 or not timeout > 0:
        raise ValueError(f"workers, retries and timeout: {workers}, {retries}, {timeout} cannot be")
    order = list({task.key: task for task in tasks}.values())
    rows: dict[tuple[str, int], dict[str, Any]] = ledger.rows(task.settings_hash for task in order)
    waiting = deque(Job((task, 1), task.spec, task.seed) for task in order if task.key not in rows)
    todo = len(waiting)
    failures: dict[tuple[str, int], Failure] = {}

    def tell() -> None:
        if report is not None:
            failed = len(failures)
            report(Progress(len(order), len(order) - todo + computed, failed))

    computed = 0
    tell()
    for ended in _ended_jobs(waiting, work, workers, timeout):
        task, number = ended.key
        if ended.result is not None:
            ledger.add(task, ended.result)
            rows[task.key] = json.loads(ended.result)
            computed += 1
        elif number <= retries:
            waiting.append(Job((task, number + 1), task.spec, task.seed))
            continue
        else:
            failures[task.key] = Failure(task, ended.cause, number)
        tell()
    return Outcome(
        rows=[rows.get(task.key) for task in order],
        failures=[failures[task.key] for task in order if task.key in failures],
        computed=computed,
    )


def _ended_jobs(waiting: deque[Job], work: Work, workers: int | Hire, timeout: float) -> Iterator[Ended]:
    """Do what waits, and what is appended meanwhile; how they end, as they end."""
    if not waiting:
        return
    if workers == 0:
        while waiting:
            job = waiting.popleft()
            ok, text = attempt(work, pickle.dumps((job.spec, job.seed)))
            yield Ended(job.key, text, "") if ok else Ended(job.key, None, text)
        return
    engaged: AbstractContextManager[Pool]
    try:
        if isinstance(workers, int):
            engaged = Workers(work, min(workers, len(waiting)), timeout)
        else:
            engaged = workers(work, timeout)
        with engaged as pool:
            yield from finished(pool, waiting)
    except WorkersError as error:
        raise CampaignError(str(error)) from error


def remove(paths: Iterable[Path]) -> None:
    """Remove files, those that are there.

    Raises:
        CampaignError: one cannot be removed.
    """
    for path in paths:
        try:
            path.unlink(missing_ok=True)
        except OSError as error:
            raise CampaignError(f"{path}: is of an earlier run and cannot be removed ({error.strerror})") from None


def write_bytes(path: str | Path, content: bytes) -> None:
    """Write a file, which appears whole or not at all.

    Raises:
        CampaignError: it cannot be written.
    """
    with _table(Path(path)) as part:
        part.write_bytes(content)


def write_csv(path: str | Path, columns: Sequence[str], rows: Iterable[Mapping[str, Any]]) -> None:
    """Write rows as CSV; the file appears whole or not at all.

    Floats are written as the shortest text that reads back as the same number, truth as ``true`` and ``false``,
    None as nothing.

    Raises:
        CampaignError: the file cannot be written.
        KeyError: a row lacks a column.
    """
    with _table(Path(path)) as part, part.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(columns)
        writer.writerows([_cell(row[column]) for column in columns] for row in rows)


def write_parquet(path: str | Path, columns: Mapping[str, type], rows: Sequence[Mapping[str, Any]]) -> bool:
    """Write rows as Parquet, where polars is installed; the file appears whole or not at all.

    The same rows give the same bytes, by the same version of polars.

    Args:
        path: of the file.
        columns: their kinds: str, bool, int or float. Any cell may be None.
        rows: with these columns, and perhaps more.

    Returns:
        whether it is written: not without polars.

    Raises:
        CampaignError: the file cannot be written.
        KeyError: a row lacks a column.
    """
    try:
        import polars
    except ImportError:
        return False
    kinds: dict[type, Any] = {str: polars.String, bool: polars.Boolean, int: polars.Int64, float: polars.Float64}
    with _table(Path(path)) as part:
        cells = {name: [row[name] for row in rows] for name in columns}
        try:
            frame = polars.DataFrame(cells, schema={name: kinds[kind] for name, kind in columns.items()})
        except (TypeError, polars.exceptions.PolarsError) as error:
            raise CampaignError(f"{path}: cannot be written ({' '.join(str(error).split())})") from None
        packed = io.BytesIO()
        frame.write_parquet(packed)
        part.write_bytes(packed.getvalue())
    return True


@contextmanager
def _table(path: Path) -> Iterator[Path]:
    try:
        with whole_file(path) as part:
            yield part
    except OSError as error:
        raise CampaignError(
            f"{path}: cannot be written ({error.strerror}); no episode is lost: the same run writes it again"
        ) from None


def _cell(value: Any) -> str:
    if value is None:
        return ""
    if isinstance(value, bool):
        return "true" if value else "false"
    return repr(value) if isinstance(value, float) else str(value)


def shard(tasks: Sequence[Task], number: int, count: int) -> list[Task]:
    """The tasks of every ``count``-th seed, beginning with the ``number``-th (1-based).

    Shards share nothing and leave out none. Seeds are not split: so a shard has every point, costs as much as another,
    and its comparisons are paired.
    """
    if not 1 <= number <= count:
        raise ValueError(f"shard: needs I/N with 1 <= I <= N (given: {number}/{count})")
    own = set(list(dict.fromkeys(task.seed for task in tasks))[number - 1 :: count])
    return [task for task in tasks if task.seed in own]
