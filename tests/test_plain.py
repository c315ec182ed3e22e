"""The fast world against the same step written plainly."""

import numpy as np
import pytest

from shepherd_phys.controllers import StrombomTeam
from shepherd_phys.envs import ShepherdingEnv
from shepherd_phys.lidar import Lidar
from shepherd_phys.scenario import SCENARIOS
from shepherd_phys.scripts.plain import PlainWorld

NOTHING = np.empty(0, dtype=np.float32)


def driving(every, count):
    """States of a driving episode, and the actions taken there."""
    env = ShepherdingEnv(SCENARIOS["paper"].but(n_flocks=1), rewards={}, lidar=None)
    team = StrombomTeam()
    env.reset(seed=5)
    team.reset(env.user_rng)
    found = []
    while len(found) < count:
        state = env.state
        action = team.act(NOTHING, state)
        if state.step >= 60 and state.step % every == 0:
            found.append((state, action))
        env.step(action)
    return found


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


def test_both_agree_over_20_steps():
    (state, _), *_ = driving(100, 1)
    env, plain = both(state)
    team = StrombomTeam()
    team.reset(np.random.default_rng(0))
    for _ in range(20):
        action = team.act(NOTHING, env.state)
        observation, reward, *_ = env.step(action)
        slow = plain.step(action)
        assert np.abs(slow.sheep_pos - env.state.sheep_pos).max() <= 1e-6
        assert reward == pytest.approx(slow.reward, abs=1e-4)
    assert np.abs(slow.observation - observation).mean() <= 1e-5
