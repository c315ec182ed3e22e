"""Points of an experiment: a controller in a scenario. From names to points, tasks, episodes and tables.

What `evaluate` and `reproduce` share. It is the place where envs and controllers meet.
"""

from __future__ import annotations

import inspect
import itertools
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any

from shepherd_phys import __version__
from shepherd_phys.campaign import Outcome, Task, remove, settings_hash, write_csv, write_parquet
from shepherd_phys.controllers import CONTROLLERS, Controller, Policy, load_policy
from shepherd_phys.controllers.evaluation import (
    COLUMNS,
    LABELS,
    ControllerError,
    checked_controller,
    evaluate,
    parameters_of,
)
from shepherd_phys.controllers.summary import difference_columns, paired_differences, summarise, summary_columns
from shepherd_phys.envs.shepherding import ShepherdingEnv
from shepherd_phys.scenario import SCENARIOS, Scenario, with_neighbours
from shepherd_phys.settings import SettingsError, kind_of, meant
from shepherd_phys.workers import explain
from shepherd_phys.world import World

from .command import flag
from .own import find_kinds, find_scenario, imported, of_kinds, source_hash, try_out

SCENARIO = "paper"
"""What is played where nobody names a scenario."""
SEEN = (
    "n_sheep",
    "box",
    "goal_radius",
    "sheep",
    "shepherds",
    "flock",
    "obstacles",
    "layout",
    "control_dt",
    "imperfections",
)
"""Fields of a scenario that change what a policy meets. How many flocks, neighbours and shepherds is varied freely."""
KINDS: dict[str, type] = {
    **dict.fromkeys(COLUMNS, float),
    **dict.fromkeys(("controller", "scenario", "settings_hash", "version"), str),
    **dict.fromkeys(("n_flocks", "cohesion", "n_shepherds", "n_sheep", "seed", "collisions", "steps"), int),
    **dict.fromkeys(("reached_95", "success"), bool),
}
"""Of the columns of ``episodes.parquet``."""


@dataclass(frozen=True)
class Point:
    """A controller in a scenario, by name, so that it can be sent to a worker."""

    controller: str
    """A name of `CONTROLLERS`, a policy's .json file, or ``module:Name``."""
    scenario_name: str
    scenario: Scenario

    @property
    def labels(self) -> dict[str, Any]:
        """The columns of a row that name the point."""
        return {
            "controller": self.controller,
            "n_flocks": self.scenario.n_flocks,
            "cohesion": getattr(self.scenario.flock, "n_neighbours", None),
            "n_shepherds": self.scenario.n_shepherds,
            "n_sheep": self.scenario.n_sheep,
            "scenario": self.scenario_name,
        }

    def __str__(self) -> str:
        return ", ".join(value if name == "controller" else f"{name} {value}" for name, value in self.labels.items())

    def settings_hash(self) -> str:
        """Of all that determines a row except its seed, the source of a user's own classes included.

        Raises:
            SettingsError: the parameters that the controller or a user's own class tells are not plain data.
        """
        scenario = self.scenario
        controller = find_controller(self.controller)
        things = [controller, *scenario.sheep_kinds, scenario.flock, *scenario.shepherds, *scenario.obstacles]
        things += [scenario.layout] if scenario.layout is not None else []
        try:
            return settings_hash(
                {
                    # a policy is its checksum, wherever its file lies
                    "controller": controller.checksum if isinstance(controller, Policy) else self.controller,
                    "parameters": parameters_of(controller),
                    "scenario": scenario.to_dict(),
                    "sources": {kind_of(thing): source_hash(thing) for thing in things if ":" in kind_of(thing)},
                    "version": __version__,
                }
            )
        except SettingsError:
            raise
        except (TypeError, ValueError) as error:
            raise SettingsError(f"{self}: parameters must be plain data and finite ({error})") from None


