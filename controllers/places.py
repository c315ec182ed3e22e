"""Places round a goal or a flock, and the walk there."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from shepherd_phys.state import Floats, WorldState, unit

WEDGE = 0.35
"""How far ahead along the edge of a disc a shepherd aims that walks round it [rad]."""

MEETING, AHEAD, ASIDE = 1.0, 0.5, 1.2
"""A shepherd steps aside for one nearer than this [m], in a direction with this cosine to its, by this much [rad]."""


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
