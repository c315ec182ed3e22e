"""What a controller is: anything that moves the shepherds."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from shepherd_phys.lidar import Lidar
from shepherd_phys.state import WorldState


class Controller(Protocol):
    """Anything that moves the shepherds: heuristics read the state, policies read the observation.

    A heuristic sets ``lidar = None``: then no scan is made for it, and it runs several times faster.
    """

    @property
    def lidar(self) -> Lidar | None:
        """The lidar settings that its observations need; None if it needs none."""
        ...

    def reset(self, rng: np.random.Generator) -> None:
        """Begin an episode; every random draw of the controller comes from ``rng``."""
        ...

    def act(self, observation: NDArray[np.float32], state: WorldState) -> NDArray[np.float64]:
        """(P, 2) wanted velocities over top speed, in [-1, 1], world axes.

        Args:
            observation: as the env's docstring specifies; empty, (P, 0), without lidar.
            state: the world's latest state.
        """
        ...
