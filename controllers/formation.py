"""What the tuned teams share: which sub-flock to work on, how to get there, and a terminal rule.

Methods that know one flock and one centroid have no answer to split flocks, and drive a delivered flock out again: a
shepherd within 10 m keeps sheep moving. Whatever its own rule, a tuned team

* works on sub-flocks (single linkage), soonest done first, each until its furthest sheep is `let_go` from the goal;
* never drives from nearer to the goal's centre than the ring at which shepherds hold a flock;
* walks round a flock, and round what is delivered, not through it;
* rings the goal evenly once every sub-flock is home;
* walks, and leads a flock, round obstacles (`shepherd_phys.controllers.routes`).
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import pymunk
from numba import njit
from numpy.typing import NDArray
from pydantic import Field

from shepherd_phys.geometry import OBSTACLES, Geometry, compile_shapes
from shepherd_phys.obstacles import Obstacle, solid
from shepherd_phys.settings import Settings, settings
from shepherd_phys.state import Floats, WorldState, sub_flocks, unit

from .routes import Routes

WEDGE = 0.35
"""How far ahead along the edge of a disc a shepherd aims that walks round it [rad]."""

MEETING, AHEAD, ASIDE = 1.0, 0.5, 1.2
"""A shepherd steps aside for one nearer than this [m], in a direction with this cosine to its, by this much [rad]."""


@settings
class TeamSettings(Settings):
    """Lengths in metres.

    The defaults, those of the methods' own settings too, were set by hand on a few episodes of the tuning seeds. There
    the search began that found each team's ``TUNED``.
    """

    stop_distance: float = Field(default=2.0, ge=0)
    """A shepherd this near to a sheep does not move on."""
    noise: float = Field(default=0.0, ge=0)
    """Weight of a random direction in the shepherd's own."""
    link: float = Field(default=3.0, gt=0)
    """Sheep nearer than this belong to one sub-flock."""
    let_go: float = Field(default=3.0, ge=0)
    """A sub-flock is home when its furthest sheep is within the goal's radius plus this of the goal's centre."""
    ring: float = Field(default=10.5, gt=0)
    """Distance from the goal's centre at which shepherds hold a delivered flock, and nearer than which none drives."""
    ring_out: float = Field(default=12.0, gt=0)
    """The same for a team of one or two, which stands where sheep lean out and is felt up to 2 m from the centre."""
    crumb: float = Field(default=0.6, ge=0, le=1)
    """A sub-flock with less than this fraction of the largest one's sheep waits until the others are home."""
    loyalty: float = Field(default=4.0, ge=0)
    """Another sub-flock is taken up before the one at work is home only if its furthest sheep is this much nearer."""
    berth: float = Field(default=9.0, ge=0)
    """Nearer than this to a flock's centroid no shepherd passes on its way to the other side."""
    clearance: float = Field(default=0.5, gt=0)
    """A shepherd's centre keeps this far from obstacles; more than its radius."""
    flock_clearance: float = Field(default=1.5, gt=0)
    """A flock is led round obstacles so that its centroid keeps this far from them, where there is such a way."""


