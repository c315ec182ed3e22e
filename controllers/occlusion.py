"""Occlusion: a shepherd pushes only while the sheep hide the goal from it, and otherwise circles to where they do.

Our reading of Hu et al. (IEEE TCDS 14(1):126-135, 2022), whose formulas are not public, for several sub-flocks:

* sub-flocks by single linkage; from the largest on, each gets the nearest free shepherd, the rest go to the largest;
* for a shepherd at S and its sub-flock with centroid c and radius R_c (its furthest sheep), beta is the signed angle at
  S from c to the goal g. The goal is **occluded** when |beta| < atan(R_c / |c - S|), and lies behind the sheep;
* occluded: go straight for the flock up to e + `approach` from c, and so push it; e is how far the flock reaches from c
  towards the shepherd (R_c for a round one: behind a long one, R_c away, a shepherd would not be felt);
* else circle c at R_c + `circle` in the sense that shrinks beta: with its sign, counter-clockwise being positive.

R_c is never taken as less than `min_radius`: one sheep hides nothing. The team has a terminal rule
(`shepherd_phys.controllers.formation`): sub-flocks that are home are left alone.

Among obstacles g is where its sub-flock has to go first; who circles and would have to turn back for a wall goes the
shortest way round wall and flock to the other side, or to its place round the goal; nobody steps aside into a wall.
"""

from __future__ import annotations

import math
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from shepherd_phys.settings import settings
from shepherd_phys.state import Floats, WorldState, unit

from .formation import SubFlocks, Team, TeamSettings
from .places import WEDGE, bearing_of, beyond, heading, round_about, wrapped
from .routes import Routes


@settings
class OcclusionSettings(TeamSettings):
    """Lengths in metres."""

    approach: float = Field(default=4.0, ge=0)
    """From the flock's edge to a shepherd that pushes it."""
    circle: float = Field(default=8.0, ge=0)
    """From the flock's edge to a shepherd that walks round it."""
    min_radius: float = Field(default=1.0, gt=0)
    """Least R_c."""


TUNED = OcclusionSettings(
    stop_distance=2.0,
    link=2.0,
    let_go=4.0,
    ring=10.5,
    ring_out=12.0,
    crumb=0.7,
    loyalty=2.0,
    berth=9.0,
    approach=4.0,
    circle=8.0,
    min_radius=0.5,
)
"""What the team plays with. Found by ``shepherd-phys tune --controller occlusion --rounds 4 --candidates 8 --seed 0``,
version 0.1.0; the record is docs/tuning/occlusion.toml."""


PATIENCE = 25
"""A shepherd that was led back in more steps than this takes a detour."""
NEAR = 0.5
"""Nobody trades places round the goal once all are as near to their own [m]."""


class Occlusion(Team):
    """The team: a sub-flock for each shepherd, a terminal rule.

    Args:
        settings: its lengths; `TUNED` unless given.
    """

    def __init__(self, settings: OcclusionSettings | None = None) -> None:
        self.settings = settings or TUNED
        super().__init__(self.settings)

    def reset(self, rng: np.random.Generator) -> None:
        """Take the episode's generator."""
        super().reset(rng)
        # among obstacles: whether all were home; for how many steps each was led back since then, or since they were
        # out; and, when that was too many, the places round the goal that are kept till all are there
        self._home = False
        self._led_back: Floats | None = None
        self._held: Floats | None = None

    def _targets(self, state: WorldState, flocks: SubFlocks) -> Floats:
        s = self.settings
        centers, pos = flocks.centers, state.shepherd_pos
        chosen = shared_out(pos, centers, np.array([len(flock) for flock in flocks.sheep]))
        own = centers[chosen]
        facing = unit(pos - own)
        radii, extents = np.empty(len(pos)), np.empty(len(pos))
        for k, f in enumerate(chosen.tolist()):
            spread = flocks.sheep[f] - centers[f]
            radii[k] = max(math.sqrt((spread * spread).sum(axis=1).max()), s.min_radius)
            extents[k] = (spread @ facing[k]).max()
        goals = self._leads(state, centers)[chosen]
        targets, pushes = occlusion_targets(pos, goals, own, radii, extents + s.approach, s.circle)
        if state.obstacles:
            if self._home:
                self._home, self._led_back = False, None
            self._work = pushes, self._behind(own, goals, radii), np.column_stack([own, radii + s.circle])
        return targets

    def _led(self, state: WorldState) -> WorldState:
        return state  # each sub-flock has its own way

    def _behind(self, centers: Floats, goals: Floats, radii: Floats) -> Floats:
        """(P, 2) places from which flocks hide their goals, as far off as no obstacle is between [m].

        Behind a wall it would go for its flock round the wall's end, lose the right bearing, and come back for ever.
        """
        s = self.settings
        away = unit(centers - goals)
        edge = centers + radii[:, None] * away
        places = edge + s.circle * away
        if self._routes is None:
            return places
        for off in (s.approach, (s.approach + s.circle) / 2, s.circle):
            nearer = edge + off * away
            places = np.where(self._routes[1].are_clear(edge, nearer)[:, None], nearer, places)
        return places

    def _way(self, state: WorldState, targets: Floats, flocks: SubFlocks) -> Floats:
        if not state.obstacles:
            return targets  # circling is part of the method
        pushes, behind, berths = self._work
        ring = self.settings.ring if state.n_shepherds >= 3 else self.settings.ring_out
        delivered = [[*state.goal_pos, ring]] * bool(state.sheep_in_goal.any())
        discs = [np.array([berth, *delivered]) for berth in berths]
        return self._detoured(state.shepherd_pos, targets, beyond(behind, state.goal_pos, ring), discs, pushes)

    def _hold(self, state: WorldState, ring: float) -> Floats:
        places = super()._hold(state, ring)
        if self._routes is None or not state.obstacles:
            return places
        pos, goal = state.shepherd_pos, state.goal_pos
        if not self._home:
            self._home, self._led_back = True, None
        disc = np.array([[*goal, ring]])
        if self._led_back is None or not (self._led_back > PATIENCE).any():
            self._held = None
        else:
            kept = self._routes[1].towards(places, places) if self._held is None else self._held
            self._held = places = traded(self._routes[1].outside(disc), pos, kept)
        on = np.asarray(round_about(pos, places, goal, ring))
        there = (on == places).all(axis=1) & self._routes[1].are_clear(pos, on)
        return self._detoured(pos, on, places, [disc] * len(pos), there)

    def _detoured(
        self, pos: Floats, places: Floats, ends: Floats, discs: list[Floats], done: NDArray[np.bool_]
    ) -> Floats:
        """(P, 2) the next places as given, or, for who is on a detour, those on the shortest ways to the ends [m].

        Who walks along a disc's edge aims a little ahead. If a wall across the edge makes it turn back, the place
        ahead turns back with it, and so it would go back and forth for ever. A detour has an end that stays.

        Args:
            pos: (P, 2) shepherds [m].
            places: (P, 2) a little ahead [m].
            ends: (P, 2) where these lead in the end [m].
            discs: (D, 3) of each shepherd: x, y and radius [m].
            done: (P,) who needs no detour any more.
        """
        if self._routes is None:
            return places
        routes = self._routes[1]
        back = ((routes.towards(pos, places) - pos) * (places - pos)).sum(axis=1) < 0
        before = np.zeros(len(pos)) if self._led_back is None else self._led_back
        self._led_back = np.where(done, 0.0, before + back)
        places = places.copy()
        for k in (self._led_back > PATIENCE).nonzero()[0]:
            places[k] = routes.outside(discs[k]).towards(pos[k : k + 1], ends[k : k + 1])[0]
        return places

    def _aside(self, pos: Floats, targets: Floats) -> Floats:
        aside = super()._aside(pos, targets)
        if self._routes is None:
            return aside
        return np.where(self._routes[1].are_clear(pos, aside)[:, None], aside, targets)


