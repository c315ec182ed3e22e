"""The PettingZoo environment, by PettingZoo's own tests and against ShepherdingEnv."""

import subprocess
import sys
import warnings

import numpy as np
import pytest

from shepherd_phys.envs import WILD, ShepherdingEnv, ShepherdingParallelEnv
from shepherd_phys.envs.rewards import Effort
from shepherd_phys.lidar import Lidar
from shepherd_phys.observation import turn
from shepherd_phys.scenario import SCENARIOS
from shepherd_phys.settings import SettingsError

with warnings.catch_warnings():  # importing PettingZoo's tests loads a game of its own that warns of itself
    warnings.simplefilter("ignore", DeprecationWarning)
    from pettingzoo.test import parallel_api_test, parallel_seed_test

SHORT = SCENARIOS["small"].but(n_steps=15)
SCHEME = {**WILD, "effort": (-0.5, Effort())}
VARIANTS = {
    "default": {},
    "goal frame, own credit": {"lidar": Lidar(sectors=64, frame="goal"), "credit": "own", "rewards": SCHEME},
    "one shepherd": {"scenario": SHORT.but(shepherds=1)},
    "may succeed": {"scenario": SHORT.but(goal_radius=60.0, terminate_on_success=True, n_steps=60)},
}


def made(**changes):
    return ShepherdingParallelEnv(**{"scenario": SHORT, **changes})


@pytest.mark.parametrize("variant", VARIANTS)
def test_pettingzoos_own_tests_pass_without_a_warning(variant, capsys):
    parallel_api_test(made(**VARIANTS[variant]), num_cycles=80)
    parallel_seed_test(lambda: made(**VARIANTS[variant]), num_cycles=80)


@pytest.mark.parametrize("variant", VARIANTS)
def test_it_is_shepherding_env_agent_by_agent(variant):
    arguments = {"scenario": SHORT, **VARIANTS[variant]}
    env = ShepherdingParallelEnv(**arguments)
    credit = arguments.pop("credit", "team")
    single = ShepherdingEnv(**arguments)
    goal_frame = single.lidar.frame == "goal"
    seen, infos = env.reset(seed=5)
    rows, info = single.reset(seed=5)
    rng = np.random.default_rng(0)
    assert env.agents == env.possible_agents == [f"shepherd_{k}" for k in range(len(rows))]
    done = False
    while not done:
        for k, agent in enumerate(env.agents):
            assert seen[agent].tobytes() == rows[k].tobytes()
            assert env.observation_space(agent).contains(seen[agent])
            assert infos[agent] == info
        action = rng.uniform(-1, 1, (len(rows), 2)).astype(np.float32)
        agents = env.agents
        seen, rewards, terminated, truncated, infos = env.step(dict(zip(agents, action, strict=True)))
        if goal_frame:
            action = turn(action, single.beam_offset, single.lidar.beams)
        rows, reward, ended, cut, info = single.step(action)
        assert (terminated, truncated) == (dict.fromkeys(agents, ended), dict.fromkeys(agents, cut))
        if credit == "team":
            assert rewards == dict.fromkeys(agents, reward)
        else:
            assert np.mean(list(rewards.values())) == pytest.approx(reward, rel=1e-12)
            expected = info["reward/occupy"] + info["reward/distance"]
            for k, agent in enumerate(agents):
                own = 0.1 * info[f"share/occlude/{k}"] - 0.5 * info[f"share/effort/{k}"]
                assert rewards[agent] == pytest.approx(expected + own, rel=1e-12)
        done = ended or cut
    assert env.agents == []
    assert single.state.step == (25 if variant == "may succeed" else 15)
    assert env.step({}) == ({}, {}, {}, {}, {})
    assert env.reset()[0].keys() == set(env.possible_agents)


def test_infos_and_spaces_are_each_agents_own():
    env = made()
    _, infos = env.reset(seed=0)
    infos["shepherd_0"]["mine"] = 1
    assert "mine" not in infos["shepherd_1"]
    assert env.action_space("shepherd_0") is env.action_space("shepherd_0") is not env.action_space("shepherd_1")


def test_render():
    env = made(render_mode="rgb_array", render_size=(80, 60))
    env.reset(seed=0)
    assert env.render().shape == (60, 80, 3)
    assert made().render() is None
    env.close()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"lidar": None}, "lidar: agents need one"),
        ({"credit": "mine"}, "credit: 'mine' is not one of 'team', 'own'"),
        ({"render_mode": "ascii"}, "render_mode: 'ascii' is not one of"),
        ({"rewards": "wool"}, "rewards: 'wool' is not one of original, any, wild"),
    ],
)
def test_bad_arguments(arguments, message):
    with pytest.raises(SettingsError, match=message):
        made(**arguments)


def test_bad_actions_move_nothing():
    env = made()
    env.reset(seed=0)
    before = env.world_state
    good = np.zeros(2, np.float32)
    for actions, message in [
        ({"shepherd_0": good}, r"actions: there is none for shepherd_1 \(given: shepherd_0\)"),
        ({"shepherd_0": good, "shepherd_1": np.zeros(3)}, r"actions\['shepherd_1'\]: needs shape \(2,\)"),
        ({"shepherd_0": good, "shepherd_1": good * np.nan}, "action: every number must be finite"),
    ]:
        with pytest.raises(ValueError, match=message):
            env.step(actions)
    assert env.world_state is before


def test_importing_the_environments_loads_no_window_and_no_learner():
    code = "import sys, shepherd_phys.envs; print({'torch', 'stable_baselines3', 'pygame'} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-P", "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "set()\n"
