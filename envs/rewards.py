"""Named reward terms and the paper's three schemes.

A term is ``term(before, after, scan, scenario) -> float``: the states before and after a control step, the scan after
it, and the scenario. It may carry

* ``scans``: names of the scans that it reads: lidar channels ("sheep", "goal", ..) or sets of sheep scanned on their
  own ("wild", "outside"); they are made only where a term asks for them;
* ``shares(before, after, scan, scenario) -> (P,)``: each shepherd's own share, whose mean is the term's value;
* ``earning(scan) -> (P, B)``: lengths of the beams that it pays for [m], infinity for the others, to be drawn.

A scheme is a plain dict ``name -> (weight, term)``; the step's reward is the sum of weight times term, one number for
the whole team. N sheep, T steps of an episode, P shepherds.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from functools import cached_property
from typing import Any, Literal, NamedTuple, Protocol

import numba
import numpy as np
from pydantic import Field

from shepherd_phys.lidar import CHANNELS, Lidar, Scan
from shepherd_phys.scenario import SUCCESS_FRACTION, Scenario
from shepherd_phys.settings import Foreign, Settings, SettingsError, check_call, handed_over, settings, tagged, untagged
from shepherd_phys.state import Floats, WorldState
from shepherd_phys.world import SHEEP_SETS, NonFiniteError


class Term(Protocol):
    """Anything with this call, a plain function too."""

    def __call__(self, before: WorldState, after: WorldState, scan: Scan | None, scenario: Scenario) -> float:
        """The term's value at this step, before its weight."""
        ...


@numba.njit(cache=True)
def _occluding(sheep: Floats, goal: Floats, alpha: float, influence: float, n_steps: int, shares: Floats) -> None:
    """Write the beams (P,) with the sheep's reading (P, B) in [alpha, min(goal's, influence)], over the steps.

    Nothing seen reads infinity.
    """
    for p in range(len(sheep)):
        count = 0
        for b in range(sheep.shape[1]):
            s, g = sheep[p, b], goal[p, b]
            count += 1 if (s >= alpha) & (s <= influence) & (s <= g) & (g < np.inf) else 0
        shares[p] = count / n_steps


def _mean(shares: Floats) -> float:
    """Mean of the shares (P,), 0 where there is no shepherd."""
    return float(shares.mean()) if len(shares) else 0.0


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
        counted = np.empty(after.n_shepherds)
        _occluding(scan[seen], scan[goal], self.alpha, self.influence, scenario.n_steps, counted)
        return counted

    def earning(self, scan: Scan) -> Floats:
        """(P, B) lengths of the beams that count, from the shepherd to the sheep of S [m]; infinity for the others."""
        sheep, goal = (scan[name] for name in self.scans)
        counts = (sheep >= self.alpha) & (sheep <= self.influence) & (sheep <= goal) & (goal < np.inf)
        return np.where(counts, sheep, np.inf)

    def __call__(self, before: WorldState, after: WorldState, scan: Scan | None, scenario: Scenario) -> float:
        """Mean of the shares, 0 where there is no shepherd."""
        return _mean(self.shares(before, after, scan, scenario))


@settings
class Effort(Settings):
    """Mean over the shepherds of speed over top speed, over T: what walking costs. In none of the paper's schemes.

    The speed is what a shepherd walked in the control step over the step's length, so that the term adds up, over an
    episode, to the path length over that of running all the time: 1 at most, but for what pushes a shepherd.
    """

    team: int = Field(default=1, ge=1, le=1000)
    """Shepherds of the smallest team that pays in full; P fewer pay P / ``team`` of it. The work to be done is that of
    the sheep: a lone shepherd must walk for three, and would rather not for the price that three can pay."""

    def shares(self, before: WorldState, after: WorldState, scan: Scan | None, scenario: Scenario) -> Floats:
        """(P,) each shepherd's speed over its top speed, over T; less in small teams."""
        walked = after.shepherd_path - before.shepherd_path
        price = min(after.n_shepherds / self.team, 1.0)
        return np.asarray(walked * price / (after.shepherd_max_speed * (scenario.control_dt * scenario.n_steps)))

    def __call__(self, before: WorldState, after: WorldState, scan: Scan | None, scenario: Scenario) -> float:
        """Mean of the shares, 0 where there is no shepherd."""
        return _mean(self.shares(before, after, scan, scenario))


@settings
class Gathered(Settings):
    """1 / T while the herd is in the goal, all but a few: 1 at most over an episode. In none of the paper's schemes.

    Occupancy pays for the last sheep no more than for any other; this term is the time that is left when the herd is
    home, by the measure of ``time_to_95``.
    """

    fraction: float = Field(default=SUCCESS_FRACTION, gt=0, le=1)
    """Of the sheep that must be in the goal."""

    def __call__(self, before: WorldState, after: WorldState, scan: Scan | None, scenario: Scenario) -> float:
        """0 or 1 / T."""
        return float(np.count_nonzero(after.sheep_in_goal) / after.n_sheep >= self.fraction) / scenario.n_steps


Scheme = Mapping[str, tuple[float, Term]]

ORIGINAL: dict[str, tuple[float, Term]] = {"occupy": (10.0, Occupancy()), "distance": (-0.1, Distance())}
"""The scheme of the work that the paper extends: no occlusion term."""
ANY: dict[str, tuple[float, Term]] = {**ORIGINAL, "occlude": (0.1, Occlusion(sheep="any"))}
"""The paper's "Any Sheep"."""
WILD: dict[str, tuple[float, Term]] = {**ORIGINAL, "occlude": (0.1, Occlusion(sheep="wild"))}
"""The paper's "Wild Sheep"."""
SCHEMES: dict[str, Scheme] = {"original": ORIGINAL, "any": ANY, "wild": WILD}
"""By name, for ``gymnasium.make`` and the command line."""
TERMS: dict[str, type[Any]] = {term.__name__: term for term in (Occupancy, Distance, Occlusion, Effort, Gathered)}
"""The library's terms by name, for files."""


