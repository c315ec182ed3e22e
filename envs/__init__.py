"""Gymnasium environments on the simulated world. Importing this package registers ``Shepherding-v0``.

``gymnasium.make("shepherd_phys.envs:Shepherding-v0")`` imports it by itself.
"""

import gymnasium

from .rewards import ANY, ORIGINAL, SCHEMES, WILD
from .shepherding import ShepherdingEnv

__all__ = ["ANY", "ORIGINAL", "SCHEMES", "WILD", "ShepherdingEnv"]

# no max_episode_steps: it would wrap the env in a TimeLimit, and the env truncates itself
gymnasium.register(id="Shepherding-v0", entry_point="shepherd_phys.envs.shepherding:ShepherdingEnv")
