"""`Scenario`: what a world holds, how it is placed and how it is stepped; presets; TOML in and out."""

from __future__ import annotations

import dataclasses
import math
import numbers
from collections.abc import Iterable, Mapping
from functools import partial
from pathlib import Path
from typing import Annotated, Any

from pydantic import BeforeValidator, Field

from shepherd_phys.avoidance import Avoidance
from shepherd_phys.bodies import BODIES, SHEEP, Body, Disc, built, flies
from shepherd_phys.flock import FLOCKS, FlockModel, Strombom
from shepherd_phys.imperfections import Imperfections
from shepherd_phys.layouts import LAYOUTS, Corridor, Fenced, Lattice, Layout, Scattered
from shepherd_phys.lidar import CHANNELS, Channel
from shepherd_phys.obstacles import OBSTACLES, Obstacle
from shepherd_phys.settings import (
    Foreign,
    Settings,
    SettingsError,
    handed_over,
    kind_of,
    listed,
    meant,
    read_toml,
    settings,
    tagged,
    untagged,
    write_toml,
)

SUCCESS_FRACTION = 0.95
"""An episode succeeds with this fraction of the sheep in the goal."""
OPEN_SUBSTEPS = 2
"""In a control step of an open world: with one, driven sheep run right through one another (measured)."""
GOAL_KEEP_OUT, BODY_KEEP_OUT = 2.0, 0.5
"""[m]"""
OBSTACLE_SUBSTEPS = 3
"""The same among obstacles: with two, a shepherd squeezes one sheep in a hundred through a thin wall (measured)."""
PRESSED_SUBSTEPS = 5
"""The same where a shepherd presses harder than the default one: heavier beside the sheep, or faster (measured)."""
PRESSING = 5.0, 1.5
"""The default shepherd's mass over the default sheep's [1], and its top speed [m/s]."""
PRESET_FIELDS = frozenset({"scenario", "ppo", "reward", "budget"})
"""What a file of training settings holds and no scenario has: the two are easily mistaken."""


def _team(value: Any) -> Any:
    """A number of shepherds means that many default discs."""
    if isinstance(value, numbers.Integral) and not isinstance(value, bool):
        if not 0 <= int(value) <= 10_000:
            raise ValueError("a number of shepherds lies in 0..10000")
        return (Disc(),) * int(value)
    if isinstance(value, list | tuple):
        return tuple(value)
    raise ValueError("give bodies, or how many default discs there are")


def _interval(value: Any) -> Any:
    """Two numbers, the smaller first."""
    pair = isinstance(value, list | tuple) and len(value) == 2 and all(isinstance(v, numbers.Real) for v in value)
    if pair and value[0] > value[1]:
        raise ValueError("the smaller number comes first")
    return value


def _sheep_kinds(value: Any) -> Any:
    """One body, or several."""
    if isinstance(value, list | tuple):
        if not value:
            raise ValueError("give a body, or several that the sheep have in turn")
        return tuple(value)
    return value