class Team:
    """A tuned team; a method fills in `_targets`.

    Args:
        settings: its lengths.
    """

    lidar = None

    def __init__(self, settings: TeamSettings) -> None:
        self._common = settings
        self._surroundings = Surroundings()
        self._routes: tuple[Geometry, Routes, Routes] | None = None  # round which obstacles: shepherds', flocks'

    def reset(self, rng: np.random.Generator) -> None:
        """Take the episode's generator."""
        self._rng = rng
        self._at: Floats | None = None  # centroid of the sub-flock last at work

    def to_dict(self) -> dict[str, Any]:
        """Its parameters."""
        return self._common.to_dict()

    def act(self, observation: NDArray[np.float32], state: WorldState) -> NDArray[np.float64]:
        """(P, 2)."""
        s = self._common
        if state.obstacles:
            geometry = self._surroundings.of(state.obstacles)
            if self._routes is None or self._routes[0] is not geometry:
                self._routes = geometry, Routes(geometry, s.clearance), Routes(geometry, s.flock_clearance)
        targets, stop = self._wanted(state)
        if state.obstacles and self._routes is not None:
            targets = make_way(state.shepherd_pos, self._routes[1].towards(state.shepherd_pos, targets))
        return walk(state, targets, stop, s.noise, self._rng)

    def _wanted(self, state: WorldState) -> tuple[Floats, float]:
        """(P, 2) where to walk now, but for obstacles, and how near to sheep to stop [m]."""
        s = self._common
        ring = s.ring if state.n_shepherds >= 3 else s.ring_out
        flocks = flocks_out(state, s.link, state.goal_radius + s.let_go, s.crumb)
        if not flocks.sheep:
            self._at = None
            places = ring_places(state, ring) if state.n_shepherds >= 3 else leak_places(state, ring)
            return round_about(state.shepherd_pos, places, state.goal_pos, ring), 0.0
        flocks = self._kept_first(flocks)
        self._at = flocks.centers[0]
        targets = beyond(self._targets(self._led(state), flocks), state.goal_pos, ring)
        targets = self._way(state, targets, flocks)
        if state.sheep_in_goal.any():
            targets = round_about(state.shepherd_pos, targets, state.goal_pos, ring)
        return targets, s.stop_distance

    def _led(self, state: WorldState) -> WorldState:
        """The state as the method is to see it: its goal is where the flock at work has to go first."""
        if not state.obstacles or self._routes is None or self._at is None:
            return state
        goal, routes = state.goal_pos[None], self._routes[2]
        place = routes.towards(self._at[None], goal)[0]
        # a goal with obstacles too near stays the goal
        last = np.array_equal(place, state.goal_pos) or np.array_equal(place, routes.towards(goal, goal)[0])
        return state if last else state.but(goal_pos=place)

    def _kept_first(self, flocks: SubFlocks) -> SubFlocks:
        """The sub-flocks with the one last at work first, unless another is now much sooner done.

        Without this a team between two equal flocks turns from one to the other for ever, frightening each away.
        """
        if self._at is None or len(flocks.sheep) == 1:
            return flocks
        x, y = (flocks.centers - self._at).T
        kept = int(np.argmin(x * x + y * y))
        if len(flocks.sheep[kept]) < self._common.crumb * max(map(len, flocks.sheep)):
            return flocks
        if flocks.reach[kept] - flocks.reach[0] > self._common.loyalty:
            return flocks
        return flocks.led_by(kept)

    def _targets(self, state: WorldState, flocks: SubFlocks) -> Floats:
        """(P, 2) where the method wants the shepherds, given the sub-flocks not yet home, the first at work."""
        raise NotImplementedError

    def _way(self, state: WorldState, targets: Floats, flocks: SubFlocks) -> Floats:
        """(P, 2) the next places to walk to: round the sub-flock at work."""
        return np.asarray(round_about(state.shepherd_pos, targets, flocks.centers[0], self._common.berth))


class Surroundings:
    """The obstacles of an episode as surfaces, compiled once."""

    def __init__(self) -> None:
        self._obstacles: tuple[Obstacle, ...] = ()
        self._geometry = compile_shapes(())

    def of(self, obstacles: tuple[Obstacle, ...]) -> Geometry:
        """Their surfaces."""
        if obstacles is not self._obstacles:
            body = pymunk.Body(body_type=pymunk.Body.STATIC)
            shapes = [shape for i, obstacle in enumerate(obstacles) for shape in solid(obstacle, i, body)]
            self._geometry = compile_shapes((shape, -1, OBSTACLES) for shape in shapes)
            self._obstacles = obstacles
        return self._geometry


class SubFlocks(NamedTuple):
    """Sub-flocks that are not home, the first one to be seen to first."""

    sheep: list[Floats]
    """Positions (K, 2) of each [m]."""
    centers: Floats
    """(F, 2) centroids [m]."""
    reach: Floats
    """(F,) distance of each one's furthest sheep from the goal's centre [m]."""

    def led_by(self, first: int) -> SubFlocks:
        """The same, another one first."""
        order = [first, *(i for i in range(len(self.sheep)) if i != first)]
        return SubFlocks([self.sheep[i] for i in order], self.centers[order], self.reach[order])


def flocks_out(state: WorldState, link: float, home: float, crumb: float = 0.0) -> SubFlocks:
    """Each sub-flock that is not home; first the one whose furthest sheep is nearest to the goal.

    Crumbs come after all others: a team after one sheep would frighten away the flock beside it.

    Args:
        state: of the world.
        link: sheep nearer than this belong together [m].
        home: a sub-flock with all sheep this near to the goal's centre is home [m].
        crumb: a sub-flock with less than this fraction of the sheep of the largest not home is one.
    """
    label, reach, size, center = _measured(state.sheep_pos, state.goal_pos, link)
    wild = (reach > home).nonzero()[0]
    if len(wild) > 1:
        wild = wild[np.lexsort((reach[wild], size[wild] < crumb * size[wild].max()))]
    return SubFlocks([state.sheep_pos[label == i] for i in wild.tolist()], center[wild], reach[wild])


