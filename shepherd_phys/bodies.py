"""Bodies of agents: what pymunk is told about them, and how they follow a wanted velocity.

Whatever its kind, a body is commanded by a wanted velocity; how it follows, at once or by turning and driving,
is its own business. A user adds one by writing a class with the members of `Body`; nothing here is edited.
"""

from __future__ import annotations

import math
import numbers
from typing import Annotated, Any, ClassVar, Protocol, runtime_checkable

import numpy as np
import pymunk
from numpy.typing import NDArray
from pydantic import Field

from shepherd_phys.obstacles import Point, Polygon
from shepherd_phys.settings import Settings, SettingsError, kind_of, settings

Command = tuple[tuple[float, float], float]
"""Velocity [m/s] in world axes, and spin [rad/s]."""


@runtime_checkable
class Body(Protocol):
    """What the world needs of an agent's body.

    It may have a ``flies = True`` besides: a body that flies collides with nothing, is seen by lidars as any other, and
    a flying shepherd does not see what it is above.
    """

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


@settings
class DifferentialDrive(Settings):
    """A disc on two driven wheels: it moves along its nose alone, and turns by driving them at different speeds.

    With e the angle from the nose to the wanted velocity v*, it asks for

        omega = clip(k e, +- omega_max),    v = min(|v*| max(0, cos e), v_max - |omega| b / 2),

    so that no wheel, at v +- omega b / 2, is faster than v_max: it turns first, and drives with what is left. It does
    not drive backwards. Kinematics of the wheels: Siegwart, Nourbakhsh & Scaramuzza 2011, Introduction to Autonomous
    Mobile Robots, section 3.2.
    """

    radius: float = Field(default=0.25, gt=0)
    """[m]"""
    mass: float = Field(default=5.0, gt=0)
    """[kg]"""
    max_speed: float = Field(default=1.5, gt=0)
    """v_max: top speed of a wheel over ground [m/s], and so of the body."""
    track: float = Field(default=0.4, gt=0)
    """b: between the wheels [m]."""
    max_turn: float = Field(default=3.0, gt=0)
    """omega_max [rad/s]; never more than 2 v_max / b, at which it turns on the spot."""
    turn_gain: float = Field(default=4.0, gt=0)
    """k [1/s]; no more than 1 / dt acts, so that a turn never overshoots."""

    def build(self) -> tuple[pymunk.Body, list[pymunk.Shape]]:
        """A solid disc that can turn."""
        return _solid_disc(self.mass, self.radius)

    def follow(self, pose: NDArray[np.float64], wanted: NDArray[np.float64], dt: float) -> Command:
        """Turns its nose to what is wanted, and drives along it."""
        nose, error, asked = _aim(pose, wanted, dt)
        fastest = min(self.max_turn, 2.0 * self.max_speed / self.track)
        spin = _clipped(min(self.turn_gain, 1.0 / dt) * error, fastest)
        speed = min(asked * max(0.0, math.cos(error)), self.max_speed - abs(spin) * self.track / 2.0)
        return (speed * math.cos(nose), speed * math.sin(nose)), spin


@settings
class Unicycle(Settings):
    """A disc that moves along its nose alone, and whose speed and spin change only so fast.

    With e the angle from the nose to the wanted velocity v*, its speed along the nose goes towards |v*| max(0, cos e)
    and its spin towards sign(e) min(k |e|, omega_max, sqrt(2 alpha |e|)), by no more than a dt and alpha dt. The root
    is the spin from which it can still stop at the wanted heading. Kinematics: LaValle 2006, Planning Algorithms,
    section 13.1.2.3. Sideways it has no way to go, and what pushes it there is lost at once.
    """

    radius: float = Field(default=0.25, gt=0)
    """[m]"""
    mass: float = Field(default=5.0, gt=0)
    """[kg]"""
    max_speed: float = Field(default=1.5, gt=0)
    """[m/s]"""
    max_acceleration: float = Field(default=2.0, gt=0)
    """a, along the nose [m/s2]."""
    max_turn: float = Field(default=3.0, gt=0)
    """omega_max [rad/s]."""
    max_turn_acceleration: float = Field(default=12.0, gt=0)
    """alpha [rad/s2]."""
    turn_gain: float = Field(default=3.0, gt=0)
    """k [1/s]; no more than 1 / (2 dt) acts."""

    def build(self) -> tuple[pymunk.Body, list[pymunk.Shape]]:
        """A solid disc that can turn."""
        return _solid_disc(self.mass, self.radius)

    def follow(self, pose: NDArray[np.float64], wanted: NDArray[np.float64], dt: float) -> Command:
        """Turns its nose to what is wanted and drives along it, both no more abruptly than it can."""
        nose, error, asked = _aim(pose, wanted, dt)
        _, _, _, vx, vy, spin = pose.tolist()
        gain, alpha = min(self.turn_gain, 0.5 / dt), self.max_turn_acceleration
        turn = math.copysign(min(gain * abs(error), self.max_turn, math.sqrt(2.0 * alpha * abs(error))), error)
        spin = _clipped(spin + _clipped(turn - spin, alpha * dt), self.max_turn)
        along = vx * math.cos(nose) + vy * math.sin(nose)
        speed = along + _clipped(asked * max(0.0, math.cos(error)) - along, self.max_acceleration * dt)
        return (speed * math.cos(nose), speed * math.sin(nose)), spin


