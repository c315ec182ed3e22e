"""What solid things look like from above: the hulls of obstacles and of bodies, from the shapes that they build.

A hull is the convex hull of some points (K, 2) [m], grown by a radius [m].
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
import pymunk

from shepherd_phys.bodies import Body
from shepherd_phys.obstacles import Obstacle, Outline, outline, outlines
from shepherd_phys.settings import Foreign
from shepherd_phys.state import Floats

Hull = tuple[Floats, float]


class Same:
    """Makes any object a key of a cache, equal to itself alone: a user's obstacle need not be hashable."""

    def __init__(self, value: Any) -> None:
        self.value = value

    def __hash__(self) -> int:
        return id(self.value)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Same) and other.value is self.value


@lru_cache(maxsize=16)
def of_obstacles(obstacles: Same) -> list[Hull]:
    """Every shape of a tuple of obstacles, whatever class they are of, in world coordinates."""
    given: tuple[Obstacle, ...] = obstacles.value
    return [(drawn.points, drawn.radius) for index, one in enumerate(given) for drawn in outlines(one, index)]


@lru_cache(maxsize=64)
def of_body(body: Same) -> list[Hull]:
    """The shapes of a `Body` about its centre, nose along the x axis; none of a disc, or of a class not handed over.

    What is not described here is the disc that holds it.
    """
    own: Body | Foreign = body.value
    if isinstance(own, Foreign):
        return []
    drawn = [one for one in map(outline, own.build()[1]) if one is not None]
    is_disc = len(drawn) == 1 and len(drawn[0].points) == 1 and not drawn[0].points.any()
    return [] if is_disc else [(one.points, one.radius) for one in drawn]


def edge(drawn: Outline, arc: int = 24, *beside: Floats) -> Floats:
    """Corners (K, 2) of an outline as one polygon, counter-clockwise [m].

    Args:
        drawn: the outline.
        arc: corners of a full turn of what is round.
        beside: further points (2,) [m] that the polygon has to hold.
    """
    turns = np.linspace(0.0, 2 * np.pi, arc, endpoint=False)
    ring = drawn.radius * np.stack([np.cos(turns), np.sin(turns)], axis=1)
    grown = (drawn.points[:, None] + ring).reshape(-1, 2) if drawn.radius else drawn.points
    points = [*grown.tolist(), *(point.tolist() for point in beside)]
    return np.array(pymunk.Poly(None, points).get_vertices())  # which takes their convex hull, in order
