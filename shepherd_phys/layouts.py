"""Layouts: obstacles drawn anew at each reset.

A layout is called with a generator and a `Site` and gives the obstacles of an episode. A user adds one by writing a
function or a class of this form; a class that is a dataclass can be written to a file with its parameters.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Annotated, Any, Literal, Protocol, runtime_checkable

import numpy as np
import pymunk
from numpy.typing import NDArray
from pydantic import BeforeValidator, Field

from shepherd_phys.geometry import CLEARANCE, surfaces
from shepherd_phys.obstacles import MIN_THICKNESS, Box, Fence, Obstacle, Pillar, Point, Polygon, Wall, solid
from shepherd_phys.placement import PlacementError, relax
from shepherd_phys.settings import Settings, SettingsError, kind_of, settings

Floats = NDArray[np.float64]

MISSES = 200
"""Places tried in vain after which there is no room for a further obstacle."""
DRAWS = 3
"""Arrangements begun anew after which obstacles that found no room are an error."""
UNEVEN = 0.6
"""How unevenly the corners of a random polygon are spread: with this it stays thicker than 0.6 of its disc's radius."""
PASSAGE = 0.5
"""[m]. The teams' own clearance: between obstacles that are further apart than twice this, shepherds find a way."""


class Site:
    """Where a layout builds: the goal and all bodies are there already.

    It takes obstacles that leave everything else as it should be. That includes ways: between obstacles a disc of
    radius ``passage`` or less gets everywhere where it fits, so nobody is ever locked in or out.

    Attributes:
        box: side of the square, centred on the origin [m].
        goal_pos: (2,) [m].
        goal_radius: [m].
        direction: from the goal in which the flocks are, where the scenario draws one (``flock_spread``) [rad].
        body_pos: (M, 2) centres of all sheep and shepherds [m].
        body_radius: (M,) [m].
        goal_keep_out: least distance of an obstacle from the goal's border [m].
        body_keep_out: least distance of an obstacle from a body [m].
        fixed: obstacles of the scenario, which are there in every episode.
        passage: [m], no less than any body's radius.
        taken: the obstacles that were taken, in their order.
    """

    def __init__(
        self,
        *,
        box: float,
        goal_pos: Floats,
        goal_radius: float,
        direction: float | None,
        body_pos: Floats,
        body_radius: Floats,
        goal_keep_out: float,
        body_keep_out: float,
        fixed: Iterable[Obstacle] = (),
    ) -> None:
        self.box, self.goal_pos, self.goal_radius, self.direction = box, goal_pos, goal_radius, direction
        self.body_pos, self.body_radius = body_pos, body_radius
        self.passage = max(PASSAGE, float(body_radius.max(initial=0.0)) + 0.01)
        self.goal_keep_out, self.body_keep_out = goal_keep_out, body_keep_out
        self.fixed = tuple(fixed)
        self._keep_out = np.concatenate([[goal_radius + goal_keep_out], body_radius + body_keep_out])
        self._points = np.concatenate([np.reshape(goal_pos, (1, 2)), body_pos])
        self.clear()

    def clear(self) -> None:
        """Give back all that was taken."""
        self.taken: list[Obstacle] = []
        self._space = pymunk.Space()  # nothing moves in it
        self._cluster: dict[pymunk.Shape, int] = {}
        for obstacle in self.fixed:
            self._add(obstacle, merge=True)

    def take(self, obstacle: Obstacle, *, bodies_yield: bool = False) -> bool:
        """Take an obstacle unless it is in the way; whether it was taken.

        It is refused if it comes nearer to the goal's border than ``goal_keep_out`` or to a body than
        ``body_keep_out``, if it overlaps another obstacle, or if it could close off a pocket with others. What its own
        shapes enclose is not looked at.

        Args:
            obstacle: what to take.
            bodies_yield: it may stand where bodies are: they are moved aside afterwards.

        Raises:
            SettingsError: it is no obstacle.
        """
        n = 1 if bodies_yield else len(self._points)
        distance, _ = surfaces((obstacle,)).static_distances(self._points[:n])
        if (distance.min(axis=1) < self._keep_out[:n]).any() or not self._add(obstacle, merge=False):
            return False
        self.taken.append(obstacle)
        return True

    def _add(self, obstacle: Obstacle, *, merge: bool) -> bool:
        """Add an obstacle; whether it may be added, which it always may to ``merge`` what it is near to.

        Convex shapes so near to each other that a disc of radius ``passage`` does not fit between them form a cluster.
        Only a ring of such shapes closes off a pocket. There is none if no new obstacle comes near to two shapes of the
        same cluster: then clusters, as graphs of who is near to whom, stay trees.
        """
        shapes = solid(obstacle, len(self.taken), self._space.static_body)
        near: list[int] = []
        for shape in shapes:
            box, reach = shape.cache_bb(), 2 * self.passage
            around = pymunk.BB(box.left - reach, box.bottom - reach, box.right + reach, box.top + reach)
            for other in self._space.bb_query(around, pymunk.ShapeFilter()):
                gap = _gap(shape, other)
                if gap < 0 and not merge:
                    return False
                if gap < reach:
                    near.append(self._cluster[other])
        if not merge and len(set(near)) < len(near):
            return False
        own = len(self._cluster)  # no cluster has had this number
        for shape, cluster in self._cluster.items():
            if cluster in near:
                self._cluster[shape] = own
        self._cluster.update(dict.fromkeys(shapes, own))
        self._space.add(*shapes)
        return True


