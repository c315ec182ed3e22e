"""``shepherd-phys reproduce beyond``: worlds that the paper does not have, one after another."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from shepherd_phys.campaign import write_bytes, write_csv
from shepherd_phys.controllers import CONTROLLERS
from shepherd_phys.controllers.summary import summarise, summary_columns

from .pages import beyond_page
from .points import points, table, tasks
from .studies import Reported, Result

PAPER: Mapping[str, Any] = {"scenario": "paper", "flocks": (2,), "cohesion": (40,), "shepherds": (3,)}
CASES: dict[str, Mapping[str, Any]] = {
    "1 shepherd": {"shepherds": (1,)},
    "2 shepherds": {"shepherds": (2,)},
    "4 shepherds": {"shepherds": (4,)},
    "5 shepherds": {"shepherds": (5,)},
    "6 shepherds": {"shepherds": (6,)},
    "8 flocks": {"flocks": (8,)},
    "n = 3": {"cohesion": (3,)},
    "50 sheep": {"sheep": 50},
    "200 sheep, goal of twice the area": {"scenario": "double"},
}
"""What each world has otherwise than the paper's of two flocks, three shepherds, 100 sheep and n = 40."""
METHODS = ("occlusion", "wild", "collie")
"""The best heuristic and the policies that are meant for more than the paper's worlds."""


def roster(controllers: Sequence[str]) -> list[str]:
    """Those asked for, or `METHODS` as far as they exist."""
    return list(controllers or [name for name in METHODS if name in CONTROLLERS])


def beyond(folder: Path, *, controllers: Sequence[str], reported: Reported) -> Result:
    """Run what is missing of the trials, and write the table and its page.

    Raises:
        SettingsError, ControllerError: a controller is unknown or none; or the folder is another campaign's.
        CampaignError: the ledger is not to be had, no worker can be started, or a file cannot be written.
    """
    methods = roster(controllers)
    seeds = reported.seeds()
    cases = {title: tasks(points(controllers=methods, **{**PAPER, **case}), seeds) for title, case in CASES.items()}
    todo = [task for own in cases.values() for task in own]
    outcome, failures = reported.run(folder, todo)
    rows = table(todo, outcome)
    summary: list[dict[str, Any]] = []
    for title, own in cases.items():
        hashes = {task.spec.controller: task.settings_hash for task in own}
        for row in summarise(row for row in rows if row["settings_hash"] in hashes.values()):
            summary.append({"case": title, **row, "settings_hash": hashes[row["controller"]]})
    summary.sort(key=lambda row: (list(CASES).index(row["case"]), methods.index(row["controller"])))
    page = beyond_page(summary)
    paths = [folder / "beyond.csv", folder / "beyond.md"]
    write_csv(paths[0], ("case", *summary_columns(), "settings_hash"), summary)
    write_bytes(paths[1], page.encode())
    return Result({"beyond": summary}, page, paths, failures)
