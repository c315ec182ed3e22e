"""Shortest ways round obstacles, by A* on their visibility graph.

An obstacle's shape is the hull of its corners, rounded by a radius (a pillar: one corner). Whoever keeps a clearance
walks from node to node, which stand round the corners just outside it: 8 to a corner, on an octagon that contains the
circle of radius + clearance, so that the way from one node to the next along an edge keeps clear of it. A straight
way is clear if its distance from every hull is at least the clearance, or what the nearer of its ends has. (The
distance from a convex hull is a convex function along a straight line: no way that leads past a hull is lost.)

A search heeds the hulls in the straight way; those that are in the way which it finds are heeded too, and it searches
again: the last way is the shortest round all, since heeding fewer hulls never made it longer.
"""

from __future__ import annotations

import math
from copy import copy
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from shepherd_phys.geometry import Geometry
from shepherd_phys.state import Floats

SIDES = 8
"""Nodes round a corner."""
SLACK = 1e-6
"""So much further out than needed nodes stand, relative to radius and clearance: or rounding makes them blocked."""
ROUNDING = 1e-9
"""A way that is this much nearer to a hull than its ends are is not clear [m]."""


class Hulls(NamedTuple):
    """H rounded hulls with V corners in all."""

    first: NDArray[np.int64]
    """(H + 1,) row of a hull's first corner; its last one is before the next one's first."""
    corners: Floats
    """(V, 2) in order [m]."""
    radius: Floats
    """(H,) [m]."""
    discs: Floats
    """(H, 3) x, y and radius of a disc that contains the rounded hull [m]."""


class Routes:
    """Ways round the obstacles of an episode for whoever keeps a clearance.

    Args:
        geometry: the obstacles. Shapes that are not pymunk's own count as their bounding boxes.
        clearance: least distance between the walker's centre and any surface [m].
    """

    def __init__(self, geometry: Geometry, clearance: float) -> None:
        self._clearance = clearance
        self._hulls = _hulls(geometry)
        self._nodes, self._owners = _nodes(self._hulls, clearance)

    def towards(self, pos: Floats, targets: Floats) -> Floats:
        """Where to walk now so as to reach each target.

        Args:
            pos: (M, 2) where the walkers are [m].
            targets: (M, 2) where they want to be [m]; one too near to an obstacle means the nearest place clear of it.

        Returns:
            (M, 2) the target itself where the straight way is clear, or where there is no way at all; else the first
            turn of the shortest way [m].
        """
        return np.asarray(
            _first_turns(
                np.ascontiguousarray(pos, dtype=np.float64),
                np.array(targets, dtype=np.float64),
                self._nodes,
                self._owners,
                self._hulls,
                self._clearance,
            )
        )

    def lengths(self, pos: Floats, targets: Floats) -> Floats:
        """(M,) lengths of the ways from (M, 2) to (M, 2) [m], as `towards` leads."""
        here, walked = pos, np.zeros(len(pos))
        for _ in range(len(self._nodes) + 2):  # turns, the target and, where it was moved, that
            ahead = self.towards(here, targets)
            steps = np.hypot(*(ahead - here).T)
            if not steps.any():
                break
            here, walked = ahead, walked + steps
        return walked

    def are_clear(self, pos: Floats, places: Floats) -> NDArray[np.bool_]:
        """(M,) whether walkers at (M, 2) can go straight to these places (M, 2), and keep clear there [m]."""
        return np.asarray(_are_straight(pos, places, self._hulls, self._clearance))

    def outside(self, discs: Floats) -> Routes:
        """The same obstacles and discs that the walkers' centres keep out of, or leave if they are in.

        Args:
            discs: (D, 3) x, y and radius, not less than the clearance [m].
        """
        own, inner, clearance = self._hulls, discs[:, 2] - self._clearance, self._clearance
        discs = np.column_stack([discs[:, :2], inner])
        added = Hulls(first=np.arange(len(discs) + 1), corners=discs[:, :2], radius=inner, discs=discs)
        nodes, owners = _nodes(added, clearance)
        kept, clear = _are_clear(self._nodes, added, clearance), _are_clear(nodes, own, clearance)
        routes = copy(self)
        routes._hulls = Hulls(
            first=np.concatenate([own.first, own.first[-1] + added.first[1:]]),
            corners=np.concatenate([own.corners, added.corners]),
            radius=np.concatenate([own.radius, added.radius]),
            discs=np.concatenate([own.discs, added.discs]),
        )
        routes._nodes = np.concatenate([self._nodes[kept], nodes[clear]])
        routes._owners = np.concatenate([self._owners[kept], len(own.radius) + owners[clear]])
        return routes