def _gap(a: pymunk.Shape, b: pymunk.Shape) -> float:
    """Distance between two convex shapes that stand still, below 0 where they overlap [m].

    It is that of a corner from the other shape, unless edges cross. (The engine's own test for overlap is not to be had
    for this: it does not see that two segments touch end to end.)
    """
    least = math.inf
    for one, other in ((a, b), (b, a)):
        corners = _corners(one)
        least = min(least, *(other.point_query(corner).distance - one.radius for corner in corners))
        for i in range(1 if len(corners) == 2 else len(corners)):
            if len(corners) > 1 and other.segment_query(corners[i - 1], corners[i]) is not None:
                return -1.0
    return least


def _corners(shape: pymunk.Shape) -> list[pymunk.Vec2d]:
    if isinstance(shape, pymunk.Circle):
        return [shape.offset]
    if isinstance(shape, pymunk.Segment):
        return [shape.a, shape.b]
    return list(shape.get_vertices())


@runtime_checkable
class Layout(Protocol):
    """Draws the obstacles of an episode."""

    def __call__(self, rng: np.random.Generator, site: Site) -> Iterable[Obstacle]:
        """The obstacles, besides the scenario's fixed ones.

        Args:
            rng: the layout's own stream of random numbers.
            site: what is there already. ``site.take(obstacle)`` says whether there is room for one; in the end
                ``site.taken`` holds those that found some. Obstacles that were not asked for must keep clear of the
                goal; bodies that they touch are moved aside.
        """
        ...


def laid_out(layout: Layout, rng: np.random.Generator, site: Site) -> tuple[tuple[Obstacle, ...], Floats]:
    """Let a layout draw, and move the bodies clear of what it drew.

    Returns:
        the obstacles, and where the bodies are then (M, 2) [m].

    Raises:
        SettingsError: what it gave are not obstacles.
        PlacementError: an obstacle is too near to the goal, or bodies find no place.
    """
    name = f"layout ({kind_of(layout)})"
    tries = 0
    while True:
        site.clear()
        answer = layout(rng, site)
        try:
            drawn = tuple(answer)
        except TypeError:
            raise SettingsError(f"{name}: needs to give obstacles (given: {answer!r})") from None
        try:
            shapes = surfaces(drawn)
        except SettingsError as error:
            raise SettingsError(f"{name} drew {error}") from None
        gap = shapes.static_distances(site.goal_pos[None])[0].min(initial=math.inf) - site.goal_radius
        if gap < site.goal_keep_out - CLEARANCE:
            raise PlacementError(
                f"{name}: an obstacle is {gap:.3g} m from the goal's border; at least {site.goal_keep_out:g} m are "
                "allowed (goal_keep_out)"
            )
        solids = (*site.fixed, *drawn)
        try:
            return drawn, relax(site.body_pos, site.body_radius, push_out=surfaces(solids).clear_by(site.body_keep_out))
        except PlacementError:
            tries += 1
            if tries == DRAWS:
                raise


