"""`ShepherdingParallelEnv`: the world of `shepherd_phys.envs.ShepherdingEnv` for multi-agent libraries (PettingZoo)."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray
from pettingzoo import ParallelEnv

from shepherd_phys.lidar import Lidar
from shepherd_phys.observation import turn
from shepherd_phys.scenario import Scenario
from shepherd_phys.settings import SettingsError
from shepherd_phys.state import WorldState

from .rewards import Scheme, checked
from .shepherding import ShepherdingEnv

Observations = dict[str, NDArray[np.float32]]
Infos = dict[str, dict[str, Any]]


class ShepherdingParallelEnv(ParallelEnv[str, NDArray[np.float32], NDArray[np.float32]]):
    """A team of shepherds, each an agent of its own: a PettingZoo parallel environment.

    ## Agents

    ``shepherd_0`` .. ``shepherd_<P-1>``. They step together and end together: after an episode ``agents`` is
    empty.

    ## Spaces

    Those of one row of `ShepherdingEnv`'s: observation ``Box(0, 1, (stack x channels, columns), float32)``, action
    ``Box(-1, 1, (2,), float32)``, the wanted velocity over the top speed, longer than 1 clipped to the unit disc.

    The action is in the frame of the observation: in world axes, x right, y up; with ``Lidar(frame="goal")`` relative
    to beam 0, which points at the goal, and turned back here. (`ShepherdingEnv`'s own actions stay in world axes.)

    ## Rewards

    ``credit="team"``: `ShepherdingEnv`'s reward, the same number for each. ``"own"``: a term that has shares gives each
    shepherd its own share in place of their mean.

    ## Start and end of an episode

    ``reset(seed=s)`` gives the episode that `ShepherdingEnv` gives for s. It is truncated for all after T control
    steps, or terminated for all where the scenario has ``terminate_on_success``. Bootstrap the value of the last
    observation when it is truncated. ``options`` are accepted, as PettingZoo's own tests hand some over, and have no
    effect.

    ## Info

    `ShepherdingEnv`'s, a copy for each agent.

    ## Arguments

    Those of `ShepherdingEnv`, except that there is always a lidar; and ``credit``.

    ## Version history

    Follows ``Shepherding-v0``.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012 (PettingZoo's form)
        **ShepherdingEnv.metadata,
        "name": "shepherding_v0",
        "is_parallelizable": True,
    }

    def __init__(
        self,
        scenario: Scenario | str | Path = "paper",
        rewards: Scheme | str = "wild",
        lidar: Lidar | Literal["default"] = "default",
        credit: Literal["team", "own"] = "team",
        render_mode: str | None = None,
        render_size: tuple[int, int] = (640, 640),
        trail_steps: int = 150,
    ) -> None:
        if lidar is None:
            raise SettingsError("lidar: agents need one: a Lidar or 'default' (given: None)")
        if credit not in ("team", "own"):
            raise SettingsError(f"credit: {credit!r} is not one of 'team', 'own'")
        scheme = checked(rewards)
        self._env = ShepherdingEnv(scenario, scheme, lidar, render_mode, render_size, trail_steps)
        self._weights = {name: weight for name, (weight, _) in scheme.items()}
        self._own = credit == "own"
        self.render_mode = render_mode
        self.possible_agents = [f"shepherd_{k}" for k in range(self._env.scenario.n_shepherds)]
        self.agents: list[str] = []
        shape = self._env.observation_space.shape or ()
        self.observation_spaces = {agent: spaces.Box(0.0, 1.0, shape[1:], np.float32) for agent in self.possible_agents}
        self.action_spaces = {agent: spaces.Box(-1.0, 1.0, (2,), np.float32) for agent in self.possible_agents}

    def observation_space(self, agent: str) -> spaces.Box:
        """The agent's own space, the same object at every call."""
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> spaces.Box:
        """The agent's own space, the same object at every call."""
        return self.action_spaces[agent]

    @property
    def world_state(self) -> WorldState:
        """The latest state of the world."""
        return self._env.state

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Observations, Infos]:
        """Start an episode: that of ``seed``, or the next one of the generator that an earlier seed started."""
        rows, info = self._env.reset(seed=seed)
        self.agents = list(self.possible_agents)
        return dict(zip(self.agents, rows, strict=True)), {agent: dict(info) for agent in self.agents}

    def step(
        self, actions: Mapping[str, NDArray[np.float32]]
    ) -> tuple[Observations, dict[str, float], dict[str, bool], dict[str, bool], Infos]:
        """One control step of all agents.

        Raises:
            ValueError: an agent's action is missing, has another shape or is not finite. Nothing has moved then.
        """
        agents = self.agents
        if not agents:
            return {}, {}, {}, {}, {}
        missing = [agent for agent in agents if agent not in actions]
        if missing:
            raise ValueError(f"actions: there is none for {missing[0]} (given: {', '.join(actions) or 'none'})")
        chosen = [np.asarray(actions[agent], np.float32) for agent in agents]
        for agent, action in zip(agents, chosen, strict=True):
            if action.shape != (2,):
                raise ValueError(f"actions[{agent!r}]: needs shape (2,) (given: {action.shape})")
        wanted = np.array(chosen)
        lidar = self._env.lidar
        if lidar is not None and lidar.frame == "goal":
            wanted = turn(wanted, self._env.beam_offset, lidar.beams)
        rows, reward, terminated, truncated, info = self._env.step(wanted)
        if terminated or truncated:
            self.agents = []
        return (
            dict(zip(agents, rows, strict=True)),
            {agent: self._reward(k, float(reward), info) for k, agent in enumerate(agents)},
            dict.fromkeys(agents, terminated),
            dict.fromkeys(agents, truncated),
            {agent: dict(info) for agent in agents},
        )

    def _reward(self, k: int, team: float, info: dict[str, Any]) -> float:
        """What shepherd k gets."""
        if not self._own:
            return team
        own = 0.0
        for name, weight in self._weights.items():
            share = info.get(f"share/{name}/{k}")
            own += info[f"reward/{name}"] if share is None else weight * share
        return own

    def render(self) -> NDArray[np.uint8] | None:
        """A picture (height, width, 3) of the state, or None without a render mode and in the window of "human"."""
        return self._env.render()

    def close(self) -> None:
        """Close the window, if there is one."""
        self._env.close()
