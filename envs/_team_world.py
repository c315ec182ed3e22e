"""One world of a `shepherd_phys.envs.team.TeamVecEnv`: decisions in, observations and rewards out. No learner in sight.

It runs in a worker process, which should start fast and stay small: nothing here imports a learning library.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from shepherd_phys import mirror
from shepherd_phys.imperfections import Sight
from shepherd_phys.lidar import Lidar, Scan
from shepherd_phys.mirror import Side
from shepherd_phys.observation import Stack, turn
from shepherd_phys.placement import PlacementError
from shepherd_phys.scenario import Scenario
from shepherd_phys.settings import SettingsError
from shepherd_phys.state import WorldState
from shepherd_phys.world import World

from ._critic import N_NUMBERS, whole_world
from .outcome import HeldSuccess, measures
from .rewards import Earned, Scheme, earned, scans_for

PLACEMENTS = 20
"""Seeds and draws that are tried for an episode's world before it counts as one that cannot be placed."""
Draw = Callable[[np.random.Generator, int], Scenario]
"""(random numbers, index of the world) -> the scenario of its next episode."""


@dataclass(frozen=True)
class Plan:
    """What the worlds of a `TeamVecEnv` have in common; can be pickled where its scenario and terms can."""

    scenario: Scenario | Draw
    scheme: Scheme
    lidar: Lidar
    decision_interval: int
    own_credit: bool
    critic: bool
    mirror: Side
    random_clocks: bool

    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Shape of each part of one shepherd's observation."""
        shapes = {"lidar": self.lidar.observation_shape(1)[1:]}
        if self.critic:
            shapes["critic"] = (N_NUMBERS,)
        return shapes


class Ending:
    """How an episode of one world ended."""

    def __init__(self, world: TeamWorld, terminated: bool) -> None:
        self.observation = {name: array.copy() for name, array in world.observation.items()}
        """The last observation, a row for each shepherd."""
        self.returns = world.returns.tolist()
        """Each shepherd's undiscounted sum of rewards."""
        self.terminated = terminated
        """Success held for long enough and the scenario ends at that; else time was up."""
        self.shortened = world.clock > 0
        """It was a first episode that began at a random clock."""
        self.decisions = world.decisions
        self.control_steps = world.state.step
        self.measures = measures(world.state)


