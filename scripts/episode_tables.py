"""Rows of ``episodes.csv``, read again: from several tables, those that are wanted, each once."""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from shepherd_phys.controllers.evaluation import LABELS, METRICS
from shepherd_phys.settings import SettingsError

VARIED = {
    "flocks": ("n_flocks", "flocks at the start"),
    "cohesion": ("cohesion", "n, neighbours in a sheep's cohesion"),
    "shepherds": ("n_shepherds", "shepherds"),
    "sheep": ("n_sheep", "sheep"),
}
"""Columns by the flags of `evaluate`, and what they are called."""
TRUTH = {"true": "1", "false": "0"}


def read_episodes(path: Path) -> list[dict[str, Any]]:
    """The rows of an episodes.csv, with numbers as numbers and truth as 1 and 0.

    Raises:
        SettingsError: it cannot be read, or is no such table.
    """
    path = path / "episodes.csv" if path.is_dir() else path
    rows = []
    try:
        with open(path, newline="", encoding="utf-8") as file:
            for cells in csv.DictReader(file):
                row: dict[str, Any] = {name: cells[name] for name in ("controller", "scenario", "settings_hash")}
                for name in (*LABELS[1:-1], "seed"):
                    row[name] = None if name == "cohesion" and cells[name] == "" else int(cells[name])
                for name in METRICS:
                    row[name] = float(TRUTH.get(cells[name], cells[name]))
                rows.append(row)
    except OSError as error:
        raise SettingsError(f"{path}: cannot be read ({error.strerror})") from None
    except (KeyError, TypeError, ValueError) as error:
        raise SettingsError(f"{path}: is no table of episodes ({type(error).__name__}: {error})") from None
    if not rows:
        raise SettingsError(f"{path}: holds no episode")
    return rows


def chosen(
    rows: Sequence[dict[str, Any]],
    numbers: Mapping[str, Sequence[int]],
    controllers: Sequence[str],
    scenario: str | None,
) -> list[dict[str, Any]]:
    """The rows that were asked for.

    Args:
        rows: of `read_episodes`.
        numbers: by the names of `VARIED`; none: all.
        controllers: these; none: all.
        scenario: this one; None: all.

    Raises:
        SettingsError: there is none, for one of the values.
    """
    wanted: dict[str, Sequence[Any]] = {label: numbers[name] for name, (label, _) in VARIED.items()}
    wanted |= {"controller": controllers, "scenario": (scenario,) if scenario else ()}
    for label, values in wanted.items():
        there = dict.fromkeys(row[label] for row in rows)
        for value in values:
            if value not in there:
                name = next((name for name, (column, _) in VARIED.items() if column == label), f"{label}s")
                raise SettingsError(f"{name}: no row has {value!r}; there are {', '.join(map(str, there))}")
        rows = [row for row in rows if not values or row[label] in values]
    return list(rows)


def once(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """The rows, those that stand in several tables once.

    Raises:
        SettingsError: two tables differ about an episode.
    """
    found: dict[tuple[Any, ...], dict[str, Any]] = {}
    for row in rows:
        key = (*(row[name] for name in LABELS), row["seed"])
        if found.setdefault(key, row) != row:
            raise SettingsError(
                f"the tables differ about {row['controller']}, seed {row['seed']}: not of one experiment"
            )
    return list(found.values())
