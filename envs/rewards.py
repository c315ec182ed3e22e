"""Named reward terms and the paper's three schemes.

A term is ``term(before, after, scan, scenario) -> float``: the states before and after a control step, the scan after
it, and the scenario. It may carry

* ``scans``: names of the scans that it reads: lidar channels ("sheep", "goal", ..) or sets of sheep scanned on their
  own ("wild", "outside"); they are made only where a term asks for them;
* ``shares(before, after, scan, scenario) -> (P,)``: each shepherd's own share, whose mean is the term's value.

A scheme is a plain dict ``name -> (weight, term)``; the step's reward is the sum of weight times term, one number for
the whole team. N sheep, T steps of an episode, P shepherds.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from typing import Literal, Protocol

import numba
import numpy as np
from pydantic import Field

from shepherd_phys.lidar import Scan
from shepherd_phys.scenario import Scenario
from shepherd_phys.settings import Settings, settings
from shepherd_phys.state import Floats, WorldState


class Term(Protocol):
    """Anything with this call, a plain function too."""

    def __call__(self, before: WorldState, after: WorldState, scan: Scan | None, scenario: Scenario) -> float:
        """The term's value at this step, before its weight."""
        ...


@numba.njit(cache=True)
def _occluding(sheep: Floats, goal: Floats, alpha: float, influence: float) -> Floats:
    """Beams (P,) with the sheep's reading (P, B) in [alpha, min(goal's, influence)]; nothing seen reads infinity."""
    counts = np.zeros(len(sheep))
    for p in range(len(sheep)):
        count = 0
        for b in range(sheep.shape[1]):
            s, g = sheep[p, b], goal[p, b]
            count += 1 if (s >= alpha) & (s <= influence) & (s <= g) & (g < np.inf) else 0
        counts[p] = count
    return counts


@settings
class Occupancy(Settings):
    """Sheep inside the goal, over N T: r_occupy of the paper. 1 / T at most, 1 over an episode."""

    def __call__(self, before: WorldState, after: WorldState, scan: Scan | None, scenario: Scenario) -> float:
        """In [0, 1 / T]."""
        return float(np.count_nonzero(after.sheep_in_goal)) / (after.n_sheep * scenario.n_steps)


@settings
class Distance(Settings):
    """Sum over the sheep outside the goal of 1 + d_i, d_i the distance to its border [m]: r_distance of the paper."""

    norm: Literal["NT", "T", "none"] = "NT"
    """Divisor. The paper prints none, which makes this term 1e5 times the others; N T is what occupancy has."""

    def __call__(self, before: WorldState, after: WorldState, scan: Scan | None, scenario: Scenario) -> float:
        """Not negative."""
        outside = after.n_sheep - np.count_nonzero(after.sheep_in_goal)
        total = float(outside + np.add.reduce(after.sheep_goal_distance))  # d_i is 0 inside
        if self.norm == "none":
            return total
        return total / (scenario.n_steps * (after.n_sheep if self.norm == "NT" else 1))


@settings
class Occlusion(Settings):
    """Beams along which sheep of a set S stand before the goal at a useful distance: r_occlude, eq. 2 and 3.

    A beam of shepherd p counts when both the goal and S are hit along it and the first hit on S lies in
    [alpha, min(d_goal, I)]. The term is the number of such beams over P T; it is not divided by the number of beams.
    """

    sheep: Literal["any", "wild"] = "wild"
    """S: all sheep, or the wild ones."""
    wild_mode: Literal["ever", "current"] = "ever"
    """Wild are the sheep that have never been in the goal ("ever"), or those outside it now ("current")."""
    alpha: float = Field(default=2.0, ge=0)
    """Least useful distance [m]; without it shepherds learn to walk into the flock."""
    influence: float = Field(default=10.0, gt=0)
    """I, the shepherds' radius of influence [m]."""

    @cached_property
    def scans(self) -> tuple[str, ...]:
        """The scan of S, and the goal's."""
        if self.sheep == "any":
            return ("sheep", "goal")
        return ("wild" if self.wild_mode == "ever" else "outside", "goal")

    def shares(self, before: WorldState, after: WorldState, scan: Scan | None, scenario: Scenario) -> Floats:
        """(P,) each shepherd's beams that count, over T."""
        if scan is None:
            raise ValueError("the occlusion term needs a scan")
        seen, goal = self.scans
        counted: Floats = _occluding(scan[seen], scan[goal], self.alpha, self.influence) / scenario.n_steps
        return counted

    def __call__(self, before: WorldState, after: WorldState, scan: Scan | None, scenario: Scenario) -> float:
        """Mean of the shares, 0 where there is no shepherd."""
        shares = self.shares(before, after, scan, scenario)
        return float(shares.mean()) if len(shares) else 0.0


Scheme = Mapping[str, tuple[float, Term]]

ORIGINAL: dict[str, tuple[float, Term]] = {"occupy": (10.0, Occupancy()), "distance": (-0.1, Distance())}
"""The scheme of the work that the paper extends: no occlusion term."""
ANY: dict[str, tuple[float, Term]] = {**ORIGINAL, "occlude": (0.1, Occlusion(sheep="any"))}
"""The paper's "Any Sheep"."""
WILD: dict[str, tuple[float, Term]] = {**ORIGINAL, "occlude": (0.1, Occlusion(sheep="wild"))}
"""The paper's "Wild Sheep"."""
SCHEMES: dict[str, Scheme] = {"original": ORIGINAL, "any": ANY, "wild": WILD}
"""By name, for ``gymnasium.make`` and the command line."""
