"""``shepherd-phys reproduce beyond`` and the like: worlds that the paper does not have, one after another."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from shepherd_phys.bodies import SHEEP, DifferentialDrive, Disc, Flyer
from shepherd_phys.campaign import write_bytes, write_csv
from shepherd_phys.controllers import CONTROLLERS
from shepherd_phys.controllers.claims import HEURISTICS
from shepherd_phys.controllers.summary import DELIVERED, paired_differences, summarise, summary_columns
from shepherd_phys.imperfections import Imperfections
from shepherd_phys.layouts import Scattered

from .command import counted
from .pages import study_page
from .points import points, table, tasks
from .studies import Reported, Result

PAPER: Mapping[str, Any] = {"scenario": "paper", "flocks": (2,), "cohesion": (40,), "shepherds": (3,)}
"""What every case has that does not say otherwise: arguments of `shepherd_phys.scripts.points.points`."""
RAM, LAMB = Disc(radius=0.2, mass=3.0, max_speed=0.9), Disc(radius=0.12, mass=0.6, max_speed=0.6)


class Study(NamedTuple):
    """Cases that are run with the same controllers on the same seeds, and shown in one table."""

    title: str
    intro: str
    cases: Mapping[str, Mapping[str, Any]]
    """What each case has otherwise than `PAPER`."""
    methods: Sequence[str]
    """Controllers, as far as they exist."""
    baseline: str | None = None
    """The one with which the others are compared, trial by trial."""


def _scattered(density: float) -> dict[str, Any]:
    return {"scenario": "scattered", "changes": {"layout": Scattered(density=density)}}


def _imperfect(**what: Any) -> dict[str, Any]:
    return {"changes": {"imperfections": Imperfections(**what)}}


STUDIES: dict[str, Study] = {
    "beyond": Study(
        "Beyond the paper's worlds",
        "Each differs in one thing from the paper's world with 2 flocks, 3 shepherds, 100 sheep, n = 40.",
        {
            "1 shepherd": {"shepherds": (1,)},
            "2 shepherds": {"shepherds": (2,)},
            "4 shepherds": {"shepherds": (4,)},
            "5 shepherds": {"shepherds": (5,)},
            "6 shepherds": {"shepherds": (6,)},
            "8 flocks": {"flocks": (8,)},
            "n = 3": {"cohesion": (3,)},
            "50 sheep": {"sheep": 50},
            "200 sheep, goal of twice the area": {"scenario": "double"},
        },
        ("occlusion", "wild", "collie"),
    ),
    "obstacles": Study(
        "Among obstacles",
        "Discs of 1 m radius that cover a part of the box, a fence with a gap before the goal, and a corridor to it, "
        "drawn anew for each trial. `wild` and `collie` never saw obstacles.",
        {
            "none": {},
            "1 % covered": _scattered(0.01),
            "2.8 % covered": _scattered(0.028),
            "5 % covered": _scattered(0.05),
            "fence": {"scenario": "fence"},
            "corridor": {"scenario": "corridor"},
        },
        (*HEURISTICS, "wild", "collie", "collie-obstacles"),
        "collie-obstacles",
    ),
    "bodies": Study(
        "Other bodies",
        "Policies and heuristics drive bodies that they were not made for: all command wanted velocities.",
        {
            "discs": {},
            "differential drives": {"body": "DifferentialDrive"},
            "unicycles": {"body": "Unicycle"},
            "polygon robots": {"body": "PolygonRobot"},
            "flyers": {"body": "Flyer"},
            "a disc, a differential drive, a flyer": {
                "changes": {"shepherds": (Disc(), DifferentialDrive(), Flyer())}, "shepherds": (),
            },
            "every third sheep a ram, every third a lamb": {"changes": {"sheep": (RAM, SHEEP, LAMB)}},
        },
        ("occlusion", "collie"),
    ),
    "sensing": Study(
        "Imperfect sensing and acting",
        "Rewards and measures see the world as it is.",
        {
            "perfect": {},
            "10 % of the beams lost": _imperfect(lost_beams=0.1),
            "30 % of the beams lost": _imperfect(lost_beams=0.3),
            "5 % range noise": _imperfect(range_noise=0.05),
            "10 % of the beams lost, 5 % range noise": _imperfect(lost_beams=0.1, range_noise=0.05),
            "scans 1 step old": _imperfect(scan_delay=1),
            "scans 5 steps old": _imperfect(scan_delay=5),
            "action noise of 0.3": _imperfect(action_noise=0.3),
            "all: 10 %, 5 %, 1 step, 0.3": _imperfect(lost_beams=0.1, range_noise=0.05, scan_delay=1, action_noise=0.3),
        },
        ("collie",),
    ),
    "boids": Study(
        "Reynolds' sheep",
        "Sheep that move by Reynolds' rules, which no policy was trained with and no heuristic was tuned on.",
        {
            counted(k, "flock"): {"flock": "Reynolds", "cohesion": (), "flocks": (k,)}
            for k in (1, 2, 5)
        },
        (*HEURISTICS, "wild", "collie"),
        "collie",
    ),
}  # fmt: skip


def roster(study: Study, controllers: Sequence[str]) -> list[str]:
    """Those asked for, or the study's as far as they exist."""
    return list(controllers or [name for name in study.methods if name in CONTROLLERS])


def run_study(name: str, folder: Path, *, controllers: Sequence[str], reported: Reported) -> Result:
    """Run what is missing of the trials, and write the table, its page and its drawing.

    Args:
        name: of `STUDIES`.
        folder: where to.
        controllers: none given: the study's.
        reported: the trials.

    Raises:
        SettingsError, ControllerError: a controller is unknown or none; or the ledger is not to be had.
        CampaignError: no worker can be started, or a file cannot be written.
    """
    from .figures import draw_cases

    study, seeds = STUDIES[name], reported.seeds()
    methods = roster(study, controllers)
    cases = {
        title: tasks(points(controllers=methods, **{**PAPER, **case}), seeds) for title, case in study.cases.items()
    }
    todo = list({task.key: task for own in cases.values() for task in own}.values())
    outcome, failures = reported.run(folder, todo)
    rows = table(todo, outcome)
    summary: list[dict[str, Any]] = []
    for title, own in cases.items():
        hashes = {task.spec.controller: task.settings_hash for task in own}
        mine = [row for row in rows if row["settings_hash"] in hashes.values()]
        apart = {}
        if study.baseline in {row["controller"] for row in mine}:
            apart = {row["controller"]: row for row in paired_differences(mine, str(study.baseline), (DELIVERED,))}
        for row in summarise(mine):
            theirs = apart.get(row["controller"])
            mean, low, high = (None if theirs is None else 0.0 - theirs[f"{DELIVERED}_diff_{of}"] for of in PARTS)
            ahead = dict(zip(AHEAD, (mean, high, low), strict=True))
            summary.append({"case": title, **row, **ahead, "settings_hash": hashes[row["controller"]]})
    summary.sort(key=lambda row: (list(study.cases).index(row["case"]), methods.index(row["controller"])))
    page = study_page(name, study.title, study.intro, study.baseline, summary)
    paths = [folder / f"{name}.{kind}" for kind in ("csv", "md", "png")]
    write_csv(paths[0], ("case", *summary_columns(), *AHEAD, "settings_hash"), summary)
    write_bytes(paths[1], page.encode())
    write_bytes(paths[2], draw_cases(summary))
    return Result({name: summary}, page, paths, failures)


PARTS = ("mean", "low", "high")
AHEAD = tuple(f"ahead_{part}" for part in PARTS)
"""Columns of how much more the study's baseline delivers, paired by trial; empty where there is none."""
