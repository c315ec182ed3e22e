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
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from shepherd_phys.settings import settings
from shepherd_phys.state import Floats, WorldState, unit

from .formation import WEDGE, SubFlocks, Team, TeamSettings, bearing_of, heading, wrapped


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


class Occlusion(Team):
    """The team: a sub-flock for each shepherd, a terminal rule.

    Args:
        settings: its lengths; `TUNED` unless given.
    """

    def __init__(self, settings: OcclusionSettings | None = None) -> None:
        self.settings = settings or TUNED
        super().__init__(self.settings)

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
        return occlusion_targets(pos, state.goal_pos, own, radii, extents + s.approach, s.circle)

    def _way(self, state: WorldState, targets: Floats, flocks: SubFlocks) -> Floats:
        return targets  # circling is part of the method


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
    pos: Floats, goal: Floats, centers: Floats, radii: Floats, approach: Floats, circle: float
) -> Floats:
    """(P, 2) where each shepherd goes: at its flock, or on round it [m].

    Args:
        pos: (P, 2) shepherds S [m].
        goal: (2,) g [m].
        centers: (P, 2) centroid c of each one's sub-flock [m].
        radii: (P,) R_c [m].
        approach: (P,) from c, when the goal is occluded [m].
        circle: beyond R_c, when it is not [m].
    """
    to_flock, to_goal = centers - pos, goal - pos
    distance = np.hypot(*to_flock.T)
    beta = wrapped(bearing_of(to_goal) - bearing_of(to_flock))
    occluded = (np.abs(beta) < np.arctan2(radii, distance)) & (np.hypot(*to_goal.T) > distance)
    bearing = bearing_of(-to_flock)
    on = bearing + np.where(beta < 0, -WEDGE, WEDGE)
    return np.asarray(
        centers
        + np.where(
            occluded[:, None],
            approach[:, None] * heading(bearing),
            (radii + circle)[:, None] * heading(on),
        )
    )