def _hulls(geometry: Geometry) -> Hulls:
    shapes = geometry.shapes
    rings = [shapes.corners[first : first + n, :2] for _, _, _, first, n in shapes.table[geometry.static].tolist()]
    radii = [float(shapes.radius[s]) for s in geometry.static]
    for shape, body, _ in geometry.unknown:
        if body < 0:
            box = shape.cache_bb()
            corners = [(box.left, box.bottom), (box.right, box.bottom), (box.right, box.top), (box.left, box.top)]
            rings.append(np.array(corners))
            radii.append(0.0)
    middles = [(ring.min(axis=0) + ring.max(axis=0)) / 2 for ring in rings]
    discs = [
        (*middle, np.hypot(*(ring - middle).T).max() + radius)
        for ring, middle, radius in zip(rings, middles, radii, strict=True)
    ]
    return Hulls(
        first=np.cumsum([0, *map(len, rings)]),
        corners=np.concatenate([*rings, np.empty((0, 2))]),
        radius=np.array(radii),
        discs=np.array(discs).reshape(-1, 3),
    )


def _nodes(hulls: Hulls, clearance: float) -> tuple[Floats, NDArray[np.int64]]:
    """(K, 2) the places round all corners that are clear of every hull [m], (K,) whose corner it is."""
    bearing = 2 * np.pi * np.arange(SIDES) / SIDES
    octagon = np.stack([np.cos(bearing), np.sin(bearing)], axis=1) / np.cos(np.pi / SIDES)
    owner = np.repeat(np.arange(len(hulls.radius)), np.diff(hulls.first))
    reach = (hulls.radius[owner] + clearance) * (1 + SLACK)
    places = (hulls.corners[:, None] + reach[:, None, None] * octagon).reshape(-1, 2)
    clear = _are_clear(places, hulls, clearance)
    return places[clear], np.repeat(owner, SIDES)[clear]


@njit(cache=True)
def _are_clear(places, hulls, clearance):  # type: ignore[no-untyped-def]
    clear = np.ones(len(places), np.bool_)
    for i in range(len(places)):
        for hull in range(len(hulls.radius)):
            disc = hulls.discs[hull]
            if math.hypot(places[i, 0] - disc[0], places[i, 1] - disc[1]) < disc[2] + clearance:
                clear[i] &= _gap(hulls, hull, places[i], places[i]) >= clearance
    return clear


@njit(cache=True)
def _are_straight(pos, places, hulls, clearance):  # type: ignore[no-untyped-def]
    straight = _are_clear(places, hulls, clearance)
    for k in range(len(pos)):
        for hull in range(len(hulls.radius)):
            straight[k] &= not _blocks(hulls, hull, clearance, pos[k], places[k])
    return straight


@njit(cache=True)
def _gap(hulls, hull, a, b):  # type: ignore[no-untyped-def]
    """Distance of the straight way a-b from a rounded hull [m]; at most 0 where it enters."""
    first, end = hulls.first[hull], hulls.first[hull + 1]
    corners = hulls.corners
    least = math.inf
    inside = end - first > 2
    for i in range(first, end):
        j = i + 1 if i + 1 < end else first
        least = min(least, _between(a, b, corners[i], corners[j]))
        edge_x, edge_y = corners[j, 0] - corners[i, 0], corners[j, 1] - corners[i, 1]
        inside &= edge_x * (a[1] - corners[i, 1]) - edge_y * (a[0] - corners[i, 0]) > 0
    return (0.0 if inside else least) - hulls.radius[hull]


@njit(cache=True)
def _between(a, b, c, d):  # type: ignore[no-untyped-def]
    """Distance between the straight lines from a to b and from c to d [m]."""
    if _crosses(a, b, c, d) and _crosses(c, d, a, b):
        return 0.0
    return min(min(_from_line(a, c, d), _from_line(b, c, d)), min(_from_line(c, a, b), _from_line(d, a, b)))


@njit(cache=True)
def _crosses(a, b, c, d):  # type: ignore[no-untyped-def]
    """Whether c and d lie on opposite sides of the line through a and b."""
    x, y = b[0] - a[0], b[1] - a[1]
    return (x * (c[1] - a[1]) - y * (c[0] - a[0])) * (x * (d[1] - a[1]) - y * (d[0] - a[0])) < 0


@njit(cache=True)
def _foot(p, a, b):  # type: ignore[no-untyped-def]
    """The point (x, y) of the straight line from a to b that is nearest to p [m]."""
    x, y = b[0] - a[0], b[1] - a[1]
    square = x * x + y * y
    t = 0.0
    if square > 0:
        t = min(max(((p[0] - a[0]) * x + (p[1] - a[1]) * y) / square, 0.0), 1.0)
    return a[0] + t * x, a[1] + t * y


@njit(cache=True)
def _from_line(p, a, b):  # type: ignore[no-untyped-def]
    x, y = _foot(p, a, b)
    return math.hypot(p[0] - x, p[1] - y)


@njit(cache=True)
def _blocks(hulls, hull, clearance, a, b):  # type: ignore[no-untyped-def]
    """Whether a hull is in the straight way a-b."""
    disc = hulls.discs[hull]
    if _from_line(disc, a, b) >= disc[2] + clearance:
        return False  # most hulls are nowhere near, which the disc that contains one tells cheaply
    gap = _gap(hulls, hull, a, b)
    return gap < clearance and gap < min(_gap(hulls, hull, a, a), _gap(hulls, hull, b, b)) - ROUNDING


