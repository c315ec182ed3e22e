"""`Mixture`: another scenario for every episode, so that a policy meets more than one."""

from __future__ import annotations

from typing import Annotated, Any

import numpy as np
from pydantic import BeforeValidator, Field

from shepherd_phys.lidar import Channel
from shepherd_phys.scenario import Scenario
from shepherd_phys.settings import Settings, settings


def _ordered(value: Any) -> Any:
    if isinstance(value, list | tuple) and len(value) == 2 and value[0] > value[1]:
        raise ValueError("the smaller number comes first")
    return value


Count = Annotated[int, Field(ge=1)]


@settings
class Mixture(Settings):
    """Draws scenarios for `shepherd_phys.envs.team.TeamVecEnv`: from each range uniformly, ends included."""

    base: Scenario = Scenario()
    """All that is not drawn here, the range of the flocks' distances among it."""
    n_flocks: Annotated[tuple[Count, Count], BeforeValidator(_ordered)] = (1, 8)
    """Least and most flocks."""
    n_neighbours: Annotated[tuple[Count, Count], BeforeValidator(_ordered)] | None = (3, 85)
    """Least and most neighbours n to whom a sheep is drawn, the paper's cohesion; None: as in the base, whose flock
    model need not have an ``n_neighbours``."""

    uneven: float = Field(default=0.0, ge=0, le=1)
    """Fraction of the episodes whose flocks differ in size: one sheep each, and the others by shares that are drawn
    uniformly from all that there are. In the rest they are equal."""

    def __post_init__(self) -> None:
        if self.n_flocks[1] > self.base.n_sheep:
            raise ValueError(f"n_flocks may be {self.n_flocks[1]}, more than there are sheep ({self.base.n_sheep})")
        if self.base.flock_sizes is not None:
            raise ValueError(f"base.flock_sizes: a mixture draws its own (given: {self.base.flock_sizes})")
        if self.n_neighbours is not None and not hasattr(self.base.flock, "n_neighbours"):
            raise ValueError(f"n_neighbours: {type(self.base.flock).__name__} has none; give None")

    @property
    def channels(self) -> tuple[Channel, ...]:
        """What shepherds observe unless somebody says otherwise; see `Scenario.channels`."""
        return self.base.channels

    def __call__(self, rng: np.random.Generator, index: int) -> Scenario:
        """The scenario of the next episode; the world's index plays no part."""
        n_flocks = int(rng.integers(*self.n_flocks, endpoint=True))
        flock = self.base.flock
        if self.n_neighbours is not None:
            flock = flock.but(n_neighbours=int(rng.integers(*self.n_neighbours, endpoint=True)))
        sizes = None
        if self.uneven and rng.random() < self.uneven:
            others = rng.multinomial(self.base.n_sheep - n_flocks, rng.dirichlet(np.ones(n_flocks)))
            sizes = tuple(int(1 + more) for more in others)
        return self.base.but(n_flocks=n_flocks, flock=flock, flock_sizes=sizes)
