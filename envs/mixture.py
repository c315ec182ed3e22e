"""`Mixture`: another scenario for every episode, so that a policy meets more than one."""

from __future__ import annotations

import math
from typing import Annotated, Any

import numpy as np
from pydantic import AfterValidator, Field

from shepherd_phys.layouts import Scattered
from shepherd_phys.lidar import Channel
from shepherd_phys.scenario import Scenario, with_neighbours
from shepherd_phys.settings import Settings, settings


def _ordered(value: tuple[Any, Any]) -> tuple[Any, Any]:
    if value[0] > value[1]:
        raise ValueError("the smaller number comes first")
    return value


Count = Annotated[int, Field(ge=1)]
Fraction = Annotated[float, Field(ge=0, le=0.5)]


@settings
class Mixture(Settings):
    """Draws scenarios for `shepherd_phys.envs.team.TeamVecEnv`: from each range uniformly, ends included."""

    base: Scenario = Scenario()
    """All that is not drawn here, the range of the flocks' distances among it."""
    n_flocks: Annotated[tuple[Count, Count], AfterValidator(_ordered)] = (1, 8)
    """Least and most flocks."""
    n_neighbours: Annotated[tuple[Count, Count], AfterValidator(_ordered)] | None = (3, 85)
    """Least and most neighbours n to whom a sheep is drawn, the paper's cohesion; None: as in the base, whose flock
    model need not have an ``n_neighbours``."""

    n_sheep: Annotated[tuple[Count, Count], AfterValidator(_ordered)] | None = None
    """Least and most sheep, drawn with their logarithm uniform; the goal's area grows and shrinks with their number.
    None: as in the base."""
    others: tuple[Scenario, ...] = ()
    """Each episode's base is the base or one of these, all with the same probability."""
    density: Annotated[tuple[Fraction, Fraction], AfterValidator(_ordered)] | None = None
    """Least and largest part of the box that obstacles cover where a base's layout is `Scattered`; None: its own."""
    uneven: float = Field(default=0.0, ge=0, le=1)
    """Fraction of the episodes whose flocks differ in size: one sheep each, and the others by shares that are drawn
    uniformly from all that there are. In the rest they are equal."""

    def __post_init__(self) -> None:
        for base in self.bases:
            fewest = base.n_sheep if self.n_sheep is None else self.n_sheep[0]
            if self.n_flocks[1] > fewest:
                raise ValueError(f"n_flocks may be {self.n_flocks[1]}, more than there are sheep ({fewest})")
            if base.flock_sizes is not None:
                raise ValueError(f"base.flock_sizes: a mixture draws its own (given: {base.flock_sizes})")
            if self.n_neighbours is not None and not hasattr(base.flock, "n_neighbours"):
                raise ValueError(f"n_neighbours: {type(base.flock).__name__} has none; give None")
        if self.density is not None and not any(isinstance(base.layout, Scattered) for base in self.bases):
            raise ValueError(f"density: no base scatters obstacles (given: {self.density})")

    @property
    def bases(self) -> tuple[Scenario, ...]:
        """All of which one is drawn."""
        return (self.base, *self.others)

    @property
    def channels(self) -> tuple[Channel, ...]:
        """What shepherds observe unless somebody says otherwise; see `Scenario.channels`."""
        return max((base.channels for base in self.bases), key=len)

    def __call__(self, rng: np.random.Generator, index: int) -> Scenario:
        """The scenario of the next episode; the world's index plays no part."""
        n_flocks = int(rng.integers(*self.n_flocks, endpoint=True))
        base = self.bases[int(rng.integers(len(self.bases)))] if self.others else self.base
        if self.n_sheep is not None:
            base = _with_sheep(base, _between(rng, *self.n_sheep))
        if self.n_neighbours is not None:
            base = with_neighbours(base, int(rng.integers(*self.n_neighbours, endpoint=True)))
        if self.density is not None and isinstance(base.layout, Scattered):
            base = _with_density(base, float(rng.uniform(*self.density)))
        sizes = None
        if self.uneven and rng.random() < self.uneven:
            others = rng.multinomial(base.n_sheep - n_flocks, rng.dirichlet(np.ones(n_flocks)))
            sizes = tuple(int(1 + more) for more in others)
        return base.but(n_flocks=n_flocks, flock_sizes=sizes)

    def extremes(self) -> list[Scenario]:
        """Each base with the most sheep and obstacles that are drawn: what finds no room at all shows here."""
        found = []
        for base in self.bases:
            if self.n_sheep is not None:
                base = _with_sheep(base, self.n_sheep[1])
            if self.density is not None and isinstance(base.layout, Scattered):
                base = _with_density(base, self.density[1])
            found.append(base)
        return found


def _with_sheep(base: Scenario, n: int) -> Scenario:
    """As many sheep, and the goal's area with them."""
    return base.but(n_sheep=n, goal_radius=base.goal_radius * math.sqrt(n / base.n_sheep))


def _with_density(base: Scenario, density: float) -> Scenario:
    return base.but(layout=base.layout.but(count=None, density=density))


def _between(rng: np.random.Generator, least: int, most: int) -> int:
    """A number of either end or between; twice as many are as likely as half as many."""
    drawn = math.exp(rng.uniform(math.log(least), math.log(most)))
    return min(max(round(drawn), least), most)