def points(
    *,
    controllers: Sequence[str],
    scenario: str | None = None,
    flocks: Sequence[int] = (),
    cohesion: Sequence[int] = (),
    shepherds: Sequence[int] = (),
    sheep: int | None = None,
    body: str | None = None,
    flock: str | None = None,
    changes: Mapping[str, Any] | None = None,
) -> list[Point]:
    """Every combination; what is left out is the scenario's.

    Args:
        controllers: names, policy files, or ``module:Name`` of a user's own.
        scenario: a preset's name, a TOML file, or ``module:Name`` of a scenario or a function that makes one; none
            given: `SCENARIO`.
        flocks: numbers of flocks.
        cohesion: n, neighbours in the flock model's cohesion.
        shepherds: numbers of shepherds.
        sheep: N.
        body: of all shepherds, a name of `BODIES` or ``module:Name``. Those that a file describes as such a body keep
            their parameters; others become one made without arguments.
        flock: how sheep move, a name of `FLOCKS` or ``module:Name``; its parameters as for ``body``.
        changes: fields of the scenario that have other values, before all else.

    Raises:
        SettingsError: something is unknown or impossible; the message names it.
        ControllerError: an object given as controller is none.
    """
    scenario = scenario or SCENARIO
    for name in controllers:
        find_controller(name)
    kinds = find_kinds(body, flock)
    base = find_scenario(scenario, kinds.values()).but(**(changes or {}))
    if sheep is not None:
        # with the number of flocks, which is checked against it
        base = base.but(n_sheep=sheep, n_flocks=min(base.n_flocks, sheep) if flocks else base.n_flocks)
    base, default = of_kinds(base, kinds)
    shown = Path(scenario).name
    found = []
    lists = [dict.fromkeys(values) or [None] for values in (flocks, cohesion, shepherds)]  # nothing twice
    for name, n_flocks, n_neighbours, n_shepherds in itertools.product(dict.fromkeys(controllers), *lists):
        varied: dict[str, Any] = {}
        if n_flocks is not None:
            varied["n_flocks"] = n_flocks
        if n_shepherds is not None:
            varied["shepherds"] = _team(base, n_shepherds, default)
        own = base if n_neighbours is None else with_neighbours(base, n_neighbours)
        found.append(Point(name, shown, own.but(**varied)))
    return found


LEAST = {"flocks": 1, "cohesion": 1, "shepherds": 0, "sheep": 1}
"""Of the numbers of `WorldFlags`."""


@dataclass(frozen=True)
class WorldFlags:
    """The flags of a command that plays in one world, with evaluate's names."""

    flocks: Annotated[int | None, flag("K", "the scenario's")] = None
    """Number of flocks."""
    cohesion: Annotated[int | None, flag("N", "the scenario's")] = None
    """Number of neighbours that attract a sheep."""
    shepherds: Annotated[int | None, flag("M", "the scenario's")] = None
    """Number of shepherds."""
    sheep: Annotated[int | None, flag("N", "the scenario's")] = None
    """Number of sheep."""
    scenario: Annotated[str | None, flag("NAME|FILE|module:Name", SCENARIO)] = None
    """A preset's name, a TOML file, or module:Name of a scenario of your own."""
    body: Annotated[str | None, flag("NAME|module:Name", "the scenario's")] = None
    """Body of every shepherd."""
    flock: Annotated[str | None, flag("NAME|module:Name", "the scenario's")] = None
    """Flock model."""

    def point(self, controller: str) -> Point:
        """A controller in this world.

        Raises:
            SettingsError: something is unknown or impossible.
            ControllerError: an object given as controller is none.
        """
        numbers = {"flocks": self.flocks, "cohesion": self.cohesion, "shepherds": self.shepherds}
        lists: dict[str, Any] = {name: () if value is None else (value,) for name, value in numbers.items()}
        (point,) = points(
            controllers=[controller],
            scenario=self.scenario,
            sheep=self.sheep,
            body=self.body,
            flock=self.flock,
            **lists,
        )
        return point


def strangers(points: Iterable[Point]) -> list[str]:
    """Of each policy from a file that was trained in another scenario than it shall play in, a line that says so.

    What flags have made other than in `SCENARIO` was meant to be so.
    """
    lines: dict[str, str] = {}
    usual = SCENARIOS[SCENARIO]
    points = [point for point in points if point.controller.endswith(".json")]
    learned_in = {path: load_policy(path).spec.scenario for path in {point.controller for point in points}}
    for point in points:
        trained = learned_in[point.controller]
        told = [
            _told(trained, name)
            for name in SEEN
            if _seen(trained, name) != _seen(point.scenario, name) == _seen(usual, name)
        ]
        if told and point.controller not in lines:
            lines[point.controller] = (
                f"{point.controller} was trained in another scenario ({', '.join(told)}); this is "
                f"{point.scenario_name}: --scenario names another, --body and --flock other bodies and flocks"
            )
    return list(lines.values())


def _seen(scenario: Scenario, name: str) -> Any:
    """What of a field counts: of bodies and flock model their kinds, which --body, --flock and --cohesion vary."""
    value = getattr(scenario, name)
    if name == "sheep":
        return {kind_of(body) for body in scenario.sheep_kinds}
    if name == "shepherds":
        return {kind_of(body) for body in value}
    return kind_of(value) if name == "flock" else value


def _told(scenario: Scenario, name: str) -> str:
    value, seen = getattr(scenario, name), _seen(scenario, name)
    if name == "n_sheep":
        return f"{value} sheep"
    if isinstance(seen, set):
        return f"{name} {', '.join(sorted(seen))}"
    if name == "layout" and value is not None:
        count, density = getattr(value, "count", None), getattr(value, "density", None)
        number = f"count={count}" if count is not None else f"density={density:g}" if density is not None else ""
        return f"{kind_of(value)}({number})"
    if name in ("obstacles", "layout", "imperfections"):
        return f"{'no' if not value else len(value) if name == 'obstacles' else 'some'} {name}"
    return f"{name} {seen}"