class TeamWorld:
    """A world whose shepherds decide every few control steps. Every episode after the first follows by itself.

    Attributes:
        index: which world of the vector env it is.
        n_shepherds: P, the same in every episode.
        observation: what the shepherds see now, by name: arrays with a row for each, written in place.
        rewards: (P,) float32 of the latest decision, written in place.
        returns: (P,) summed rewards of this episode.
        beam_offset: (P,) beams by which the observation is rolled.
        mirrored: (P,) who sees the world in a mirror in this episode.
        seed: of this episode.
        clock: control steps by which this episode is shorter than its scenario says.
        decisions: made in this episode.
        decision_steps: control steps of the latest decision.
    """

    def __init__(
        self,
        plan: Plan,
        index: int,
        n_shepherds: int,
        observation: dict[str, NDArray[np.float32]],
        rewards: NDArray[np.float32],
    ) -> None:
        self.index, self.n_shepherds = index, n_shepherds
        self.observation, self.rewards = observation, rewards
        self._plan = plan
        lidar, self._sets = scans_for(plan.scheme, plan.lidar)
        self._scan_lidar = lidar or plan.lidar  # there is one, since something is observed
        self._stack = Stack(plan.lidar)
        self._held = HeldSuccess()
        self._world: World | None = None
        self.decision_steps = 0

    @property
    def world(self) -> World:
        """The simulated world of this episode."""
        if self._world is None:
            raise RuntimeError("the world has not started yet: reset the vector env first")
        return self._world

    @property
    def state(self) -> WorldState:
        """The latest state."""
        return self.world.state

    @property
    def scenario(self) -> Scenario:
        """The scenario of this episode."""
        return self.world.scenario

    def restart(self, root: int, number: int) -> None:
        """Begin anew; all that follows is a function of the plan, the index, the two numbers and the actions."""
        seeds, draws, clocks = np.random.SeedSequence(root, spawn_key=(number, self.index)).spawn(3)
        self._seeds, self._draws = np.random.default_rng(seeds), np.random.default_rng(draws)
        self._begin()
        if self._plan.random_clocks:
            self.clock = int(np.random.default_rng(clocks).integers(self.scenario.n_steps))

    def _begin(self) -> None:
        """Start the next episode."""
        for left in reversed(range(PLACEMENTS)):
            self.seed = int(self._seeds.integers(2**63))
            self._world = self._next_world()
            try:
                self._world.reset(self.seed)
                break
            except PlacementError:  # no room in this one draw: no reason to end a run that took hours
                if not left:
                    raise
        self.clock = self.decisions = 0
        self.returns = np.zeros(self.n_shepherds)
        self.beam_offset = np.zeros(self.n_shepherds, dtype=np.int64)
        self.mirrored = np.zeros(self.n_shepherds, dtype=np.bool_)
        self._held.reset()
        self._held(self.state, measures(self.state)["is_success"])
        self._stack.reset()
        self._sight = Sight(self._plan.lidar, self.scenario.imperfections, self.world.sensing_rng)
        self._look()
        self._observe(first=True)

    def _next_world(self) -> World:
        """The world of the next episode, not yet placed: of the one scenario, or of another that is drawn."""
        scenario = self._plan.scenario
        if isinstance(scenario, Scenario):
            return self._world or World(with_team(scenario, self.n_shepherds))
        scenario = scenario(self._draws, self.index)
        if not isinstance(scenario, Scenario):
            raise SettingsError(f"scenario: the function must give a Scenario (given: {scenario!r})")
        return World(with_team(scenario, self.n_shepherds))

    def decide(self, actions: NDArray[np.float32]) -> Ending | None:
        """Hold wanted velocities for a decision; rewards and observation are written in place.

        Args:
            actions: (P, 2) in the frame of the observation.

        Returns:
            how the episode ended, if it did: then the observation is already the next episode's first.
        """
        plan, world, scenario = self._plan, self.world, self.scenario
        goal_frame = plan.lidar.frame == "goal"
        if plan.mirror != "never":
            actions = mirror.meant(actions, self.mirrored)
        action = turn(actions, self.beam_offset, plan.lidar.beams) if goal_frame else actions
        first = world.state.step
        last = min(first + plan.decision_interval, scenario.n_steps - self.clock)
        summed = [0.0] * self.n_shepherds
        terminated = False
        while True:
            before = world.state
            after = world.step(action)
            scan = self._look()
            own = self._own(earned(plan.scheme, before, after, scan, scenario))
            summed = [total + reward for total, reward in zip(summed, own, strict=True)]
            if scenario.terminate_on_success:
                terminated = self._held(after, measures(after)["is_success"])
            if terminated or after.step >= last:
                break
            if goal_frame:  # the angle follows every scan, whether or not anybody acts on it
                self.beam_offset = self._stack.offset(self.beam_offset)
        self._observe()
        self.rewards[:] = summed
        self.returns += summed
        self.decisions += 1
        self.decision_steps = after.step - first
        if not terminated and after.step < scenario.n_steps - self.clock:
            return None
        ending = Ending(self, terminated)
        self._begin()
        return ending

    def _own(self, terms: list[Earned]) -> list[float]:
        """Each shepherd's reward: the team's, or with its own share in place of the mean of a term that has shares.

        Plain numbers: for a handful of shepherds arrays take longer.
        """
        own = [0.0] * self.n_shepherds
        for term in terms:
            if self._plan.own_credit and term.shares is not None:
                own = [total + term.weight * share for total, share in zip(own, term.shares, strict=True)]
            else:
                own = [total + term.value for total in own]
        return own

    def _look(self) -> Scan:
        """Scan, and take the frame into the stack."""
        scan = self.world.scan(self._scan_lidar, self._sets)
        self._stack.push(self._sight.frame(scan))
        return scan

    def _observe(self, first: bool = False) -> None:
        """Write what the shepherds see; the first time in an episode it is found out who sees it in a mirror."""
        lidar = self._plan.lidar
        seen, self.beam_offset = self._stack.observe(self.beam_offset)
        if self._plan.mirror != "never":
            if first:
                self.mirrored = mirror.mirrored(self._plan.mirror, seen, lidar)
            seen = mirror.seen(seen, self.mirrored)
        self.observation["lidar"][:] = seen
        if self._plan.critic:
            angle = np.multiply(self.beam_offset, 2.0 * np.pi / lidar.beams, dtype=np.float64)
            whole_world(self.state, angle, self.mirrored, self.observation["critic"])

    def render(self, size: tuple[int, int] = (320, 320)) -> NDArray[np.uint8]:
        """A picture (height, width, 3) of the state."""
        from shepherd_phys.render import draw

        return draw(self.state, size)


def with_team(scenario: Scenario, n_shepherds: int) -> Scenario:
    """The scenario with so many shepherds: its own bodies, taken in turn."""
    bodies = scenario.shepherds
    if len(bodies) == n_shepherds:
        return scenario
    if not bodies:
        raise SettingsError(f"scenario: has no shepherds of which to make a team of {n_shepherds}")
    return scenario.but(shepherds=tuple(bodies[k % len(bodies)] for k in range(n_shepherds)))