def traded(routes: Routes, pos: Floats, places: Floats) -> Floats:
    """The places (P, 2) of shepherds, two exchanged where that lessens the sum of the squares of their ways [m].

    Where one stands in another's way, each so goes on from there. Walking too makes ways shorter, and so nobody trades
    back and forth.
    """
    p = len(pos)
    if p < 2 or np.hypot(*(places - pos).T).max() < NEAR:
        return places
    ways = routes.lengths(np.repeat(pos, p, axis=0), np.tile(places, (p, 1))).reshape(p, p)
    place = np.arange(p)
    for i, j in combinations(range(p), 2):
        kept = ways[i, place[i]] ** 2 + ways[j, place[j]] ** 2
        if ways[i, place[j]] ** 2 + ways[j, place[i]] ** 2 < kept:
            place[[i, j]] = place[[j, i]]
    return np.asarray(places[place])


def shared_out(pos: Floats, centers: Floats, sizes: NDArray[np.int64]) -> NDArray[np.int64]:
    """(P,) the sub-flock of each shepherd: from the largest on the nearest free one, the rest to the largest.

    Args:
        pos: (P, 2) shepherds [m].
        centers: (F, 2) centroids [m].
        sizes: (F,) sheep in each.
    """
    order = np.argsort(-sizes, kind="stable")
    chosen = np.full(len(pos), order[0], np.int64)
    free = np.ones(len(pos), dtype=bool)
    for flock in order:
        if not free.any():
            break
        nearest = np.argmin(np.where(free, np.hypot(*(pos - centers[flock]).T), np.inf))
        chosen[nearest] = flock
        free[nearest] = False
    return chosen


def occlusion_targets(
    pos: Floats, goals: Floats, centers: Floats, radii: Floats, approach: Floats, circle: float
) -> tuple[Floats, NDArray[np.bool_]]:
    """(P, 2) where each shepherd goes: at its flock, or on round it [m]; and (P,) whether at it: the goal is occluded.

    Args:
        pos: (P, 2) shepherds S [m].
        goals: (P, 2) g, to which each one's sub-flock is to go [m].
        centers: (P, 2) centroid c of each one's sub-flock [m].
        radii: (P,) R_c [m].
        approach: (P,) from c, when the goal is occluded [m].
        circle: beyond R_c, when it is not [m].
    """
    to_flock, to_goal = centers - pos, goals - pos
    distance = np.hypot(*to_flock.T)
    beta = wrapped(bearing_of(to_goal) - bearing_of(to_flock))
    occluded = (np.abs(beta) < np.arctan2(radii, distance)) & (np.hypot(*to_goal.T) > distance)
    bearing = bearing_of(-to_flock)
    on = bearing + np.where(beta < 0, -WEDGE, WEDGE)
    targets = centers + np.where(
        occluded[:, None],
        approach[:, None] * heading(bearing),
        (radii + circle)[:, None] * heading(on),
    )
    return targets, occluded