def checked(rewards: Scheme | str) -> Scheme:
    """A scheme from its name or from a mapping name -> (finite weight, callable term).

    Raises:
        SettingsError: it is neither.
    """
    if isinstance(rewards, str):
        if rewards not in SCHEMES:
            raise SettingsError(f"rewards: {rewards!r} is not one of {', '.join(SCHEMES)}")
        return SCHEMES[rewards]
    if not isinstance(rewards, Mapping):
        raise SettingsError(f"rewards: needs a scheme's name or a mapping name -> (weight, term) (given: {rewards!r})")
    scheme = {}
    for name, pair in rewards.items():
        try:
            weight, term = pair
            scheme[str(name)] = (float(weight), term)
        except (OverflowError, TypeError, ValueError):
            raise SettingsError(
                f"rewards[{name!r}]: needs a number and a term, (weight, term) (given: {pair!r})"
            ) from None
    for name, (weight, term) in scheme.items():
        if isinstance(term, Foreign):
            raise term.missing()
        if not callable(term) or not np.isfinite(weight):
            raise SettingsError(
                f"rewards[{name!r}]: needs a finite weight and a callable term (given: {weight}, {term!r})"
            )
        if isinstance(term, type):
            raise SettingsError(f"rewards[{name!r}]: a class was given; make one of it: {term.__name__}()")
        check_call(term, ("before", "after", "scan", "scenario"), f"rewards[{name!r}]")
    return scheme


def to_table(scheme: Scheme) -> dict[str, dict[str, Any]]:
    """A scheme as plain data: name -> ``weight`` and ``term``.

    Raises:
        SettingsError: a term does not tell its parameters.
    """
    return {name: {"weight": weight, "term": tagged(term)} for name, (weight, term) in scheme.items()}


def from_table(table: Mapping[str, Any], classes: Iterable[Any], where: str) -> dict[str, tuple[float, Any]]:
    """The scheme that `to_table` wrote; a term that is a user's own and not among ``classes`` is a `Foreign`.

    Raises:
        SettingsError: it is none; ``where`` is the name of the field.
    """
    known = TERMS | handed_over(classes)
    scheme = {}
    for name, row in table.items():
        if not isinstance(row, Mapping) or set(row) != {"weight", "term"}:
            raise SettingsError(f"{where}.{name}: needs a table with weight and term (given: {row!r})")
        scheme[name] = (row["weight"], untagged(row["term"], known, f"{where}.{name}.term"))
    return scheme


def scans_for(scheme: Scheme, lidar: Lidar | None) -> tuple[Lidar | None, tuple[str, ...]]:
    """What `World.scan` is to be asked for so that one scan serves observation and rewards.

    Args:
        scheme: the reward's terms.
        lidar: what is observed, if anything is.

    Returns:
        the lidar with every channel that either of them reads, None where nothing asks for a scan; and the sets of
        sheep to scan on their own.

    Raises:
        SettingsError: a term asks for a scan that there is not.
    """
    wanted = [name for _, term in scheme.values() for name in getattr(term, "scans", ())]
    unknown = [name for name in wanted if name not in (*CHANNELS, *SHEEP_SETS)]
    if unknown:
        raise SettingsError(f"rewards: there is no scan {unknown[0]!r}; there are {(*CHANNELS, *SHEEP_SETS)}")
    sets = tuple(name for name in SHEEP_SETS if name in wanted)
    seen = lidar.channels if lidar is not None else ()
    channels = tuple(name for name in CHANNELS if name in wanted or name in seen)
    if sets and not channels:
        channels = CHANNELS[:1]  # a lidar has at least one channel
    return ((lidar or Lidar()).but(channels=channels) if channels else None), sets


def earning_beams(scheme: Scheme, scan: Scan | None) -> Floats | None:
    """(P, B) lengths of the beams for which a scheme pays [m], infinity for the others; None where it pays for none."""
    lengths = [term.earning(scan) for _, term in scheme.values() if scan is not None and hasattr(term, "earning")]
    return np.asarray(np.minimum.reduce(lengths)) if lengths else None


class Earned(NamedTuple):
    """What one term of a scheme gave in a control step."""

    name: str
    weight: float
    value: float
    """Weighted, for the whole team."""
    shares: list[float] | None
    """Each shepherd's own, not weighted; None for a term without shares."""


def earned(
    scheme: Scheme, before: WorldState, after: WorldState, scan: Scan | None, scenario: Scenario
) -> list[Earned]:
    """Ask every term of a scheme; the reward of the step is the sum of the values, in this order.

    Raises:
        ValueError: a term gave something that is no number, or, as `NonFiniteError`, not a finite one.
    """
    terms = []
    for name, (weight, term) in scheme.items():
        own: list[float] | None = None
        if hasattr(term, "shares"):
            shares = np.asarray(term.shares(before, after, scan, scenario))
            if shares.shape != (after.n_shepherds,):
                raise ValueError(
                    f"rewards[{name!r}].shares: needs shape ({after.n_shepherds},) (given: {shares.shape})"
                )
            own = shares.tolist()
            value = sum(own) / max(len(own), 1)
        else:
            value = term(before, after, scan, scenario)
        try:
            weighted = weight * float(value)
        except (TypeError, ValueError):
            raise ValueError(f"rewards[{name!r}]: the term must give a number (given: {value!r})") from None
        if not math.isfinite(weighted):
            raise NonFiniteError(f"rewards[{name!r}]: the term gave {value}, which is not finite")
        terms.append(Earned(name, weight, weighted, own))
    return terms