Kind = Literal["Pillar", "Wall", "Box", "Polygon"]


@settings
class Scattered(Settings):
    """Obstacles of one size in places drawn uniformly from the box: so many of them, or so much of its area.

    They lie within the box, overlap nothing and close off no pocket (`Site`).
    """

    count: int | None = Field(default=None, ge=0, le=10_000)
    """How many."""
    density: float | None = Field(default=None, ge=0, le=0.5)
    """Instead: covered area over the area of the box [1], to the nearest whole obstacle."""
    radius: float = Field(default=1.0, ge=2 * MIN_THICKNESS)
    """Of the disc that holds one [m]: a pillar is that disc, a wall its diameter with the default thickness, a box is a
    square and a polygon has 3 to 6 corners at random on its edge; all but pillars are turned at random."""
    kinds: Annotated[
        tuple[Kind, ...], Field(min_length=1), BeforeValidator(lambda v: tuple(v) if isinstance(v, list) else v)
    ] = ("Pillar",)
    """What is drawn, each with the same probability."""

    def __post_init__(self) -> None:
        if (self.count is None) == (self.density is None):
            raise ValueError(
                f"give count or density, one of the two (given: count {self.count}, density {self.density})"
            )

    def __call__(self, rng: np.random.Generator, site: Site) -> list[Obstacle]:
        """Draw.

        Raises:
            PlacementError: there is no room for so many.
        """
        most = 0.0
        for _ in range(DRAWS):
            site.clear()
            found = self._fill(rng, site)
            if found is None:
                return site.taken
            most = max(most, found)
        if self.count is None:
            field, given, best = "density", f"{self.density:g}", f"{most:.3g}"
        else:
            field, given, best = "count", f"{self.count}", f"{most:.0f}"
        raise PlacementError(
            f"Scattered.{field}: {given} is impossible: beside goal and bodies, obstacles of radius {self.radius:g} m "
            f"in a box of {site.box:g} m reached {best}; at most about that is allowed"
        )

    def _fill(self, rng: np.random.Generator, site: Site) -> float | None:
        """Fill the site; None, or how many (or which part of the box) found room where not all did."""
        ground = pymunk.Body(body_type=pymunk.Body.STATIC)
        covered = 0.0
        while self.count is None or len(site.taken) < self.count:
            kind = self.kinds[
                int(rng.integers(len(self.kinds)))
            ]  # kept until it has found room, or large ones get rare
            for _ in range(MISSES):
                obstacle = self._made(kind, rng, site.box)
                area = sum(shape.area for shape in obstacle.shapes(ground))
                if self.density is not None and covered + area / 2 > self.density * site.box**2:
                    return None
                if site.take(obstacle):
                    covered += area
                    break
            else:
                return covered / site.box**2 if self.count is None else len(site.taken)
        return None

    def _made(self, kind: Kind, rng: np.random.Generator, box: float) -> Obstacle:
        """One of a kind, wherever it falls in the box."""
        r = self.radius
        x, y = ((max(box - 2 * r, 0.0)) * (rng.random(2) - 0.5)).tolist()
        if kind == "Pillar":
            return Pillar((x, y), r)
        turn = 2 * math.pi * rng.random()
        if kind == "Box":
            return Box((x, y), (r * math.sqrt(2), r * math.sqrt(2)), turn)
        if kind == "Wall":
            half = r - MIN_THICKNESS / 2
            dx, dy = half * math.cos(turn), half * math.sin(turn)
            return Wall((x - dx, y - dy), (x + dx, y + dy))
        n = int(rng.integers(3, 7))
        bearings = turn + 2 * np.pi * (np.arange(n) + UNEVEN * rng.random(n)) / n
        corners = np.column_stack([x + r * np.cos(bearings), y + r * np.sin(bearings)])
        return Polygon(tuple((float(u), float(v)) for u, v in corners))