@njit(cache=True)
def _measured(sheep, goal, link):  # type: ignore[no-untyped-def]
    """Label of each sheep; of the sub-flocks the furthest distance from the goal's centre [m], size, centroid [m]."""
    label = sub_flocks(sheep, link)
    count = label.max() + 1
    reach, size, center = np.zeros(count), np.zeros(count, np.int64), np.zeros((count, 2))
    for i in range(len(sheep)):
        out = math.hypot(sheep[i, 0] - goal[0], sheep[i, 1] - goal[1])
        reach[label[i]] = max(reach[label[i]], out)
        size[label[i]] += 1
        center[label[i]] += sheep[i]
    for flock in range(count):
        center[flock] /= size[flock]
    return label, reach, size, center


def ring_places(state: WorldState, radius: float) -> Floats:
    """(P, 2) evenly spaced places on a circle round the goal, each shepherd near to where it is."""
    p = state.n_shepherds
    away = state.shepherd_pos - state.goal_pos
    bearing = np.arctan2(away[:, 1], away[:, 0])
    order = np.argsort(bearing)
    slots = 2 * np.pi * np.arange(p) / max(p, 1)
    # the turn of the whole ring that moves the team least
    turn = np.angle(np.exp(1j * (bearing[order] - slots)).sum())
    place = np.empty(p)
    place[order] = slots + turn
    return np.asarray(state.goal_pos + radius * heading(place))


def leak_places(state: WorldState, radius: float) -> Floats:
    """(P, 2) places on a circle round the goal for a team too small to ring it: where sheep lean out.

    The first place is behind the sheep furthest from the goal's centre, the others evenly round from there.
    """
    p = state.n_shepherds
    out = state.sheep_pos - state.goal_pos
    first = bearing_of(out[np.argmax(np.hypot(*out.T))])
    places = state.goal_pos + radius * heading(first + 2 * np.pi * np.arange(p) / max(p, 1))
    if (
        p == 2
        and np.hypot(*(places - state.shepherd_pos).T).sum() > np.hypot(*(places[::-1] - state.shepherd_pos).T).sum()
    ):
        places = places[::-1]
    return np.asarray(places)


@njit(cache=True)
def in_order(bearing, slots):  # type: ignore[no-untyped-def]
    """(P,) the slot of each shepherd, in the order in which they stand round a flock, with the least turning in all.

    Nobody crosses another's way: two that meet head-on block each other.

    Args:
        bearing: (P,) of the shepherds from the flock's centroid [rad].
        slots: (P,) bearings of the slots, rising, less than a turn apart [rad].
    """
    p = len(slots)
    order = np.argsort(_wrapped(bearing), kind="mergesort")
    taken = np.empty(p, np.int64)
    least, best = math.inf, 0
    for shift in range(p):
        turning = 0.0
        for i in range(p):
            away = slots[(i + shift) % p] - bearing[order[i]]
            turning += abs(math.atan2(math.sin(away), math.cos(away)))
        if turning < least:
            least, best = turning, shift
    for i in range(p):
        taken[order[i]] = (i + best) % p
    return taken


def heading(angle: Floats) -> Floats:
    """Unit vectors (..., 2) at angles (...) from the x axis [rad]."""
    return np.stack([np.cos(angle), np.sin(angle)], axis=-1)


def bearing_of(vectors: Floats) -> Floats:
    """Angles (...) of vectors (..., 2) from the x axis [rad]; 0 for a vector of length 0."""
    return np.asarray(np.arctan2(vectors[..., 1], vectors[..., 0]))


def wrapped(angle: Floats) -> Floats:
    """The same angles in [-pi, pi] [rad]."""
    return np.asarray(_wrapped(angle))


@njit(cache=True)
def _wrapped(angle):  # type: ignore[no-untyped-def]
    return np.arctan2(np.sin(angle), np.cos(angle))


@njit(cache=True)
def beyond(targets, center, radius):  # type: ignore[no-untyped-def]
    """Targets (P, 2), those nearer than ``radius`` to ``center`` moved straight out to that distance [m]."""
    moved = targets.copy()
    for k in range(len(targets)):
        x, y = targets[k, 0] - center[0], targets[k, 1] - center[1]
        away = math.hypot(x, y)
        if away < radius:
            scale = radius / away if away > 0 else 0.0
            moved[k, 0], moved[k, 1] = center[0] + scale * x, center[1] + scale * y
    return moved


