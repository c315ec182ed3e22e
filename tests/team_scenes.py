"""What tests of the team's vector env share; terms and scenarios of a module, so that workers can import them."""

import os
import time
from dataclasses import dataclass

import numpy as np

from shepherd_phys.envs import _critic as critic
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


def episode_seeds(root, number, world):
    """The seeds of a world's episodes."""
    seeds, *_ = np.random.SeedSequence(root, spawn_key=(number, world)).spawn(3)
    generator = np.random.default_rng(seeds)
    while True:
        yield int(generator.integers(2**63))


def view(state, angle, mirrored=False):
    """What the critic sees of a state, (P, 101)."""
    seen = np.full((state.n_shepherds, critic.N_NUMBERS), np.nan, np.float32)
    critic.whole_world(state, np.array(angle, float), np.full(len(seen), mirrored), seen)
    return seen