def _centred(vertices: tuple[Point, ...]) -> tuple[Point, ...]:
    """The corners of a polygon, counter-clockwise, about its centroid."""
    ordered = Polygon(vertices).vertices
    double = cx = cy = 0.0
    for (ax, ay), (bx, by) in zip((ordered[-1], *ordered[:-1]), ordered, strict=True):
        cross = ax * by - bx * ay
        double, cx, cy = double + cross, cx + (ax + bx) * cross, cy + (ay + by) * cross
    return tuple((x - cx / (3.0 * double), y - cy / (3.0 * double)) for x, y in ordered)


@settings
class PolygonRobot(Settings):
    """A convex polygon on omnidirectional wheels: takes up the wanted velocity at once, and turns its nose to it.

    It spins at clip(k e, +- omega_max), e the angle from its nose, the polygon's x axis, to the wanted velocity.
    """

    vertices: Annotated[tuple[Point, ...], Field(min_length=3)] = (
        (0.35, 0.0), (0.15, 0.25), (-0.3, 0.25), (-0.3, -0.25), (0.15, -0.25),
    )  # fmt: skip
    """Corners of a convex polygon, once round [m]; it moves and turns about its centroid."""
    mass: float = Field(default=5.0, gt=0)
    """[kg]"""
    max_speed: float = Field(default=1.5, gt=0)
    """[m/s]"""
    max_turn: float = Field(default=3.0, gt=0)
    """omega_max [rad/s]."""
    turn_gain: float = Field(default=4.0, gt=0)
    """k [1/s]; no more than 1 / dt acts."""

    def __post_init__(self) -> None:
        _centred(self.vertices)

    def build(self) -> tuple[pymunk.Body, list[pymunk.Shape]]:
        """A solid polygon."""
        corners = list(_centred(self.vertices))
        body = pymunk.Body(self.mass, pymunk.moment_for_poly(self.mass, corners))
        return body, [pymunk.Poly(body, corners)]

    def follow(self, pose: NDArray[np.float64], wanted: NDArray[np.float64], dt: float) -> Command:
        """Does what is wanted, and turns."""
        _, error, _ = _aim(pose, wanted, dt)
        x, y = wanted.tolist()
        return (x, y), _clipped(min(self.turn_gain, 1.0 / dt) * error, self.max_turn)


@settings
class Flyer(Settings):
    """A flying shepherd: sheep fear it and lidars see it, but it collides with nothing.

    Its velocity goes towards what is wanted by no more than a dt. It does not see what it is above; one that walks
    below it reads 0 on every beam of the shepherds' channel, as inside any solid.
    """

    flies: ClassVar[bool] = True

    radius: float = Field(default=0.25, gt=0)
    """Of the disc that lidars see [m]."""
    mass: float = Field(default=1.5, gt=0)
    """[kg]; of no influence, since nothing touches it."""
    max_speed: float = Field(default=1.5, gt=0)
    """[m/s]; the walking shepherds', so that teams compare."""
    max_acceleration: float = Field(default=4.0, gt=0)
    """a, in any direction [m/s2]: a multirotor that leans by some 22 degrees."""

    def build(self) -> tuple[pymunk.Body, list[pymunk.Shape]]:
        """A body of infinite moment (it cannot spin) with one circle."""
        body = pymunk.Body(self.mass, math.inf)
        return body, [pymunk.Circle(body, self.radius)]

    def follow(self, pose: NDArray[np.float64], wanted: NDArray[np.float64], dt: float) -> Command:
        """Comes as near to what is wanted as its acceleration lets it."""
        _, _, _, vx, vy, _ = pose.tolist()
        dx, dy = wanted[0] - vx, wanted[1] - vy
        length = math.hypot(dx, dy)
        part = min(1.0, self.max_acceleration * dt / length) if length > 0.0 else 0.0
        return (vx + part * dx, vy + part * dy), 0.0


def _solid_disc(mass: float, radius: float) -> tuple[pymunk.Body, list[pymunk.Shape]]:
    body = pymunk.Body(mass, pymunk.moment_for_circle(mass, 0.0, radius))
    return body, [pymunk.Circle(body, radius)]


def _aim(pose: NDArray[np.float64], wanted: NDArray[np.float64], dt: float) -> tuple[float, float, float]:
    """Where the nose will point when what is answered takes effect, the angle from there to what is wanted [rad], and
    how fast that is [m/s].

    The engine first moves and turns a body by the velocities that it has: an answer takes effect at the end of the
    substep. Nothing wanted: no angle.
    """  # noqa: D205
    nose = float(pose[2] + pose[5] * dt)
    x, y = wanted.tolist()
    asked = math.hypot(x, y)
    return nose, math.remainder(math.atan2(y, x) - nose, math.tau) if asked > 0.0 else 0.0, asked


def _clipped(value: float, limit: float) -> float:
    return min(max(value, -limit), limit)


SHEEP = Disc(radius=0.15, mass=1.0, max_speed=1.0)
"""100 of them fit the 2.5 m goal only below a spacing of 0.476 m, so the radius is below 0.238 m."""

BODIES: dict[str, type[Any]] = {
    body.__name__: body for body in (Disc, DifferentialDrive, Unicycle, PolygonRobot, Flyer)
}
"""The library's bodies by name, for files and the command line."""


def flies(body: Body) -> bool:
    """Whether a body collides with nothing."""
    return bool(getattr(body, "flies", False))


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
        if shape.sensor:
            raise SettingsError(
                f"{name}.build: a {type(shape).__name__} is a sensor, which touches nothing and no beam sees; "
                "a body that flies has flies = True"
            )
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
