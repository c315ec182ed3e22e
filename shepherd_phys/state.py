"""`WorldState`: one frozen reading of the world, which everything else reads; and measures of a flock."""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from shepherd_phys.geometry import Geometry, surfaces
from shepherd_phys.obstacles import Obstacle

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class WorldState:
    """What the world is at the end of a control step.

    The arrays are read-only and belong to this state alone. N sheep, P shepherds; metres, seconds, radians.
    """

    step: int
    """Control steps since reset."""
    time: float
    """Seconds since reset."""
    goal_pos: Floats
    """(2,) centre g of the goal disc [m]."""
    goal_radius: float
    """R [m]."""
    sheep_pos: Floats
    """(N, 2) centres A_i [m]."""
    sheep_vel: Floats
    """(N, 2) velocities as the bodies have them [m/s]."""
    sheep_heading: Floats
    """(N, 2) unit vectors H_i: the last commanded directions."""
    sheep_goal_distance: Floats
    """(N,) distance of each centre to the goal's border [m], 0 inside."""
    sheep_in_goal: Bools
    """(N,) whether the centre lies in the goal now: |A_i - g| <= R."""
    sheep_arrived: Bools
    """(N,) whether the sheep has ever been in the goal; the others are wild."""
    sheep_radius: Floats
    """(N,) radius of the disc round each centre that holds its body [m]."""
    sheep_max_speed: Floats
    """(N,) speed of a moving sheep [m/s]."""
    shepherd_pos: Floats
    """(P, 2) [m]."""
    shepherd_vel: Floats
    """(P, 2) [m/s]."""
    shepherd_angle: Floats
    """(P,) orientation of the body [rad]; 0 for a disc."""
    shepherd_radius: Floats
    """(P,) radius of the disc round each centre that holds its body [m]."""
    shepherd_max_speed: Floats
    """(P,) [m/s]."""
    shepherd_path: Floats
    """(P,) length walked since reset [m]: summed displacement over control steps."""
    collisions: int
    """New contacts of a shepherd with an obstacle or another shepherd since reset, over the team."""
    obstacles: tuple[Obstacle, ...]
    """The solid things of this episode."""
    control_dt: float = 0.2
    """Length of a control step [s]."""

    @property
    def n_sheep(self) -> int:
        """N."""
        return len(self.sheep_pos)

    @property
    def n_shepherds(self) -> int:
        """P."""
        return len(self.shepherd_pos)

    @cached_property
    def surroundings(self) -> Geometry:
        """The obstacles as surfaces: distances from points, and shapes for kernels.

        The world's states share one for the whole episode.
        """
        return surfaces(self.obstacles)

    @classmethod
    def of(cls, values: dict[str, Any]) -> WorldState:
        """The state of all fields by name, which is kept and not copied.

        A frozen dataclass assigns field by field, which costs more than everything else in a state; the world makes
        one each step and takes this way instead.
        """
        state = object.__new__(cls)
        object.__setattr__(state, "__dict__", values)
        return state

    def but(self, **changes: Any) -> WorldState:
        """A copy with some fields changed; arrays are copied and made read-only."""
        values = {f.name: getattr(self, f.name) for f in fields(self)}
        for name, value in changes.items():
            if name not in values:
                raise TypeError(f"WorldState has no field {name!r}")
            if isinstance(values[name], np.ndarray):
                value = frozen(np.array(value, dtype=values[name].dtype))
            values[name] = value
        return WorldState(**values)


def frozen(array: NDArray[Any]) -> NDArray[Any]:
    """The same array, read-only from now on."""
    array.setflags(write=False)
    return array


def centroid(points: Floats) -> Floats:
    """Mean position, Strömbom's GCM when given the whole flock: (K, 2) -> (2,)."""
    return np.asarray(np.add.reduce(points, axis=0) / len(points))  # as points.mean(axis=0), in a third of the time


def unit(vectors: Floats) -> Floats:
    """Vectors (..., 2) scaled to length 1; a vector of length 0 stays 0."""
    length = np.hypot(vectors[..., 0], vectors[..., 1])[..., None]
    length[length == 0.0] = 1.0
    return np.asarray(vectors / length)


@numba.njit(cache=True)
def sub_flocks(points, link):  # type: ignore[no-untyped-def]
    """Single linkage: sheep less than ``link`` apart, directly or over others, share a label.

    Args:
        points: (K, 2) positions [m].
        link: [m].

    Returns:
        (K,) labels 0, 1, .. in the order of each sub-flock's first member.
    """
    n = len(points)
    label = np.full(n, -1, np.int64)
    waiting = np.empty(n, np.int64)
    count = 0
    for first in range(n):
        if label[first] >= 0:
            continue
        label[first] = count
        waiting[0] = first
        size = 1
        while size > 0:
            size -= 1
            i = waiting[size]
            for j in range(n):
                if label[j] < 0:
                    dx, dy = points[j, 0] - points[i, 0], points[j, 1] - points[i, 1]
                    if dx * dx + dy * dy < link * link:
                        label[j] = count
                        waiting[size] = j
                        size += 1
        count += 1
    return label
