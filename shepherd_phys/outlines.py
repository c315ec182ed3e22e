"""What solid things look like from above: the hulls of obstacles and of bodies, from the shapes that they build.

A hull is the convex hull of some points (K, 2) [m], grown by a radius [m].
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import lru_cache
from typing import Any

import numpy as np
import pymunk

from shepherd_phys.bodies import Body
from shepherd_phys.obstacles import Obstacle, solid
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
    ground = pymunk.Space().static_body
    given: tuple[Obstacle, ...] = obstacles.value
    return _hulls(shape for index, one in enumerate(given) for shape in solid(one, index, ground))


@lru_cache(maxsize=64)
def of_body(body: Same) -> list[Hull]:
    """The shapes of a `Body` about its centre, nose along the x axis; none of a disc, or of a class not handed over.

    What is not described here is the disc that holds it.
    """
    own: Body | Foreign = body.value
    if isinstance(own, Foreign):
        return []
    hulls = _hulls(own.build()[1])
    is_disc = len(hulls) == 1 and len(hulls[0][0]) == 1 and not hulls[0][0].any()
    return [] if is_disc else hulls


def _hulls(shapes: Iterable[pymunk.Shape]) -> list[Hull]:
    hulls: list[Hull] = []
    for shape in shapes:
        if isinstance(shape, pymunk.Circle):
            hulls.append((np.array([shape.offset], dtype=float), shape.radius))
        elif isinstance(shape, pymunk.Segment):
            hulls.append((np.array([shape.a, shape.b], dtype=float), shape.radius))
        elif isinstance(shape, pymunk.Poly):
            hulls.append((np.array(shape.get_vertices(), dtype=float), shape.radius))
    return hulls
