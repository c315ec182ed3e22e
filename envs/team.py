"""`TeamVecEnv`: many worlds as one stable-baselines3 ``VecEnv`` in which every shepherd is a slot."""

from __future__ import annotations

import time
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv

from shepherd_phys.lidar import Lidar
from shepherd_phys.mirror import Side, check
from shepherd_phys.scenario import Scenario, load_scenario
from shepherd_phys.settings import SettingsError

from ._critic import N_NUMBERS
from ._team_crew import Crew, Local, Memory, WorkerError
from ._team_world import Draw, Ending, Plan, TeamWorld
from .rewards import Scheme, checked, scans_for

__all__ = ["Draw", "TeamVecEnv", "TeamWorld", "WorkerError"]

Observation = dict[str, NDArray[np.float32]]


class TeamVecEnv(VecEnv):
    """Worlds of teams whose shepherds share one policy: each shepherd is a slot with an observation of its own.

    A world is atomic: its shepherds step together, live together and end together. Slots are the shepherds of world
    0, then those of world 1, ..; worlds with 1, 2, .. 6 shepherds make 21 slots, none of them padding. Observations
    and rewards are, to the bit, those of `shepherd_phys.envs.ShepherdingEnv`.

    ## Observation

    A ``Dict`` space, for ``MultiInputPolicy`` or a policy of your own:

    | key | shape | what |
    |---|---|---|
    | lidar | (stack x channels, columns) | the shepherd's row of `ShepherdingEnv`'s observation; all an actor may use |
    | critic, only with ``critic="world"`` | (101,) | the whole world from the shepherd's frame, for the critic alone |

    The second one is: 8 rings x 8 bearings about the goal with the fractions of the sheep there, 4 x 8 for the other
    shepherds, the shepherd's own place from the goal, the fractions of the sheep in the goal and ever in it, the
    team's size; bearings turn with the frame (`shepherd_phys.envs._critic`). No clock: a critic that bootstraps at
    time-outs must not see it.

    ## Action

    ``Box(-1, 1, (2,))``: a wanted velocity over the top speed, in the frame of the observation that it answers (in
    the goal frame it is turned back), held for ``decision_interval`` control steps of 0.2 s.

    ## Rewards and credit

    The sum over the decision's control steps. With ``credit="team"`` all shepherds of a world get the same number,
    `ShepherdingEnv`'s. With ``"own"`` a term that has shares gives each its own share in place of their mean.

    ## Episodes

    A world starts its next episode by itself; ``terminal_observation`` is then in each slot's info, as
    stable-baselines3 wants it. Episodes end by time-out after T control steps (after which the last decision is cut
    short if its interval does not divide T), and ``TimeLimit.truncated`` says so: PPO adds the discounted value
    of the terminal observation to the last reward. Only a scenario with ``terminate_on_success`` can end one otherwise.

    With ``random_clocks`` the first episode of each world begins at a random clock: it ends early, after a number of
    control steps drawn uniformly from 1 .. T, so that worlds do not march in step. T in the rewards stays what it is.

    ## Info

    Empty, but at the end of an episode, for each of its slots: ``terminal_observation``, ``TimeLimit.truncated``,
    ``world`` (index), ``return`` (the slot's own, undiscounted), ``in_goal``, ``ever_in_goal``, ``path_length``,
    ``collisions``, ``control_steps``, ``shortened`` (began at a random clock); and, unless shortened, ``is_success`` and
    ``episode`` {"r", "l", "t"} like the ``Monitor`` wrapper's, l in decisions: statistics are of whole episodes.

    ## Randomness

    World i draws all its episodes' seeds and scenarios from ``SeedSequence(root, spawn_key=(number, i))``, number
    counting restarts. So the same root gives the same trajectories to the bit, whatever the number of workers.
    The first ``reset`` is restart 0, a later one the restart after the last; ``seed(s)`` sets the root for the next
    (``PPO(.., seed=s)`` calls it, too). `restart` serves exact resuming without saving physics.

    ## Arguments

    | name | default | what |
    |---|---|---|
    | scenario | ``"paper"`` | a `Scenario`, a preset's name, a TOML file, or a function (rng, world) -> `Scenario`, asked at each episode, such as a `shepherd_phys.envs.mixture.Mixture` |
    | team_sizes | ``(3,)`` | shepherds of each world; bodies are the scenario's own, taken in turn |
    | rewards | ``"wild"`` | a scheme or its name |
    | lidar | ``None`` | a `Lidar`; none given: the default one, with the channels of the scenario, or of what draws it (``channels``) |
    | decision_interval | 1 | control steps of a decision |
    | credit | ``"team"`` | or ``"own"`` |
    | critic | ``"own"`` | what the critic sees more than the actor: nothing, or the ``"world"`` |
    | mirror | ``"never"`` | which shepherds see the world in a mirror, the critic's view and the action included; see `shepherd_phys.mirror` |
    | random_clocks | ``True`` | whether first episodes are cut short at random |
    | seed | 1,000,000 | root; from there upward is meant for training |
    | n_workers | 0 | worker processes; 0: all worlds in this one. Functions and classes of your own then need to be those of a module, and a script its ``if __name__ == "__main__":`` |
    | render_mode | ``None`` | ``"rgb_array"``: pictures of the worlds |

    Raises:
        SettingsError: an argument is impossible.
        WorkerError: a worker died or threw; one line that says why. The env is closed then.
    """  # noqa: E501

    def __init__(
        self,
        scenario: Scenario | str | Path | Draw = "paper",
        team_sizes: Sequence[int] = (3,),
        *,
        rewards: Scheme | str = "wild",
        lidar: Lidar | None = None,
        decision_interval: int = 1,
        credit: Literal["team", "own"] = "team",
        critic: Literal["own", "world"] = "own",
        mirror: Side = "never",
        random_clocks: bool = True,
        seed: int = 1_000_000,
        n_workers: int = 0,
        render_mode: str | None = None,
    ) -> None:
        if not isinstance(scenario, Scenario) and not callable(scenario):
            scenario = load_scenario(scenario)
        if lidar is None:
            # a function that draws scenarios may name their channels
            lidar = Lidar(channels=getattr(scenario, "channels", Lidar().channels))
        if not isinstance(lidar, Lidar):
            raise SettingsError(f"lidar: needs a Lidar or None (given: {lidar!r})")
        _one_of("credit", credit, ("team", "own"))
        _one_of("critic", critic, ("own", "world"))
        _one_of("mirror", mirror, get_args(Side))
        check(mirror, lidar)
        _one_of("render_mode", render_mode, (None, "rgb_array"))
        if not isinstance(team_sizes, Sequence | np.ndarray) or not len(team_sizes):
            raise SettingsError(f"team_sizes: needs one number or more, one a world (given: {team_sizes!r})")
        self.team_sizes = tuple(_whole(f"team_sizes[{i}]", size, 1) for i, size in enumerate(team_sizes))
        self.lidar = lidar
        self.decision_interval = _whole("decision_interval", decision_interval, 1)
        self.n_workers = _whole("n_workers", n_workers, 0)
        self.root = _whole("seed", seed, 0)
        plan = Plan(
            scenario=scenario,
            scheme=checked(rewards),
            lidar=lidar,
            decision_interval=self.decision_interval,
            own_credit=credit == "own",
            critic=critic == "world",
            mirror=mirror,
            random_clocks=random_clocks,
        )
        scans_for(plan.scheme, lidar)  # what it raises should not have to come from a worker

        n_slots = sum(self.team_sizes)
        self.slot_world = np.repeat(np.arange(len(self.team_sizes)), self.team_sizes)
        """(num_envs,) the world of each slot."""
        self._slots = np.split(np.arange(n_slots), np.cumsum(self.team_sizes)[:-1])
        parts: dict[str, spaces.Space[Any]] = {"lidar": spaces.Box(0.0, 1.0, plan.shapes()["lidar"], np.float32)}
        if plan.critic:
            parts["critic"] = spaces.Box(-np.inf, np.inf, (N_NUMBERS,), np.float32)
        shapes = {name: (n_slots, *shape) for name, shape in plan.shapes().items()}
        self._memory = Memory(
            {**shapes, "actions": (n_slots, 2), "rewards": (n_slots,), "steps": (len(self.team_sizes),)}
        )
        self._parts = tuple(parts)
        self.shepherd_steps = 0
        """Control steps times shepherds since the env was made."""
        self._number = -1
        self._pending = self._started = False
        self._begun = time.time()
        self._render_mode = render_mode
        self._crew = (
            Crew(plan, self.team_sizes, self.n_workers, self._memory)
            if self.n_workers
            else Local(plan, self.team_sizes, range(len(self.team_sizes)), self._memory)
        )
        super().__init__(n_slots, spaces.Dict(parts), spaces.Box(-1.0, 1.0, (2,), np.float32))

    # ------------------------------------------------------------ episodes

    def reset(self) -> Observation:
        """Start new episodes everywhere: restart 0 after construction or `seed`, else the one after the last."""
        return self.restart(self._number + 1)

    def restart(self, number: int) -> Observation:
        """Break off all episodes and start afresh; all that follows is a function of (settings, root, number).

        For checkpoints from which training resumes exactly: restart with the checkpoint's number, in the unbroken run
        too. Nothing is reported of the episodes that were broken off: call it between rollouts, whose last values a
        learner bootstraps anyway, and give the learner what is returned as its last observation, every slot at the
        start of an episode.

        Args:
            number: of the restart, not negative.
        """
        number = _whole("number", number, 0)
        self._pending = self._started = False
        self._crew.do("restart", self.root, number)
        self._number, self._started = number, True
        return self._observation()

    def seed(self, seed: int | None = None) -> list[int | None]:
        """Set the root of all random numbers from the next reset or restart on; none given: an unpredictable one."""
        self.root = int(np.random.default_rng().integers(2**63)) if seed is None else _whole("seed", seed, 0)
        self._number = -1
        return [self.root] * self.num_envs

    def step_async(self, actions: NDArray[np.float32]) -> None:
        """Begin a decision.

        Args:
            actions: (num_envs, 2).

        Raises:
            ValueError: the actions have another shape or are not finite; nothing has moved then.
            RuntimeError: there was no reset yet, or a step is under way.
        """
        self._free()
        if not self._started:
            raise RuntimeError("no episode has started yet: call reset first")
        actions = np.asarray(actions, np.float32)
        if actions.shape != (self.num_envs, 2):
            raise ValueError(f"actions: needs shape ({self.num_envs}, 2), one row a slot (given: {actions.shape})")
        if not np.isfinite(actions).all():
            raise ValueError("actions: every number must be finite")
        self._memory.arrays["actions"][:] = actions
        self._pending = True
        self._crew.give("decide")

    def step_wait(self) -> tuple[Observation, NDArray[np.float32], NDArray[np.bool_], list[dict[str, Any]]]:
        """End a decision: observations by name, rewards (num_envs,), whether the episode ended (num_envs,), infos.

        All of it belongs to the caller.
        """
        if not self._pending:
            raise RuntimeError("no step is under way: call step_async first")
        try:
            endings: dict[int, Ending] = self._crew.answer()
        except Exception:  # some worlds have moved and others not: only a reset goes on from here
            self._pending = self._started = False
            raise
        self._pending = False
        done = np.zeros(self.num_envs, dtype=np.bool_)
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for world, ending in endings.items():
            for k, slot in enumerate(self._slots[world]):
                done[slot] = True
                infos[slot] = self._info(world, ending, k)
        self.shepherd_steps += int(self._memory.arrays["steps"] @ np.array(self.team_sizes))
        return self._observation(), self._memory.arrays["rewards"].copy(), done, infos

    def _info(self, world: int, ending: Ending, k: int) -> dict[str, Any]:
        """What is said of shepherd k's episode."""
        measures = dict(ending.measures)
        success = measures.pop("is_success")
        info = {
            "terminal_observation": {name: rows[k].copy() for name, rows in ending.observation.items()},
            "TimeLimit.truncated": not ending.terminated,
            "world": world,
            "return": ending.returns[k],
            "control_steps": ending.control_steps,
            "shortened": ending.shortened,
            **measures,
        }
        if not ending.shortened:
            seconds = round(time.time() - self._begun, 6)
            info["episode"] = {"r": ending.returns[k], "l": ending.decisions, "t": seconds}
            info["is_success"] = success
        return info

    def _observation(self) -> Observation:
        return {name: self._memory.arrays[name].copy() for name in self._parts}

    def _free(self) -> None:
        if self._pending:
            raise RuntimeError("a step is under way, perhaps an interrupted one: call step_wait or reset first")

    def close(self) -> None:
        """End the workers. A closed env cannot be used again."""
        self._crew.close()

    # ------------------------------------------------------------ single worlds

    def get_attr(self, attr_name: str, indices: int | Iterable[int] | None = None) -> list[Any]:
        """The attribute of each slot's `TeamWorld`, such as ``state`` or ``scenario``."""
        slots = self._get_indices(indices)
        if attr_name == "render_mode":
            return [self._render_mode for _ in slots]
        return self._ask(slots, "get", attr_name)

    def set_attr(self, attr_name: str, value: Any, indices: int | Iterable[int] | None = None) -> None:
        """Set an attribute of each slot's `TeamWorld`."""
        self._ask(self._get_indices(indices), "set", attr_name, value)

    def env_method(
        self, method_name: str, *method_args: Any, indices: int | Iterable[int] | None = None, **method_kwargs: Any
    ) -> list[Any]:
        """Call a method of each slot's `TeamWorld`: once a world, and all its slots get the answer."""
        return self._ask(self._get_indices(indices), "call", method_name, method_args, method_kwargs)

    def _ask(self, slots: Iterable[int], order: str, *details: Any) -> list[Any]:
        self._free()
        worlds: list[int] = self.slot_world[list(slots)].tolist()
        answer = self._crew.do(order, sorted(set(worlds)), *details)
        return [answer.get(world) for world in worlds]

    def env_is_wrapped(self, wrapper_class: Any, indices: int | Iterable[int] | None = None) -> list[bool]:
        """Worlds are not wrapped."""
        return [False for _ in self._get_indices(indices)]

    def get_images(self) -> list[NDArray[np.uint8] | None]:
        """A picture of each world, not of each slot; none without a render mode."""
        if self._render_mode is None:
            return [None for _ in self.team_sizes]
        return self.env_method("render", indices=[int(slots[0]) for slots in self._slots])


def _whole(name: str, value: Any, least: int) -> int:
    """A whole number that is not too small."""
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < least:
        raise SettingsError(f"{name}: needs a whole number, {least} or more (given: {value!r})")
    return int(value)


def _one_of(name: str, value: Any, allowed: tuple[Any, ...]) -> None:
    if value not in allowed:
        raise SettingsError(f"{name}: {value!r} is not one of {', '.join(map(repr, allowed))}")