@settings
class Lattice(Settings):
    """Pillars on a square grid all over the box; where it begins is drawn. Bodies yield to them, the goal does not."""

    spacing: float = Field(default=5.0, gt=0)
    """From pillar to pillar [m]."""
    radius: float = Field(default=0.5, ge=MIN_THICKNESS / 2)
    """[m]"""

    def __post_init__(self) -> None:
        if self.spacing < 2 * (self.radius + PASSAGE):
            raise ValueError(
                f"spacing: {self.spacing:g} m leaves no way between pillars of radius {self.radius:g} m; "
                f"at least {2 * (self.radius + PASSAGE):g} m is allowed"
            )

    def __call__(self, rng: np.random.Generator, site: Site) -> list[Obstacle]:
        """Draw."""
        half = site.box / 2
        columns, rows = (np.arange(-half + self.spacing * float(u), half, self.spacing) for u in rng.random(2))
        for x in columns.tolist():
            for y in rows.tolist():
                site.take(Pillar((x, y), self.radius), bodies_yield=True)
        return site.taken


@settings
class Fenced(Settings):
    """A fence between the goal and the flocks, across the direction in which they are; where its gap is, is drawn."""

    length: float = Field(default=30.0, gt=0)
    """Of the fence, its middle straight before the goal [m]."""
    distance: float = Field(default=8.0, gt=0)
    """From the goal's centre [m]."""
    gap: float = Field(default=8.0, gt=0)
    """[m]"""
    within: float = Field(default=20.0, gt=0)
    """The gap lies, whole, uniformly within so much of the fence's middle [m]."""
    thickness: float = Field(default=0.1, ge=MIN_THICKNESS)
    """[m]"""

    def __post_init__(self) -> None:
        if not self.gap <= self.within < self.length - self.thickness:
            raise ValueError(
                "gap <= within < length - thickness must hold "
                f"(given: gap {self.gap:g}, within {self.within:g}, length {self.length:g})"
            )

    def __call__(self, rng: np.random.Generator, site: Site) -> list[Obstacle]:
        """Draw."""
        ahead, aside = _axes(rng, site)
        at = self.length / 2 + (self.within - self.gap) * (float(rng.random()) - 0.5)
        ends = (site.goal_pos + self.distance * ahead + side * self.length / 2 * aside for side in (-1, 1))
        start, end = (_point(place) for place in ends)
        return [Fence(start, end, gap=self.gap, at=at, thickness=self.thickness)]


@settings
class Corridor(Settings):
    """Two parallel walls that lead from the goal in the direction in which the flocks are."""

    length: float = Field(default=20.0, gt=0)
    """Of each wall [m]."""
    width: float = Field(default=10.0, gt=0)
    """From centre line to centre line [m]."""
    distance: float = Field(default=4.0, ge=0)
    """From the goal's centre to where the walls begin, along the corridor [m]."""
    thickness: float = Field(default=0.1, ge=MIN_THICKNESS)
    """[m]"""

    def __call__(self, rng: np.random.Generator, site: Site) -> list[Obstacle]:
        """Draw."""
        ahead, aside = _axes(rng, site)
        near, far = self.distance * ahead, (self.distance + self.length) * ahead
        beside = [site.goal_pos + side * self.width / 2 * aside for side in (-1, 1)]
        return [Wall(_point(place + near), _point(place + far), self.thickness) for place in beside]


def _axes(rng: np.random.Generator, site: Site) -> tuple[Floats, Floats]:
    """Unit vectors in the direction of the flocks, or in any where the scenario has drawn none, and to its left."""
    angle = 2 * math.pi * float(rng.random()) if site.direction is None else site.direction
    ahead = np.array([math.cos(angle), math.sin(angle)])
    return ahead, np.array([-ahead[1], ahead[0]])


def _point(place: Floats) -> Point:
    return float(place[0]), float(place[1])


LAYOUTS: dict[str, type[Any]] = {"Scattered": Scattered, "Lattice": Lattice, "Fenced": Fenced, "Corridor": Corridor}
"""The library's layouts by name, for files."""
