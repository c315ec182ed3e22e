"""Gymnasium and PettingZoo environments on the simulated world. Importing this package registers ``Shepherding-v0``.

``gymnasium.make("shepherd_phys.envs:Shepherding-v0")`` imports it by itself. What needs a learning library,
`shepherd_phys.envs.team`, is imported by its own name.
"""

import gymnasium

from .parallel import ShepherdingParallelEnv
from .rewards import ANY, ORIGINAL, SCHEMES, WILD
from .shepherding import ShepherdingEnv

__all__ = ["ANY", "ORIGINAL", "SCHEMES", "WILD", "ShepherdingEnv", "ShepherdingParallelEnv"]

# no max_episode_steps: it would wrap the env in a TimeLimit, and the env truncates itself
gymnasium.register(id="Shepherding-v0", entry_point="shepherd_phys.envs.shepherding:ShepherdingEnv")
