"""Hand-made states for tests of controllers."""

import numpy as np

from shepherd_phys.controllers.formation import SubFlocks
from shepherd_phys.scenario import Scenario
from shepherd_phys.world import World

NOTHING = np.empty(0, dtype=np.float32)
"""What a heuristic observes."""


def arranged(sheep, shepherds, goal=(0.0, 0.0)):
    """A state with sheep and shepherds at these places."""
    sheep, shepherds = np.array(sheep, float), np.array(shepherds, float)
    template = World(Scenario(n_sheep=len(sheep), n_flocks=1, shepherds=len(shepherds))).reset(0)
    away = np.linalg.norm(sheep - goal, axis=1)
    return template.but(
        sheep_pos=sheep,
        shepherd_pos=shepherds,
        goal_pos=goal,
        sheep_goal_distance=np.maximum(away - 2.5, 0.0),
        sheep_in_goal=away <= 2.5,
        sheep_arrived=away <= 2.5,
    )


def one_flock(sheep, goal=(0.0, 0.0)):
    """All these sheep as the only sub-flock out."""
    sheep = np.array(sheep, float)
    return SubFlocks([sheep], sheep.mean(axis=0)[None], np.hypot(*(sheep - goal).T).max(keepdims=True))