@njit(cache=True)
def _length(hulls, heeded, clearance, a, b):  # type: ignore[no-untyped-def]
    """Length of the straight way a-b; infinite if one of the heeded hulls is in it [m]."""
    for hull in range(len(heeded)):
        if heeded[hull] and _blocks(hulls, hull, clearance, a, b):
            return math.inf
    return math.hypot(b[0] - a[0], b[1] - a[1])


@njit(cache=True)
def _heed(hulls, heeded, clearance, a, b):  # type: ignore[no-untyped-def]
    """Heed all hulls that are in the straight way a-b; whether there are any."""
    blocked = False
    for hull in range(len(heeded)):
        if _blocks(hulls, hull, clearance, a, b):
            blocked = heeded[hull] = True
    return blocked


@njit(cache=True)
def _moved_clear(place, hulls, clearance):  # type: ignore[no-untyped-def]
    """The place, moved out of the clearance of the hull that it is nearest to or deepest in."""
    nearest, gap = -1, clearance
    for hull in range(len(hulls.radius)):
        own = _gap(hulls, hull, place, place)
        if own < gap:
            nearest, gap = hull, own
    if nearest < 0:
        return place
    first, end = hulls.first[nearest], hulls.first[nearest + 1]
    inside = end - first > 2 and gap == -hulls.radius[nearest]
    best = math.inf
    out_x, out_y, foot_x, foot_y = 0.0, 1.0, 0.0, 0.0
    for i in range(first, end):
        a, b = hulls.corners[i], hulls.corners[i + 1 if i + 1 < end else first]
        x, y = _foot(place, a, b)
        distance = math.hypot(place[0] - x, place[1] - y)
        if distance >= best:
            continue
        best, foot_x, foot_y = distance, x, y
        out_x, out_y = b[1] - a[1], a[0] - b[0]  # across the edge: for who is inside, or right on it
        if distance > 0 and not inside:
            out_x, out_y = place[0] - x, place[1] - y
    size = math.hypot(out_x, out_y)
    if size == 0.0:
        out_x, out_y, size = 0.0, 1.0, 1.0  # in the very middle of a disc: any side will do
    reach = (hulls.radius[nearest] + clearance) * (1 + SLACK) / size
    return np.array([foot_x + reach * out_x, foot_y + reach * out_y])


@njit(cache=True)
def _first_turns(pos, targets, nodes, owners, hulls, clearance):  # type: ignore[no-untyped-def]
    heeded = np.empty(len(hulls.radius), np.bool_)
    for k in range(len(pos)):
        targets[k] = _moved_clear(targets[k], hulls, clearance)
        heeded[:] = False
        blocked = _heed(hulls, heeded, clearance, pos[k], targets[k])
        while blocked:
            way = _shortest(pos[k], targets[k], nodes, owners, hulls, heeded, clearance)
            if len(way) == 0:
                break
            blocked = _heed(hulls, heeded, clearance, nodes[way[0]], targets[k])
            for i in range(1, len(way)):
                blocked |= _heed(hulls, heeded, clearance, nodes[way[i]], nodes[way[i - 1]])
            blocked |= _heed(hulls, heeded, clearance, pos[k], nodes[way[-1]])
            if not blocked:
                targets[k] = nodes[way[-1]]
    return targets


@njit(cache=True)
def _shortest(start, target, nodes, owners, hulls, heeded, clearance):  # type: ignore[no-untyped-def]
    """Nodes of the shortest way round the heeded hulls, the last first; none if there is no way (A*)."""
    n = len(nodes)
    walked = np.full(n, math.inf)  # shortest way known from the start to a node
    rest = np.empty(n)  # from a node to the target, as the crow flies
    before = np.full(n, -1)
    open_ = np.zeros(n, np.bool_)
    for i in range(n):
        if heeded[owners[i]]:
            open_[i] = True
            walked[i] = _length(hulls, heeded, clearance, start, nodes[i])
            rest[i] = math.hypot(target[0] - nodes[i, 0], target[1] - nodes[i, 1])
    best, last = math.inf, -1
    while True:
        here, least = -1, best
        for i in range(n):
            if open_[i] and walked[i] + rest[i] < least:
                here, least = i, walked[i] + rest[i]
        if here < 0:
            break
        open_[here] = False
        whole = walked[here] + _length(hulls, heeded, clearance, nodes[here], target)
        if whole < best:
            best, last = whole, here
        for i in range(n):
            # no length is worth finding out that would be too long without anything in its way
            if open_[i]:
                crow = math.hypot(nodes[i, 0] - nodes[here, 0], nodes[i, 1] - nodes[here, 1])
                if walked[here] + crow < walked[i]:
                    reached = walked[here] + _length(hulls, heeded, clearance, nodes[here], nodes[i])
                    if reached < walked[i]:
                        walked[i], before[i] = reached, here
    way = np.empty(n, np.int64)
    size = 0
    while last >= 0:
        way[size] = last
        last = before[last]
        size += 1
    return way[:size]
