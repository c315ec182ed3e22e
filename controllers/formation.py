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
from numba import njit
from numpy.typing import NDArray
from pydantic import Field

from shepherd_phys.geometry import Geometry
from shepherd_phys.settings import Settings, settings
from shepherd_phys.state import Floats, WorldState, sub_flocks

from .places import beyond, leak_places, make_way, ring_places, round_about, walk
from .routes import Routes

SLACK = 0.05
"""What a shepherd leaves between itself and an obstacle at least [m]."""


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
    """A shepherd's centre keeps this far from obstacles, a larger one its radius and `SLACK`."""
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
            geometry = state.surroundings
            if self._routes is None or self._routes[0] is not geometry:
                clearance = max(s.clearance, float(state.shepherd_radius.max(initial=0.0)) + SLACK)
                self._routes = geometry, Routes(geometry, clearance), Routes(geometry, s.flock_clearance)
        targets, stop = self._wanted(state)
        if state.obstacles and self._routes is not None:
            targets = self._aside(state.shepherd_pos, self._routes[1].towards(state.shepherd_pos, targets))
        return walk(state, targets, stop, s.noise, self._rng)

    def _wanted(self, state: WorldState) -> tuple[Floats, float]:
        """(P, 2) where to walk now, but for obstacles, and how near to sheep to stop [m]."""
        s = self._common
        ring = s.ring if state.n_shepherds >= 3 else s.ring_out
        flocks = flocks_out(state, s.link, state.goal_radius + s.let_go, s.crumb)
        if not flocks.sheep:
            self._at = None
            return round_about(state.shepherd_pos, self._hold(state, ring), state.goal_pos, ring), 0.0
        flocks = self._kept_first(flocks)
        self._at = flocks.centers[0]
        targets = beyond(self._targets(self._led(state), flocks), state.goal_pos, ring)
        targets = self._way(state, targets, flocks)
        if state.sheep_in_goal.any():
            targets = round_about(state.shepherd_pos, targets, state.goal_pos, ring)
        return targets, s.stop_distance

    def _led(self, state: WorldState) -> WorldState:
        """The state as the method is to see it: its goal is where the flock at work has to go first."""
        if not state.obstacles or self._at is None:
            return state
        place = self._leads(state, self._at[None])[0]
        return state if np.array_equal(place, state.goal_pos) else state.but(goal_pos=place)

    def _leads(self, state: WorldState, centers: Floats) -> Floats:
        """(F, 2) where flocks with centroids (F, 2) have to go first on their ways to the goal [m]."""
        goals = np.repeat(state.goal_pos[None], len(centers), axis=0)
        if not state.obstacles or self._routes is None:
            return goals
        places = self._routes[2].towards(centers, goals)
        # a goal with obstacles too near stays the goal
        last = (places == self._routes[2].towards(goals[:1], goals[:1])).all(axis=1)
        return np.where(last[:, None], goals, places)

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

    def _hold(self, state: WorldState, ring: float) -> Floats:
        """(P, 2) where shepherds stand once all sheep are home, on a circle round the goal of this radius [m]."""
        return ring_places(state, ring) if state.n_shepherds >= 3 else leak_places(state, ring)

    def _aside(self, pos: Floats, targets: Floats) -> Floats:
        """(P, 2) the next places to walk to among obstacles, but for other shepherds: where to instead if one comes."""
        return np.asarray(make_way(pos, targets))

    def _way(self, state: WorldState, targets: Floats, flocks: SubFlocks) -> Floats:
        """(P, 2) the next places to walk to: round the sub-flock at work."""
        return np.asarray(round_about(state.shepherd_pos, targets, flocks.centers[0], self._common.berth))


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
