"""Bodies of agents: what pymunk is told about them, and how they follow a wanted velocity.

Whatever its kind, a body is commanded by a wanted velocity; how it follows, at once or by turning and driving,
is its own business. A user adds one by writing a class with the members of `Body`; nothing here is edited.
"""

from __future__ import annotations

import math
import numbers
from typing import Any, Protocol, runtime_checkable

import numpy as np
import pymunk
from numpy.typing import NDArray
from pydantic import Field

from shepherd_phys.settings import Settings, SettingsError, kind_of, settings


@runtime_checkable
class Body(Protocol):
    """What the world needs of an agent's body."""

    @property
    def max_speed(self) -> float:
        """Top speed [m/s]: an action of length 1 asks for it."""
        ...

    def build(self) -> tuple[pymunk.Body, list[pymunk.Shape]]:
        """A fresh dynamic body with its mass, and its shapes."""
        ...

    def follow(self, pose: NDArray[np.float64], wanted: NDArray[np.float64], dt: float) -> tuple[Any, float]:
        """Turn what is wanted into what this body does next, once a substep.

        Args:
            pose: (x, y, angle, vx, vy, spin) [m, rad, m/s, rad/s].
            wanted: (2,) wanted velocity, world axes [m/s], at most ``max_speed`` long.
            dt: length of the substep [s].

        Returns:
            velocity (2,) [m/s] in world axes, and spin [rad/s].
        """
        ...


@settings
class Disc(Settings):
    """A holonomic disc: takes up the wanted velocity at once and never spins (the default body)."""

    radius: float = Field(default=0.25, gt=0)
    """[m]"""
    mass: float = Field(default=5.0, gt=0)
    """[kg]"""
    max_speed: float = Field(default=1.5, gt=0)
    """[m/s]; 1.5 times the sheep's, Strömbom's ratio."""

    def build(self) -> tuple[pymunk.Body, list[pymunk.Shape]]:
        """A body of infinite moment (it cannot spin) with one circle."""
        body = pymunk.Body(self.mass, math.inf)
        return body, [pymunk.Circle(body, self.radius)]

    def follow(
        self, pose: NDArray[np.float64], wanted: NDArray[np.float64], dt: float
    ) -> tuple[NDArray[np.float64], float]:
        """Does what is wanted."""
        return wanted, 0.0


SHEEP = Disc(radius=0.15, mass=1.0, max_speed=1.0)
"""100 of them fit the 2.5 m goal only below a spacing of 0.476 m, so the radius is below 0.238 m."""

BODIES: dict[str, type[Any]] = {"Disc": Disc}
"""The library's bodies by name, for files and the command line."""


def built(body: Body, who: str) -> tuple[pymunk.Body, list[pymunk.Shape], float]:
    """Build a body and check what came: the world must never be handed a broken one.

    Args:
        body: the description.
        who: whose body it is, for the error ("shepherd 2").

    Returns:
        the pymunk body, its shapes, and the radius of the disc round its centre that holds it [m].

    Raises:
        SettingsError: names the class and what is wrong with what it built.
    """
    name = f"{who} ({kind_of(body)})"
    for member in ("build", "follow", "max_speed"):
        if not hasattr(body, member):
            raise SettingsError(f"{name}: a body needs {member!r}; see shepherd_phys.bodies.Body")
    speed = body.max_speed
    if not (isinstance(speed, numbers.Real) and math.isfinite(speed) and speed > 0):
        raise SettingsError(f"{name}.max_speed: must be a finite number above 0 (given: {speed!r})")
    answer = body.build()
    try:
        made, shapes = answer
        shapes = list(shapes)
        fits = isinstance(made, pymunk.Body) and all(isinstance(shape, pymunk.Shape) for shape in shapes)
    except (TypeError, ValueError):
        fits = False
    if not fits:
        raise SettingsError(f"{name}.build: needs a pymunk.Body and a list of its shapes (given: {answer!r})")
    if made.body_type != pymunk.Body.DYNAMIC:
        raise SettingsError(f"{name}.build: the body must be dynamic")
    if made.space is not None:
        raise SettingsError(f"{name}.build: must make a fresh body at each call")
    if not (math.isfinite(made.mass) and made.mass > 0 and made.moment > 0):
        raise SettingsError(
            f"{name}.build: mass must be finite and above 0, moment above 0 "
            f"(given: mass {made.mass}, moment {made.moment})"
        )
    if not shapes:
        raise SettingsError(f"{name}.build: needs at least one shape")
    reach = 0.0
    for shape in shapes:
        if shape.body is not made:
            raise SettingsError(f"{name}.build: {type(shape).__name__} belongs to another body")
        shape.friction = 0.0
        reach = max(reach, _reach(shape))
    if not (math.isfinite(reach) and reach > 0):
        raise SettingsError(f"{name}.build: shapes must be finite and larger than nothing (reach: {reach} m)")
    return made, shapes, reach


def _reach(shape: pymunk.Shape) -> float:
    """Largest distance of a shape's surface from the body's centre [m]."""
    if isinstance(shape, pymunk.Circle):
        return shape.radius + shape.offset.length
    if isinstance(shape, pymunk.Segment):
        return shape.radius + max(shape.a.length, shape.b.length)
    if isinstance(shape, pymunk.Poly):
        return shape.radius + max(v.length for v in shape.get_vertices())
    raise SettingsError(f"{type(shape).__name__} is no shape that pymunk knows")
