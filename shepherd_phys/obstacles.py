"""Obstacles: small values that yield static pymunk shapes. They collide and cut beams.

A user adds one by writing a class with a ``shapes`` method.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Annotated, Any, Protocol, runtime_checkable

import numpy as np
import pymunk
from numpy.typing import ArrayLike, NDArray
from pydantic import AfterValidator, Field

from shepherd_phys.settings import Settings, SettingsError, kind_of, settings

Point = tuple[float, float]
"""(x, y) [m]."""

MIN_THICKNESS = 0.1
"""[m]. At the default substep nothing gets through a wall this thick; thinner ones are refused."""

ROUNDING = 1e-9
"""[m] by which a corner may lie off the place that was meant."""

Side = Annotated[float, Field(ge=MIN_THICKNESS)]


@runtime_checkable
class Obstacle(Protocol):
    """Something solid that does not move."""

    def shapes(self, body: pymunk.Body) -> list[pymunk.Shape]:
        """Fresh shapes attached to ``body``, the world's static one, in world coordinates [m]."""
        ...


@settings
class Wall(Settings):
    """A straight wall with round ends."""

    start: Point
    end: Point
    """Ends of its centre line [m]."""
    thickness: float = Field(default=0.1, ge=MIN_THICKNESS)
    """[m]"""

    def __post_init__(self) -> None:
        if math.dist(self.start, self.end) == 0:
            raise ValueError("start and end are the same point; use a Pillar")

    def shapes(self, body: pymunk.Body) -> list[pymunk.Shape]:
        """One segment."""
        return [pymunk.Segment(body, self.start, self.end, self.thickness / 2)]


@settings
class Pillar(Settings):
    """A disc."""

    center: Point
    """[m]"""
    radius: float = Field(default=0.5, ge=MIN_THICKNESS / 2)
    """[m]"""

    def shapes(self, body: pymunk.Body) -> list[pymunk.Shape]:
        """One circle."""
        return [pymunk.Circle(body, self.radius, self.center)]


def _convex(vertices: tuple[Point, ...]) -> tuple[Point, ...]:
    """Counter-clockwise corners of a convex polygon that is thick enough, or an error."""
    n = len(vertices)
    turns = []
    for i in range(n):
        (ax, ay), (bx, by), (cx, cy) = vertices[i - 1], vertices[i], vertices[(i + 1) % n]
        turns.append((bx - ax) * (cy - by) - (by - ay) * (cx - bx))
    if not (all(t > 0 for t in turns) or all(t < 0 for t in turns)):
        raise ValueError("the corners must go once round a convex polygon, no three in a line")
    ordered = vertices if turns[0] > 0 else vertices[::-1]
    total = 0.0  # turning angle: a pentagram turns left at every corner, too, but twice round
    for i in range(n):
        (ax, ay), (bx, by), (cx, cy) = ordered[i - 1], ordered[i], ordered[(i + 1) % n]
        total += math.atan2(
            (bx - ax) * (cy - by) - (by - ay) * (cx - bx), (bx - ax) * (cx - bx) + (by - ay) * (cy - by)
        )
    if total > 2.5 * math.pi:
        raise ValueError("the corners must go once round a convex polygon")
    width = _width(ordered)
    if width < MIN_THICKNESS:
        raise ValueError(f"is {width:.3g} m thick at its thinnest; at least {MIN_THICKNESS} m is allowed")
    return ordered


def _width(corners: Sequence[Point]) -> float:
    """Of a convex polygon at its thinnest [m]: the least, over its edges, of how far the furthest corner is."""
    least = math.inf
    for (ax, ay), (bx, by) in pairwise([corners[-1], *corners]):
        nx, ny = (ay - by), (bx - ax)
        length = math.hypot(nx, ny) or math.inf  # corners in one place: no width at all
        least = min(least, max(abs((x - ax) * nx + (y - ay) * ny) for x, y in corners) / length)
    return least


@settings
class Polygon(Settings):
    """A convex polygon."""

    vertices: Annotated[tuple[Point, ...], Field(min_length=3), AfterValidator(_convex)]
    """Corners in order [m]; kept counter-clockwise."""

    def shapes(self, body: pymunk.Body) -> list[pymunk.Shape]:
        """One polygon."""
        return [pymunk.Poly(body, list(self.vertices))]


