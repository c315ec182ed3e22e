"""The ledger of a campaign: its rows on disk, in SQLite (WAL), committed one by one."""

from __future__ import annotations

import json
import shutil
import sqlite3
import tempfile
from collections.abc import Iterable, Iterator, Mapping
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Self

SCHEMA = 1
"""Version of the ledger's tables."""
APPLICATION_ID = 0x53686570
"""Marks the SQLite file as one of ours ("Shep")."""
LEDGER = "ledger.sqlite"
LOCK = "ledger.lock"
STRANGER = "is not a ledger of shepherd_phys; choose another folder"


class CampaignError(RuntimeError):
    """A campaign cannot start or go on; one line. What its ledger held, it still holds."""


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
            why = "it is a file, not a folder" if self.folder.is_file() else error.strerror
            raise CampaignError(f"{self.folder}: cannot be made or written ({why})") from None
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

    def take(self, rows: Mapping[tuple[str, int], str]) -> None:
        """Take over rows (JSON text) by (settings hash, seed), all or none; those that it has already stay.

        Raises:
            CampaignError: it has another result for one of them.
        """
        with self._errors():
            self._rows.execute("BEGIN IMMEDIATE")
            try:
                for key, row in rows.items():
                    query = "SELECT row FROM episodes WHERE settings_hash = ? AND seed = ?"
                    mine = self._rows.execute(query, key).fetchone()
                    if mine is None:
                        self._rows.execute("INSERT INTO episodes VALUES (?, ?, ?)", (*key, row))
                    elif mine[0] != row:
                        raise CampaignError(_contradiction(self.path, key))
            except BaseException:
                self._rows.execute("ROLLBACK")
                raise
            self._rows.execute("COMMIT")

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
            _check(rows, self.path, version)
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
            problem = f"{error}; every earlier row is kept: when that is put right, the same run continues"
            if getattr(error, "sqlite_errorname", "") == "SQLITE_NOTADB":
                problem = STRANGER
            raise CampaignError(f"{self.path}: {problem}") from error


def gathered(folders: Iterable[Path], version: str, tasks: Iterable[Task]) -> dict[tuple[str, int], str]:
    """The rows of these tasks (JSON text) that ledgers of other folders hold, by (settings hash, seed).

    Nothing is written to the folders; runs may be at work in them.

    Args:
        folders: of other campaigns, such as shards of this one.
        version: of the program whose rows they must be.
        tasks: whose rows are wanted.

    Raises:
        CampaignError: a folder has no ledger, or one of another version, or two of them differ in a row.
    """
    wanted: dict[str, set[int]] = {}
    for task in tasks:
        wanted.setdefault(task.settings_hash, set()).add(task.seed)
    found: dict[tuple[str, int], str] = {}
    for folder in folders:
        path = folder / LEDGER
        if not path.is_file():
            raise CampaignError(f"{folder}: has no ledger to gather from ({LEDGER})")
        try:
            with _reading(path) as rows:
                _check(rows, path, version)
                for name, seeds in wanted.items():
                    for seed, row in rows.execute("SELECT seed, row FROM episodes WHERE settings_hash = ?", (name,)):
                        if seed in seeds and found.setdefault((name, seed), row) != row:
                            raise CampaignError(_contradiction(path, (name, seed)))
        except (sqlite3.Error, OSError) as error:
            stranger = getattr(error, "sqlite_errorname", "") == "SQLITE_NOTADB"
            raise CampaignError(f"{path}: {STRANGER if stranger else f'cannot be read ({error})'}") from None
    return found


@contextmanager
def _reading(path: Path) -> Iterator[sqlite3.Connection]:
    """A connection that writes nothing to the folder.

    A ledger that is in use, or was when its run was killed, has an index of its log beside it: SQLite can read through
    that without writing. Where there is none SQLite would make one, so a copy is read.
    """
    index = path.with_name(path.name + "-shm")
    with tempfile.TemporaryDirectory(prefix="shepherd-phys-") as folder:
        copy = Path(folder, path.name)
        if not index.exists():
            shutil.copyfile(path, copy)
            with suppress(FileNotFoundError):
                shutil.copyfile(f"{path}-wal", f"{copy}-wal")
        if copy.exists() and not index.exists():  # a run that began meanwhile may have torn the copy
            rows = sqlite3.connect(copy)
        else:
            rows = sqlite3.connect(f"{path.absolute().as_uri()}?mode=ro&readonly_shm=1", uri=True, timeout=10.0)
        with closing(rows):
            yield rows


def _check(rows: sqlite3.Connection, path: Path, version: str) -> None:
    """Whether these are tables of ours, made by this version.

    Raises:
        CampaignError: they are not.
    """
    mark, schema = (rows.execute(f"PRAGMA {name}").fetchone()[0] for name in ("application_id", "user_version"))
    if mark != APPLICATION_ID:
        raise CampaignError(f"{path}: {STRANGER}")
    if schema != SCHEMA:
        raise CampaignError(
            f"{path}: is a ledger of version {schema}, this program writes version {SCHEMA}; choose another folder"
        )
    theirs = rows.execute("SELECT value FROM notes WHERE name = 'version'").fetchone()
    if theirs is None or theirs[0] != version:
        raise CampaignError(
            f"{path}: holds rows of shepherd_phys {theirs and theirs[0]}, this is {version}; choose another folder"
        )


def _contradiction(path: Path, key: tuple[str, int]) -> str:
    return (
        f"{path}: holds another result for seed {key[1]} of settings {key[0][:12]} than was found elsewhere: "
        "they were made by different code or on different machines; leave one of the two out"
    )