def limited(action: Floats) -> Floats:
    """Actions (P, 2), those longer than 1 cut to length 1."""
    return np.asarray(action / np.maximum(np.hypot(action[:, 0], action[:, 1]), 1.0)[:, None])


@njit(cache=True)
def round_about(pos, targets, center, radius):  # type: ignore[no-untyped-def]
    """Where to walk now so as to reach targets round a disc instead of through it.

    A shepherd whose straight way leads through the disc walks along its edge, the shorter way round; one inside
    walks outwards and on.

    Args:
        pos: (P, 2) where the shepherds are [m].
        targets: (P, 2) where they want to be [m].
        center: (2,) of the disc [m].
        radius: of the disc [m].

    Returns:
        (P, 2) the next places to walk to [m].
    """
    places = targets.copy()
    edge = max(radius, 1e-9)
    for k in range(len(pos)):
        way_x, way_y = targets[k, 0] - pos[k, 0], targets[k, 1] - pos[k, 1]
        out_x, out_y = pos[k, 0] - center[0], pos[k, 1] - center[1]
        length = math.hypot(way_x, way_y)
        ahead = -(way_x * out_x + way_y * out_y)  # of the centre along the way, times its length
        cross = way_y * out_x - way_x * out_y
        if length > 0 and 0 < ahead < length * length and abs(cross) < radius * length * (1 - 1e-9):
            here = math.atan2(out_y, out_x)
            there = math.atan2(targets[k, 1] - center[1], targets[k, 0] - center[0])
            turn = math.atan2(math.sin(there - here), math.cos(there - here))
            bearing = here + min(max(turn, -WEDGE), WEDGE)
            places[k, 0] = center[0] + edge * math.cos(bearing)
            places[k, 1] = center[1] + edge * math.sin(bearing)
    return places


@njit(cache=True)
def make_way(pos, targets):  # type: ignore[no-untyped-def]
    """Next places (P, 2) to walk to, for one that has another right before it to the right of that one [m].

    In the open teams are given places so that nobody crosses another's way; between obstacles two may meet head-on, and
    would block each other for ever.
    """
    places = targets.copy()
    cos, sin = math.cos(ASIDE), math.sin(ASIDE)
    for k in range(len(pos)):
        x, y = targets[k, 0] - pos[k, 0], targets[k, 1] - pos[k, 1]
        length = math.hypot(x, y)
        for j in range(len(pos)):
            dx, dy = pos[j, 0] - pos[k, 0], pos[j, 1] - pos[k, 1]
            away = math.hypot(dx, dy)
            if j != k and 0 < away < min(MEETING, length) and x * dx + y * dy > AHEAD * away * length:
                places[k, 0] = pos[k, 0] + (cos * x + sin * y) / length
                places[k, 1] = pos[k, 1] + (cos * y - sin * x) / length
                break
    return places


def walk(state: WorldState, targets: Floats, stop: float, noise: float, rng: np.random.Generator) -> Floats:
    """Actions that take each shepherd to its target: full speed, slower only to arrive on it.

    Args:
        state: of the world.
        targets: (P, 2) [m].
        stop: a shepherd nearer than this to a sheep does not move [m].
        noise: weight e of a random direction.
        rng: where that comes from.

    Returns:
        (P, 2) actions.
    """
    pos, step = state.shepherd_pos, state.shepherd_max_speed * state.control_dt
    if noise > 0:
        way = targets - pos
        direction = unit(unit(way) + noise * heading(rng.uniform(0.0, 2 * np.pi, len(way))))
        targets = pos + np.hypot(way[:, 0], way[:, 1])[:, None] * direction
    return np.asarray(_paces(pos, np.asarray(targets, dtype=np.float64), step, state.sheep_pos, stop))


@njit(cache=True)
def _paces(pos, targets, step, sheep, stop):  # type: ignore[no-untyped-def]
    """(P, 2) towards the targets, 1 long or what is left of the way over ``step`` (P,); 0 near a sheep."""
    paces = np.zeros_like(pos)
    for k in range(len(pos)):
        stands = False
        for i in range(len(sheep)):
            dx, dy = sheep[i, 0] - pos[k, 0], sheep[i, 1] - pos[k, 1]
            if dx * dx + dy * dy < stop * stop:
                stands = True
                break
        if not stands:
            way_x, way_y = targets[k, 0] - pos[k, 0], targets[k, 1] - pos[k, 1]
            scale = 1.0 / max(math.hypot(way_x, way_y), step[k])
            paces[k, 0], paces[k, 1] = way_x * scale, way_y * scale
    return paces