@settings
class Box(Settings):
    """A rectangle."""

    center: Point
    """[m]"""
    size: tuple[Side, Side] = (1.0, 1.0)
    """Lengths of its sides, along its own x and y axis [m]."""
    angle: float = 0.0
    """Of its own x axis from the world's [rad]."""

    def shapes(self, body: pymunk.Body) -> list[pymunk.Shape]:
        """One polygon."""
        (x, y), (width, height) = self.center, self.size
        cos, sin = math.cos(self.angle), math.sin(self.angle)
        half = [(sx * width / 2, sy * height / 2) for sx, sy in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
        return [pymunk.Poly(body, [(x + cos * u - sin * v, y + sin * u + cos * v) for u, v in half])]


@settings
class Fence(Settings):
    """A straight wall with a gap."""

    start: Point
    end: Point
    """Ends of its centre line [m]."""
    gap: float = Field(gt=0)
    """Free width between the two parts [m]."""
    at: float | None = Field(default=None, gt=0)
    """Distance of the gap's middle from the start [m]; none given: half-way."""
    thickness: float = Field(default=0.1, ge=MIN_THICKNESS)
    """[m]"""

    def __post_init__(self) -> None:
        before, behind = self._ends()
        if not (before > 0 and behind < math.dist(self.start, self.end)):
            raise ValueError(
                "gap: something of the fence must be left on both sides "
                f"(given: gap {self.gap}, at {self.at}, length {math.dist(self.start, self.end):.6g})"
            )

    def _ends(self) -> tuple[float, float]:
        """Where the centre line breaks off and goes on, from the start [m]; the ends are round."""
        middle = math.dist(self.start, self.end) / 2 if self.at is None else self.at
        half = (self.gap + self.thickness) / 2
        return middle - half, middle + half

    def shapes(self, body: pymunk.Body) -> list[pymunk.Shape]:
        """Two segments."""
        length = math.dist(self.start, self.end)
        (ax, ay), (bx, by) = self.start, self.end
        left, right = ((ax + (bx - ax) * t / length, ay + (by - ay) * t / length) for t in self._ends())
        radius = self.thickness / 2
        return [pymunk.Segment(body, self.start, left, radius), pymunk.Segment(body, right, self.end, radius)]


OBSTACLES: dict[str, type[Any]] = {"Wall": Wall, "Pillar": Pillar, "Box": Box, "Polygon": Polygon, "Fence": Fence}
"""The library's obstacles by name, for files."""


def solid(obstacle: Obstacle, index: int, body: pymunk.Body) -> list[pymunk.Shape]:
    """An obstacle's shapes, checked.

    Raises:
        SettingsError: names the obstacle and what it lacks.
    """
    name = f"obstacles[{index}] ({kind_of(obstacle)})"
    if not hasattr(obstacle, "shapes"):
        raise SettingsError(f"{name}: an obstacle needs 'shapes'; see shepherd_phys.obstacles.Obstacle")
    answer = obstacle.shapes(body)
    if not isinstance(answer, list | tuple) or not all(isinstance(shape, pymunk.Shape) for shape in answer):
        raise SettingsError(f"{name}.shapes: needs a list of pymunk shapes (given: {answer!r})")
    shapes = list(answer)
    if not shapes:
        raise SettingsError(f"{name}.shapes: gave no shape")
    for shape in shapes:
        thickness = 2 * shape.radius + (_width(shape.get_vertices()) if isinstance(shape, pymunk.Poly) else 0.0)
        if not thickness >= MIN_THICKNESS - ROUNDING:
            raise SettingsError(
                f"{name}.shapes: a {type(shape).__name__} must be at least {MIN_THICKNESS} m thick, or bodies get "
                f"through (given: {thickness:.3g} m)"
            )
        if shape.sensor:
            raise SettingsError(f"{name}.shapes: a {type(shape).__name__} is a sensor, which stops nobody")
        if shape.body is not body:
            raise SettingsError(f"{name}.shapes: {type(shape).__name__} is not attached to the body it was given")
        box = shape.cache_bb()
        if not all(map(math.isfinite, (box.left, box.bottom, box.right, box.top))):
            raise SettingsError(f"{name}.shapes: {type(shape).__name__} is not finite")
        shape.friction = 0.0
    return shapes


@dataclass(frozen=True, eq=False)
class Outline:
    """A shape as plain numbers: what lies within ``radius`` of the hull of ``points``.

    Raises:
        SettingsError: that is no shape, or not finite.
    """

    points: NDArray[np.float64]
    """(K, 2) a disc's centre, a segment's ends, or a convex polygon's corners, in world coordinates [m]."""
    radius: float
    """[m]"""

    def __init__(self, points: ArrayLike, radius: float) -> None:
        try:
            given = np.array(points, dtype=np.float64)
            rounding = float(radius)
        except (TypeError, ValueError):
            raise SettingsError("outline: needs points (K, 2) and a radius") from None
        if given.ndim != 2 or given.shape[1] != 2 or not len(given):
            raise SettingsError(f"outline: points need shape (K, 2) (given: {given.shape})")
        if not (np.isfinite(given).all() and math.isfinite(rounding) and rounding >= 0):
            raise SettingsError("outline: points and radius must be finite, the radius not negative")
        given.setflags(write=False)
        object.__setattr__(self, "points", given)
        object.__setattr__(self, "radius", rounding)

    def shape(self, body: pymunk.Body) -> pymunk.Shape:
        """A fresh shape of this outline."""
        corners = [(float(x), float(y)) for x, y in self.points]
        if len(corners) == 1:
            return pymunk.Circle(body, self.radius, corners[0])
        if len(corners) == 2:
            return pymunk.Segment(body, corners[0], corners[1], self.radius)
        return pymunk.Poly(body, corners, radius=self.radius)


def outlines(obstacle: Obstacle, index: int) -> list[Outline]:
    """The outlines of all of an obstacle's shapes, whatever class it is of; for pictures and files.

    Raises:
        SettingsError: it is no obstacle; the message calls it the one of this index.
    """
    shapes = solid(obstacle, index, pymunk.Body(body_type=pymunk.Body.STATIC))
    return [drawn for drawn in map(outline, shapes) if drawn is not None]


def outline(shape: pymunk.Shape) -> Outline | None:
    """What is drawn of a shape, in its body's coordinates; None of one that is no disc, segment or polygon."""
    if isinstance(shape, pymunk.Circle):
        return Outline([shape.offset], shape.radius)
    if isinstance(shape, pymunk.Segment):
        return Outline([shape.a, shape.b], shape.radius)
    return Outline(shape.get_vertices(), shape.radius) if isinstance(shape, pymunk.Poly) else None