@settings
class Scenario(Settings):
    """What a world holds, how it is placed at reset, and its two clocks.

    All defaults are the paper's world, with the resolutions of what it leaves open.
    """

    n_sheep: int = Field(default=100, ge=1)
    """N."""
    n_flocks: int = Field(default=2, ge=1)
    """Flocks at the start, of equal size (+-1) where ``flock_sizes`` does not say otherwise."""
    flock_sizes: Annotated[tuple[Annotated[int, Field(ge=1)], ...], BeforeValidator(listed)] | None = None
    """Sheep in each flock at the start; none given: equal sizes."""
    flock_distance: Annotated[
        tuple[Annotated[float, Field(ge=0)], Annotated[float, Field(ge=0)]], BeforeValidator(_interval)
    ] = (10.0, 20.0)
    """Least and largest distance of a flock's centre from the goal's centre, drawn uniformly [m]."""
    flock_spread: float | None = Field(default=None, ge=0, le=math.pi)
    """All flocks' centres lie within this angle of one drawn direction from the goal [rad]; none: anywhere."""
    flock_sd: float = Field(default=1.0, gt=0)
    """Standard deviation of a flock's members about its centre, each axis [m]."""
    box: float = Field(default=50.0, gt=0)
    """Side of the square, centred on the origin, in which goal and shepherds are placed [m]; the plane is unbounded."""
    goal_radius: float = Field(default=2.5, gt=0)
    """R [m]."""
    goal_pos: tuple[float, float] | None = None
    """Centre g of the goal [m]; drawn uniformly from the box where None."""
    shepherds: Annotated[Any, BeforeValidator(_team)] = (Disc(), Disc(), Disc())
    """A tuple with one body a shepherd; given a number, that many default discs."""
    sheep: Annotated[Any, BeforeValidator(_sheep_kinds)] = SHEEP
    """The sheep's body; a tuple: several, which the sheep have in turn, the first sheep the first one."""
    flock: Any = Strombom()
    """How sheep move: a flock model, or a function like its ``velocities``."""
    obstacles: tuple[Any, ...] = ()
    """Solid, static things, the same in every episode."""
    layout: Any = None
    """Draws further obstacles anew at each reset, from a random stream of its own: a `Layout`, or none."""
    goal_keep_out: float = Field(default=GOAL_KEEP_OUT, ge=0)
    """Obstacles keep this far from the border of a goal that is drawn, those of a layout from any goal's [m]."""
    body_keep_out: float = Field(default=BODY_KEEP_OUT, ge=0)
    """Every body starts at least this far from any obstacle [m]."""
    imperfections: Imperfections | None = None
    """What goes wrong with the shepherds' sensors and drives; none given: nothing."""
    n_steps: int = Field(default=1000, ge=1)
    """T: control steps of an episode; the nominal length in every formula."""
    control_dt: float = Field(default=0.2, gt=0)
    """Length of a control step [s]."""
    substeps: int | None = Field(default=None, ge=1)
    """Engine steps in a control step; none given: `OPEN_SUBSTEPS`, where there are obstacles `OBSTACLE_SUBSTEPS`, or
    `PRESSED_SUBSTEPS` if a shepherd weighs more than five times a sheep or walks faster than 1.5 m/s."""
    iterations: int = Field(default=4, ge=1)
    """Iterations of the engine's contact solver in an engine step."""
    collision_slop: float = Field(default=0.005, ge=0)
    """Overlap that the engine lets resting bodies keep [m]."""
    max_acceleration: float = Field(default=30.0, gt=0)
    """Servo forces are clipped to mass times this [m/s2], so that contacts and walls win."""
    max_angular_acceleration: float = Field(default=60.0, gt=0)
    """The same for turning [rad/s2]."""
    terminate_on_success: bool = False
    """End the episode when 95 % of the sheep have been in the goal for 5 s on end."""

    def __post_init__(self) -> None:
        if not (self.layout is None or callable(self.layout) or isinstance(self.layout, Foreign)):
            raise ValueError(f"layout: needs a layout that can be called, or None (given: {self.layout!r})")
        if self.n_flocks > self.n_sheep:
            raise ValueError(f"n_flocks is {self.n_flocks}, more than there are sheep ({self.n_sheep})")
        if self.flock_sizes is not None and (len(self.flock_sizes), sum(self.flock_sizes)) != (
            self.n_flocks,
            self.n_sheep,
        ):
            raise ValueError(
                f"flock_sizes: needs {self.n_flocks} sizes, one a flock, that add up to the {self.n_sheep} sheep "
                f"(given: {self.flock_sizes})"
            )

    @property
    def n_shepherds(self) -> int:
        """P."""
        return len(self.shepherds)

    @property
    def sheep_kinds(self) -> tuple[Any, ...]:
        """The bodies that the sheep have in turn."""
        return self.sheep if isinstance(self.sheep, tuple) else (self.sheep,)

    @property
    def sheep_bodies(self) -> tuple[Any, ...]:
        """(N,) each sheep's body."""
        kinds = self.sheep_kinds
        return (kinds * (self.n_sheep // len(kinds) + 1))[: self.n_sheep]

    @property
    def has_obstacles(self) -> bool:
        """Whether its worlds can have obstacles, whatever is drawn."""
        return bool(self.obstacles) or self.layout is not None

    @property
    def channels(self) -> tuple[Channel, ...]:
        """What shepherds observe here unless somebody says otherwise: obstacles where there are some."""
        return CHANNELS if self.has_obstacles else CHANNELS[:3]

    @property
    def n_substeps(self) -> int:
        """Engine steps in a control step."""
        if self.substeps or not self.has_obstacles:
            return self.substeps or OPEN_SUBSTEPS
        lightest = min(built(body, "sheep")[0].mass for body in self.sheep_kinds)
        hard = any(
            built(body, f"shepherd {k}")[0].mass > PRESSING[0] * lightest or body.max_speed > PRESSING[1]
            for k, body in enumerate(self.shepherds)
            if not flies(body)
        )
        return PRESSED_SUBSTEPS if hard else OBSTACLE_SUBSTEPS

    @property
    def physics_dt(self) -> float:
        """Length of an engine step [s]."""
        return self.control_dt / self.n_substeps

    def to_dict(self) -> dict[str, Any]:
        """Plain data from which `from_dict` makes an equal scenario."""
        table = Settings.to_dict(self)
        table["shepherds"] = [tagged(body) for body in self.shepherds]
        table["sheep"] = [tagged(body) for body in self.sheep] if isinstance(self.sheep, tuple) else tagged(self.sheep)
        table["flock"] = tagged(self.flock)
        table["obstacles"] = [tagged(obstacle) for obstacle in self.obstacles]
        if self.layout is not None:
            table["layout"] = tagged(self.layout)
        if not self.has_obstacles:
            # an open world is written as it was before there were obstacles to feel: results are known by this table
            for part, name, usual in (
                (table, "goal_keep_out", GOAL_KEEP_OUT),
                (table, "body_keep_out", BODY_KEEP_OUT),
                (table["flock"], "avoidance", Avoidance().to_dict()),
            ):
                if part.get(name) == usual:
                    del part[name]
        return table

    @classmethod
    def from_dict(cls, table: Mapping[str, Any], classes: Iterable[Any] = ()) -> Scenario:
        """The scenario that plain data describe; fields left out keep their defaults.

        Args:
            table: what `to_dict` gives, or parts of it.
            classes: a user's own classes of bodies, flock models, obstacles and layouts; nothing is ever imported by
                name.

        Raises:
            SettingsError: a field is unknown or impossible.
        """
        values = dict(table)
        own = handed_over(classes)
        if isinstance(values.get("shepherds"), list):
            values["shepherds"] = tuple(
                untagged(body, BODIES | own, f"Scenario.shepherds[{i}]") for i, body in enumerate(values["shepherds"])
            )
        if isinstance(values.get("sheep"), list):
            values["sheep"] = tuple(
                untagged(body, BODIES | own, f"Scenario.sheep[{i}]") for i, body in enumerate(values["sheep"])
            )
        elif "sheep" in values:
            values["sheep"] = untagged(values["sheep"], BODIES | own, "Scenario.sheep")
        if "flock" in values:
            values["flock"] = untagged(values["flock"], FLOCKS | own, "Scenario.flock")
        if isinstance(values.get("imperfections"), Mapping):
            values["imperfections"] = Imperfections(**values["imperfections"])
        if "obstacles" in values:
            if not isinstance(values["obstacles"], list):
                raise SettingsError(f"Scenario.obstacles: must be a list of tables (given: {values['obstacles']!r})")
            values["obstacles"] = tuple(
                untagged(thing, OBSTACLES | own, f"Scenario.obstacles[{i}]")
                for i, thing in enumerate(values["obstacles"])
            )
        if "layout" in values:
            values["layout"] = untagged(values["layout"], LAYOUTS | own, "Scenario.layout")
        return cls(**values)

    def to_toml(self, path: str | Path) -> None:
        """Write the scenario as a TOML file."""
        write_toml(self.to_dict(), path)

    @classmethod
    def from_toml(cls, path: str | Path, classes: Iterable[Any] = ()) -> Scenario:
        """Read a scenario from a TOML file; see `from_dict`. Errors name the file."""
        table = read_toml(path)
        if not PRESET_FIELDS.isdisjoint(table):
            raise SettingsError(f"{path}: is a training preset; its scenario is the table [scenario]")
        try:
            return cls.from_dict(table, classes)
        except SettingsError as error:
            raise SettingsError(f"{path}: {error}") from None


SCENARIOS: dict[str, Scenario] = {
    "paper": Scenario(),
    "single": Scenario(n_flocks=1),
    "double": Scenario(n_sheep=200, goal_radius=2.5 * math.sqrt(2.0)),
    "small": Scenario(n_sheep=20, n_flocks=2, shepherds=2, flock=Strombom(n_neighbours=8), n_steps=500),
    "fence": Scenario(layout=Fenced(), flock_spread=math.pi / 6, flock_distance=(14.0, 20.0)),
    "corridor": Scenario(layout=Corridor(), flock_spread=math.pi / 6, flock_distance=(14.0, 20.0)),
    "lattice": Scenario(layout=Lattice()),
    "scattered": Scenario(layout=Scattered(density=0.01)),
}
"""Presets by name: the paper's world; one flock; twice the sheep with a goal of twice the area; a small one for quick
looks; and the paper's world with obstacles, drawn anew for each episode."""


def load_scenario(name_or_path: str | Path, classes: Iterable[Any] = ()) -> Scenario:
    """A preset by its name, or a scenario from a TOML file.

    Raises:
        SettingsError: it is neither, or the file is not a scenario.
    """
    if str(name_or_path) in SCENARIOS:
        return SCENARIOS[str(name_or_path)]
    if str(name_or_path).endswith(".toml"):
        return Scenario.from_toml(name_or_path, classes)
    raise SettingsError(
        f"scenario: {str(name_or_path)!r} is neither a .toml file nor one of {', '.join(SCENARIOS)}"
        f"{meant(str(name_or_path), SCENARIOS)}"
    )


def with_neighbours(scenario: Scenario, n: int) -> Scenario:
    """The scenario whose flock model, the library's or a user's own dataclass, has so many neighbours n.

    Raises:
        SettingsError: it has no ``n_neighbours``.
    """
    flock = scenario.flock
    if not hasattr(flock, "n_neighbours"):
        raise SettingsError(f"cohesion: the flock model {kind_of(flock)} has no n_neighbours to set (given: {n})")
    changed = flock.but if hasattr(flock, "but") else partial(dataclasses.replace, flock)
    return scenario.but(flock=changed(n_neighbours=n))


__all__ = ["SCENARIOS", "Body", "FlockModel", "Layout", "Obstacle", "Scenario", "load_scenario", "with_neighbours"]