def tasks(points: Iterable[Point], seeds: Sequence[int]) -> list[Task]:
    """One task a point and seed, seed by seed, so that an unfinished campaign knows something about every point.

    Raises:
        SettingsError: an env cannot be made for a point.
    """
    hashed = []
    for point in points:
        ShepherdingEnv(point.scenario, rewards={}, lidar=find_controller(point.controller).lidar).close()
        hashed.append((point.settings_hash(), point))
    return [Task(name, seed, point, str(point)) for seed in seeds for name, point in hashed]


def place(point: Point, seeds: Sequence[int]) -> None:
    """Place a point's world on one of the seeds, and make a step: what it holds may be a user's own.

    Raises:
        SettingsError: it cannot be placed on any, or not make a step.
    """
    try_out(World(point.scenario), seeds)


def episode(point: Point, seed: int) -> dict[str, Any]:
    """Run one episode of a point: the work of a campaign."""
    row = evaluate(find_controller(point.controller), partial(ShepherdingEnv, point.scenario), [seed])[0]
    del row["controller"]  # the point has the name by which it was asked for
    return row


def table(tasks: Sequence[Task], outcome: Outcome) -> list[dict[str, Any]]:
    """The rows of ``episodes.csv`` for the tasks that have one, sorted by point and seed."""
    rows = [
        {**task.spec.labels, **row, "seed": task.seed, "settings_hash": task.settings_hash, "version": __version__}
        for task, row in zip(tasks, outcome.rows, strict=True)
        if row is not None
    ]
    return sorted(rows, key=lambda row: tuple(_sortable(row[name]) for name in COLUMNS))


def write_tables(
    folder: Path, rows: Sequence[dict[str, Any]], baseline: str | None = None
) -> tuple[list[dict[str, Any]], list[Path]]:
    """Write ``episodes.csv``, with polars ``episodes.parquet``, ``summary.csv``, and ``differences.csv``.

    A table that earlier rows left there and that is not written now is removed.

    Args:
        folder: where to.
        rows: of `table`.
        baseline: the controller with which the others are compared; without one there are no differences.

    Returns:
        the summary's rows, each with its ``differences`` from the baseline (None where there are none), and the paths.

    Raises:
        CampaignError: a file cannot be written.
    """
    summary = summarise(rows)
    paired = baseline is not None and any(row["controller"] == baseline for row in rows)
    differences = paired_differences(rows, baseline) if baseline is not None and paired else []
    told = {_labels(row): {name: row[name] for name in row if name not in LABELS} for row in differences}
    write_csv(folder / "episodes.csv", COLUMNS, rows)
    write_csv(folder / "summary.csv", summary_columns(), summary)
    if baseline is not None:
        write_csv(folder / "differences.csv", difference_columns(), differences)
    written = {
        "episodes.csv": True,
        "episodes.parquet": write_parquet(folder / "episodes.parquet", KINDS, rows),
        "summary.csv": True,
        "differences.csv": baseline is not None,
    }
    remove(folder / name for name, is_new in written.items() if not is_new)
    paths = [folder / name for name, is_new in written.items() if is_new]
    return [{**row, "differences": told.get(_labels(row))} for row in summary], paths


def find_controller(name: str) -> Controller:
    """A fresh controller by its name, from a policy file NAME.json, or ``module:Name``.

    Raises:
        SettingsError: there is none of this name.
        ControllerError: the object is no controller.
    """
    if name.endswith(".json"):
        return load_policy(name)
    if ":" in name:
        own = imported(name, "controllers")
        if inspect.isroutine(own):  # a function that makes one
            try:
                own = own()
            except TypeError as error:
                raise ControllerError(f"controllers: {name}: cannot be called without arguments ({error})") from None
            except Exception as error:
                raise ControllerError(f"controllers: {name}: cannot be made: {explain(error)}") from None
        return checked_controller(own)
    if name not in CONTROLLERS:
        raise SettingsError(
            f"controllers: {name!r} is unknown; there are {', '.join(sorted(CONTROLLERS))}, a policy's .json file, "
            f"or module:Name of your own{meant(name, CONTROLLERS)}"
        )
    return CONTROLLERS[name]()


def _team(scenario: Scenario, n: int, default: Any) -> tuple[Any, ...]:
    """``n`` shepherds of the kind that the scenario has, ``default`` where it has none."""
    bodies = scenario.shepherds
    scenario.but(shepherds=n)  # refuses an impossible number
    if n and any(body != bodies[0] for body in bodies):
        raise SettingsError(f"shepherds: the scenario's bodies differ, so {n} of them says too little; give a body")
    return (bodies[:1] or (default,)) * n


def _sortable(value: Any) -> tuple[int, Any]:
    return (0, 0) if value is None else (1, value)


def _labels(row: Mapping[str, Any]) -> tuple[Any, ...]:
    return tuple(row[name] for name in LABELS)
