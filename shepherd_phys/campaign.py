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
import json
import os
import pickle
import sqlite3
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Self

from shepherd_phys.workers import Ended, Work, Workers, WorkersError, attempt

SCHEMA = 1
"""Version of the ledger's tables."""
APPLICATION_ID = 0x53686570
"""Marks the SQLite file as one of ours ("Shep")."""
LEDGER = "ledger.sqlite"
LOCK = "ledger.lock"


class CampaignError(RuntimeError):
    """A campaign cannot start or go on; one line. What its ledger held, it still holds."""


def settings_hash(settings: Mapping[str, Any]) -> str:
    """SHA-256 of plain data (numbers, text, lists, tables), written as canonical JSON.

    Raises:
        ValueError, TypeError: something in it is not plain data, or is NaN or infinite.
    """
    text = json.dumps(settings, sort_keys=True, separators=(",", ":"), ensure_ascii=True, allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()


@dataclass(frozen=True)
class Task:
    """One episode to be run: ``work(spec, seed)``."""

    settings_hash: str
    """Of all that determines the row except the seed."""
    seed: int
    spec: Any = field(compare=False)
    """What ``work`` needs beside the seed; it is pickled."""
    name: str = field(default="", compare=False)
    """For messages: what is being run."""

    @property
    def key(self) -> tuple[str, int]:
        """The row's key in the ledger."""
        return self.settings_hash, self.seed


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


class Ledger:
    """The rows of a campaign's folder, which it holds for itself alone until it is closed. A context manager.

    The lock is an exclusive transaction on an empty SQLite file beside the ledger: the system lets go of it whatever
    becomes of this process, and anybody can still read the ledger meanwhile.

    Args:
        folder: where it lies or shall lie; made if missing.
        version: of the program whose rows these are.

    Raises:
        CampaignError: the folder cannot be written, is in use by another run, or holds a ledger of another version.
    """

    def __init__(self, folder: str | Path, version: str) -> None:
        self.folder = Path(folder)
        self.path = self.folder / LEDGER
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise CampaignError(f"{self.folder}: cannot be made or written ({error.strerror})") from None
        self._lock = self._take_lock()
        try:
            with self._errors():
                self._rows = sqlite3.connect(self.path, isolation_level=None, timeout=10.0)
                self._prepare(version)
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Let go of the folder."""
        with suppress(AttributeError, sqlite3.Error):
            self._rows.close()
        self._lock.close()

    def rows(self, hashes: Iterable[str]) -> dict[tuple[str, int], dict[str, Any]]:
        """All rows under these settings hashes, by (settings hash, seed)."""
        found = {}
        with self._errors():
            for name in dict.fromkeys(hashes):
                query = "SELECT seed, row FROM episodes WHERE settings_hash = ?"
                for seed, row in self._rows.execute(query, (name,)):
                    found[name, int(seed)] = json.loads(row)
        return found

    def add(self, task: Task, row: str) -> None:
        """Commit a row (JSON text)."""
        with self._errors():
            self._rows.execute("INSERT INTO episodes VALUES (?, ?, ?)", (*task.key, row))

    def note(self, name: str) -> str | None:
        """A note that was left beside the rows."""
        with self._errors():
            found = self._rows.execute("SELECT value FROM notes WHERE name = ?", (name,)).fetchone()
        return None if found is None else str(found[0])

    def leave_note(self, name: str, value: str) -> None:
        """Leave a note beside the rows, in place of an earlier one."""
        with self._errors():
            self._rows.execute("INSERT OR REPLACE INTO notes VALUES (?, ?)", (name, value))

    def _take_lock(self) -> sqlite3.Connection:
        lock = None
        try:
            lock = sqlite3.connect(self.folder / LOCK, isolation_level=None, timeout=0.0)
            lock.execute("BEGIN EXCLUSIVE")
        except sqlite3.Error as error:
            if lock is not None:
                lock.close()
            if getattr(error, "sqlite_errorname", "").startswith(("SQLITE_BUSY", "SQLITE_LOCKED")):
                message = "is in use by another run; wait for it or choose another folder"
            else:
                message = f"cannot be written ({error})"
            raise CampaignError(f"{self.folder}: {message}") from None
        return lock

    def _prepare(self, version: str) -> None:
        """Check whose ledger it is, or make the tables of a new one in one transaction."""
        rows = self._rows
        tables = rows.execute("SELECT count(*) FROM sqlite_master").fetchone()[0]
        if tables:
            mark, schema = (rows.execute(f"PRAGMA {name}").fetchone()[0] for name in ("application_id", "user_version"))
            if mark != APPLICATION_ID:
                raise CampaignError(f"{self.path}: is not a ledger of shepherd_phys; choose another folder")
            if schema != SCHEMA:
                raise CampaignError(
                    f"{self.path}: is a ledger of version {schema}, this program writes version {SCHEMA}; "
                    "choose another folder"
                )
            theirs = self.note("version")
            if theirs != version:
                raise CampaignError(
                    f"{self.path}: holds rows of shepherd_phys {theirs}, this is {version}; choose another folder"
                )
        # without a sync at each commit: a killed process loses nothing, a power cut at most the last rows
        rows.execute("PRAGMA synchronous = NORMAL")
        rows.execute("PRAGMA journal_mode = WAL")
        if not tables:
            rows.execute("BEGIN IMMEDIATE")
            rows.execute(f"PRAGMA application_id = {APPLICATION_ID}")
            rows.execute(f"PRAGMA user_version = {SCHEMA}")
            rows.execute("CREATE TABLE notes (name TEXT PRIMARY KEY, value TEXT NOT NULL) WITHOUT ROWID")
            rows.execute(
                "CREATE TABLE episodes (settings_hash TEXT, seed INTEGER, row TEXT NOT NULL, "
                "PRIMARY KEY (settings_hash, seed)) WITHOUT ROWID"
            )
            rows.execute("INSERT INTO notes VALUES ('version', ?)", (version,))
            rows.execute("COMMIT")

    @contextmanager
    def _errors(self) -> Iterator[None]:
        try:
            yield
        except sqlite3.Error as error:
            if getattr(error, "sqlite_errorname", "") == "SQLITE_NOTADB":
                problem = "is not a ledger of shepherd_phys; choose another folder"
            else:
                problem = f"{error}; every earlier row is kept: when that is put right, the same run continues"
            raise CampaignError(f"{self.path}: {problem}") from error


def run(
    tasks: Iterable[Task],
    work: Work,
    *,
    workers: int,
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
        ledger: where rows are kept.
        timeout: of one episode [s].
        retries: further attempts of an episode that failed.
        report: called at the start and whenever an episode ends.

    Raises:
        CampaignError: the ledger cannot be written, or no worker can be started.
    """
    if workers < 0 or retries < 0 or not timeout > 0:
        raise ValueError(f"workers, retries and timeout: {workers}, {retries}, {timeout} cannot be")
    order = list({task.key: task for task in tasks}.values())
    rows: dict[tuple[str, int], dict[str, Any]] = ledger.rows(task.settings_hash for task in order)
    waiting = deque((task, 1) for task in order if task.key not in rows)
    todo = len(waiting)
    failures: dict[tuple[str, int], Failure] = {}

    def tell() -> None:
        if report is not None:
            failed = len(failures)
            report(Progress(len(order), len(order) - todo + computed, failed))

    computed = 0
    tell()
    for (task, number), ended in _ended_jobs(waiting, work, workers, timeout):
        if ended.result is not None:
            ledger.add(task, ended.result)
            rows[task.key] = json.loads(ended.result)
            computed += 1
        elif number <= retries:
            waiting.append((task, number + 1))
            continue
        else:
            failures[task.key] = Failure(task, ended.cause, number)
        tell()
    return Outcome(
        rows=[rows.get(task.key) for task in order],
        failures=[failures[task.key] for task in order if task.key in failures],
        computed=computed,
    )


def _ended_jobs(
    waiting: deque[tuple[Task, int]], work: Work, n_workers: int, timeout: float
) -> Iterator[tuple[tuple[Task, int], Ended]]:
    """Do what waits, and what is appended meanwhile; (task, attempt) and how it ended, as they end."""
    if not waiting:
        return
    if n_workers == 0:
        while waiting:
            job = waiting.popleft()
            ok, text = attempt(work, pickle.dumps((job[0].spec, job[0].seed)))
            yield job, Ended(job, text, "") if ok else Ended(job, None, text)
        return
    try:
        with Workers(work, min(n_workers, len(waiting)), timeout) as pool:
            busy = 0
            while waiting or busy:
                while waiting and pool.idle():
                    job = waiting.popleft()
                    pool.give(job, job[0].spec, job[0].seed)
                    busy += 1
                for ended in pool.wait():
                    busy -= 1
                    yield ended.key, ended
    except WorkersError as error:
        raise CampaignError(str(error)) from error


def write_csv(path: str | Path, columns: Sequence[str], rows: Iterable[Mapping[str, Any]]) -> None:
    """Write rows as CSV; the file appears whole or not at all.

    Floats are written as the shortest text that reads back as the same number, truth as ``true`` and ``false``,
    None as nothing.

    Raises:
        CampaignError: the file cannot be written.
        KeyError: a row lacks a column.
    """
    path = Path(path)
    part = path.with_name(path.name + ".part")
    try:
        with part.open("w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file, lineterminator="\n")
            writer.writerow(columns)
            writer.writerows([_cell(row[column]) for column in columns] for row in rows)
            file.flush()
            os.fsync(file.fileno())  # the name must never stand for a file that is not on the disk yet
        os.replace(part, path)
    except OSError as error:
        raise CampaignError(
            f"{path}: cannot be written ({error.strerror}); no episode is lost: the same run writes it again"
        ) from None
    finally:
        with suppress(OSError):
            part.unlink()


def _cell(value: Any) -> str:
    if value is None:
        return ""
    if isinstance(value, bool):
        return "true" if value else "false"
    return repr(value) if isinstance(value, float) else str(value)


def shard(tasks: Sequence[Task], number: int, count: int) -> list[Task]:
    """Every ``count``-th task, beginning with the ``number``-th (1-based): shards share nothing and leave out none."""
    if not 1 <= number <= count:
        raise ValueError(f"shard: needs I/N with 1 <= I <= N (given: {number}/{count})")
    return list(tasks[number - 1 :: count])
