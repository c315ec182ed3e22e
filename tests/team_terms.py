"""Reward terms and scenarios for tests of the team's vector env: of a module, so that workers can import them."""

import os
import time
from dataclasses import dataclass

from shepherd_phys.scenario import Scenario

SMALL = Scenario(n_sheep=6, n_flocks=2, shepherds=2, n_steps=12)
"""A world whose steps cost little."""


@dataclass(frozen=True)
class Constant:
    """The same reward at every control step."""

    value: float = 1.0

    def __call__(self, before, after, scan, scenario):
        return self.value


@dataclass(frozen=True)
class Fails:
    """Raises, or leaves without a word, once a world has made so many steps."""

    step: int
    dies: bool = False

    def __call__(self, before, after, scan, scenario):
        if after.step >= self.step:
            if self.dies:
                os._exit(3)
            raise ValueError("the wolf\ncame")
        return 0.0


@dataclass(frozen=True)
class Slow:
    """Takes its time."""

    seconds: float

    def __call__(self, before, after, scan, scenario):
        time.sleep(self.seconds)
        return 0.0


def alternating(rng, index):
    """A scenario drawn anew each episode."""
    return SMALL.but(n_flocks=int(rng.integers(1, 4)), n_steps=int(rng.integers(5, 9)))


def no_scenario(rng, index):
    return "meadow"


class Unreadable:
    """Can be sent, but not taken out of its parcel."""

    def __reduce__(self):
        return (_refuse, ())

    def __call__(self, before, after, scan, scenario):
        return 0.0


def _refuse():
    raise ImportError("no such module here")
