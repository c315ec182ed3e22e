"""The fast world against the same step written plainly."""

import numpy as np
import pytest

from shepherd_phys.controllers.strombom import StrombomSettings, StrombomTeam
from shepherd_phys.envs import ShepherdingEnv
from shepherd_phys.lidar import Lidar
from shepherd_phys.scenario import SCENARIOS
from shepherd_phys.scripts.plain import PlainWorld

NOTHING = np.empty(0, dtype=np.float32)
LENGTHS = StrombomSettings()
"""Of the team that drives: not the tuned ones, so that the states compared here stay the same when those change."""


def driving(every, count):
    """States in which most of the sheep are driven, from as many episodes as it takes, and the actions taken there."""
    env = ShepherdingEnv(SCENARIOS["paper"].but(n_flocks=1), rewards={}, lidar=None)
    team = StrombomTeam(LENGTHS)
    found = []
    seed = 5
    while len(found) < count:
        env.reset(seed=seed)
        team.reset(env.user_rng)
        for step in range(400):
            state = env.state
            action = team.act(NOTHING, state)
            apart = np.linalg.norm(state.sheep_pos[:, None] - state.shepherd_pos, axis=2).min(axis=1)
            if step % every == 0 and np.mean(apart <= 10.0) > 0.5:
                found.append((state, action))
            env.step(action)
        seed += 1
    return found[:count]


def both(state):
    """The fast env and the plain world, started from a state with the same random draws to come."""
    env = ShepherdingEnv(SCENARIOS["paper"].but(n_flocks=1), rewards="wild", lidar=Lidar())
    env.reset(seed=0)
    env.world.reset_to(state, 77)
    _, noise, _ = np.random.SeedSequence(77).spawn(3)
    return env, PlainWorld(env.scenario, state, np.random.default_rng(noise))


def test_both_agree_after_one_step_from_100_states_of_a_driving_episode():
    rewarded = 0
    for state, action in driving(8, 100):
        env, plain = both(state)
        observation, reward, *_, info = env.step(action)
        slow = plain.step(action)
        fast = env.state
        assert np.abs(slow.sheep_pos - fast.sheep_pos).max() <= 1e-9
        assert np.abs(slow.sheep_vel - fast.sheep_vel).max() <= 1e-9
        assert np.abs(slow.shepherd_pos - fast.shepherd_pos).max() <= 1e-9
        # float32 proximities of the newest frame; older ones are from before the hand-over
        assert np.abs(slow.observation[:, 6:] - observation[:, 6:]).max() <= 1e-6
        assert reward == pytest.approx(slow.reward, abs=1e-12)
        rewarded += info["reward/occlude"] > 0
    assert rewarded > 20  # the states are worth comparing


def test_both_agree_over_the_first_20_steps():
    """A driven flock doubles every difference in each step, rounding included: further on no two programs agree."""
    env = ShepherdingEnv(SCENARIOS["paper"].but(n_flocks=1), rewards={}, lidar=None)
    env.reset(seed=5)
    start = env.state  # the shepherds begin near the flock, so that it is driven from the first step on
    middle = start.sheep_pos.mean(axis=0)
    env, plain = both(start.but(shepherd_pos=middle + [[7.0, 0.0], [6.0, 3.5], [6.0, -3.5]]))
    team = StrombomTeam(LENGTHS)
    team.reset(np.random.default_rng(0))
    for _ in range(20):
        action = team.act(NOTHING, env.state)
        observation, reward, *_ = env.step(action)
        slow = plain.step(action)
        assert np.abs(slow.sheep_pos - env.state.sheep_pos).max() <= 1e-6
        assert reward == pytest.approx(slow.reward, abs=1e-4)
    assert np.abs(slow.observation - observation).mean() <= 1e-5
    assert np.linalg.norm(env.state.sheep_pos - start.sheep_pos, axis=1).mean() > 1.5  # they were driven
