"""Imperfect sensing and acting: statistics, exactness, what it never touches, and the same everywhere."""

import hashlib
import math
import multiprocessing

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from shepherd_phys.controllers.evaluation import evaluate, run_episode
from shepherd_phys.envs import ShepherdingEnv
from shepherd_phys.envs.parallel import ShepherdingParallelEnv
from shepherd_phys.envs.team import TeamVecEnv
from shepherd_phys.imperfections import Imperfections, Sight
from shepherd_phys.lidar import Lidar, Scan
from shepherd_phys.observation import encode
from shepherd_phys.obstacles import Pillar
from shepherd_phys.scenario import SCENARIOS, Scenario, load_scenario
from shepherd_phys.settings import SettingsError
from shepherd_phys.world import World

SMALL = Scenario(n_sheep=8, n_flocks=2, shepherds=2, n_steps=12)
ALL_WRONG = Imperfections(lost_beams=0.2, range_noise=0.05, scan_delay=2, action_noise=0.1)
LIDAR = Lidar(beams=64)


def scan_of(value, lidar, shepherds=3):
    return Scan(lidar.channels, np.full((len(lidar.channels), shepherds, lidar.beams), value))


def played(scenario, seed=3, steps=8, **env):
    """Observations, rewards, infos and states of an episode with fixed actions."""
    env = ShepherdingEnv(scenario, **env)
    observation, _ = env.reset(seed=seed)
    actions = np.random.default_rng(seed)
    answers = [(observation, 0.0, {}, env.state)]
    for _ in range(steps):
        observation, reward, _, _, info = env.step(actions.uniform(-1, 1, (scenario.n_shepherds, 2)))
        answers.append((observation, reward, info, env.state))
    return answers


# ------------------------------------------------------------------- statistics


def test_beams_are_lost_with_probability_q_anew_each_time():
    lidar = Lidar(beams=4096)
    sight = Sight(lidar, Imperfections(lost_beams=0.3), np.random.default_rng(0))
    lost = np.array([sight.frame(scan_of(10.0, lidar)) == 0.0 for _ in range(20)])
    n = lost[0].size
    assert abs(lost.mean() - 0.3) < 4 * math.sqrt(0.21 / lost.size)
    both = (lost[0] & lost[1]).mean()
    assert abs(both - 0.09) < 4 * math.sqrt(0.09 * 0.91 / n)  # no beam is lost for good
    channels = (lost[:, :, 0] & lost[:, :, 1]).mean()
    assert abs(channels - 0.09) < 5 * math.sqrt(0.09 * 0.91 / lost[:, :, 0].size)  # nor in all channels at once
    kept = sight.frame(scan_of(10.0, lidar))
    assert set(np.unique(kept)) == {np.float32(0), *np.unique(encode(scan_of(10.0, lidar), lidar))}


def test_range_noise_is_a_fraction_of_the_reading_clipped_to_the_range():
    lidar = Lidar(beams=4096, range=50.0, goal_range=75.0)
    sight = Sight(lidar, Imperfections(range_noise=0.1), np.random.default_rng(1))
    near = sight.frame(scan_of(10.0, lidar)).astype(float)
    readings = 50.0 * (1.0 - near[:, 0])
    assert readings.mean() == pytest.approx(10.0, abs=4 / math.sqrt(readings.size))
    assert readings.std() == pytest.approx(1.0, rel=0.03)
    assert 75.0 * (1.0 - near[:, 2]).std() == pytest.approx(1.0, rel=0.03)
    far = sight.frame(scan_of(49.9, lidar))
    assert 0.4 < (far[:, 0] == 0.0).mean() < 0.6  # beyond the range: nothing
    assert (far[:, 2] > 0.0).all()
    wild = Sight(lidar, Imperfections(range_noise=5.0), np.random.default_rng(1)).frame(scan_of(10.0, lidar))
    assert (wild.min(), wild.max()) == (0.0, 1.0)


def test_what_reads_nothing_stays_nothing():
    sight = Sight(LIDAR, Imperfections(lost_beams=0.5, range_noise=5.0), np.random.default_rng(1))
    assert not sight.frame(scan_of(np.inf, LIDAR)).any()


def test_action_noise_has_its_deviation_and_is_clipped_with_the_action():
    scenario = Scenario(
        n_sheep=1, n_flocks=1, shepherds=400, box=2000.0, goal_pos=(9e3, 0.0),
        imperfections=Imperfections(action_noise=0.2),
    )  # fmt: skip
    world = World(scenario)
    world.reset(0)
    vel = world.step(np.tile([0.3, 0.0], (400, 1))).shepherd_vel / 1.5
    assert vel.mean(axis=0) == pytest.approx([0.3, 0.0], abs=4 * 0.2 / 20)
    assert vel.std(axis=0) == pytest.approx([0.2, 0.2], rel=0.15)
    world.reset(0)
    full = np.linalg.norm(world.step(np.tile([1.0, 0.0], (400, 1))).shepherd_vel, axis=1) / 1.5
    assert full.max() <= 1.0 + 1e-9
    assert 0.3 < (full > 1.0 - 1e-9).mean() < 0.7


# -------------------------------------------------------------------- exactness


@pytest.mark.parametrize("delay", [1, 3])
def test_a_delayed_observation_is_that_of_k_steps_ago_to_the_bit(delay):
    prompt = [answer[0] for answer in played(SMALL)]
    late = [answer[0] for answer in played(SMALL.but(imperfections=Imperfections(scan_delay=delay)))]
    for k, observation in enumerate(late):
        assert observation.tobytes() == prompt[max(0, k - delay)].tobytes()


def test_no_imperfection_and_all_of_them_off_are_the_same_to_the_bit():
    for one, other in zip(played(SMALL), played(SMALL.but(imperfections=Imperfections())), strict=True):
        assert one[0].tobytes() == other[0].tobytes() and one[1:3] == other[1:3]
        assert one[3].sheep_pos.tobytes() == other[3].sheep_pos.tobytes()


def test_bad_sensors_change_no_state_no_reward_and_no_metric():
    scenario = SMALL.but(obstacles=(Pillar((30.0, 0.0), 1.0),))
    wrong = scenario.but(imperfections=ALL_WRONG.but(action_noise=0.0))
    for one, other in zip(played(scenario), played(wrong), strict=True):
        assert one[1:3] == other[1:3]
        assert one[3].sheep_pos.tobytes() == other[3].sheep_pos.tobytes()
    assert (one[0] != other[0]).any()


def test_what_goes_wrong_does_not_depend_on_what_else_is_scanned_or_asked():
    scenario = SMALL.but(imperfections=ALL_WRONG)
    for one, other, blind in zip(
        played(scenario), played(scenario, rewards={}), played(scenario, lidar=None), strict=True
    ):
        assert one[0].tobytes() == other[0].tobytes()
        assert one[3].shepherd_pos.tobytes() == blind[3].shepherd_pos.tobytes()


def test_a_refused_action_draws_no_noise():
    world = World(SMALL.but(imperfections=ALL_WRONG))
    places = []
    for refused in (False, True):
        world.reset(0)
        if refused:
            with pytest.raises(ValueError, match="finite"):
                world.step(np.full((2, 2), np.nan))
        places.append(world.step(np.zeros((2, 2))).shepherd_vel.tobytes())
    assert places[0] == places[1]


def episode_hash(seed):
    digest = hashlib.sha256()
    for observation, reward, _, state in played(SMALL.but(imperfections=ALL_WRONG), seed):
        digest.update(observation.tobytes() + np.float64(reward).tobytes() + state.shepherd_pos.tobytes())
    return digest.hexdigest()


def test_a_seed_replays_what_went_wrong_here_and_in_another_process():
    here = [episode_hash(seed) for seed in (1, 2)]
    assert here == [episode_hash(seed) for seed in (1, 2)] and here[0] != here[1]
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        assert pool.map(episode_hash, (1, 2)) == here


# ------------------------------------------------------------------- everywhere


@pytest.mark.parametrize("lidar", [LIDAR, Lidar(beams=64, sectors=16, frame="goal")], ids=["world", "goal"])
def test_the_teams_env_and_the_single_one_agree_to_the_bit(lidar):
    scenario = SMALL.but(imperfections=ALL_WRONG)
    team = TeamVecEnv(scenario, (2,), lidar=lidar, random_clocks=False)
    single = ShepherdingEnv(scenario, lidar=lidar)
    observed = team.reset()["lidar"]
    (seed, *_) = team.get_attr("seed")
    alone, _ = single.reset(seed=seed)
    assert observed.tobytes() == alone.tobytes()
    rng = np.random.default_rng(0)
    for _ in range(11):
        action = rng.uniform(-1, 1, (2, 2)).astype(np.float32)
        observation, rewards, _, _ = team.step(action)
        offset = single.beam_offset * (2 * np.pi / 64)
        c, s = np.cos(offset), np.sin(offset)
        turned = np.stack([c * action[:, 0] - s * action[:, 1], s * action[:, 0] + c * action[:, 1]], 1)
        alone, reward, *_ = single.step(turned.astype(np.float32) if lidar.frame == "goal" else action)
        assert observation["lidar"].tobytes() == alone.tobytes()
        assert rewards.tolist() == [np.float32(reward)] * 2


def test_every_agent_of_the_parallel_env_sees_its_row():
    scenario = SMALL.but(imperfections=ALL_WRONG)
    parallel, single = ShepherdingParallelEnv(scenario), ShepherdingEnv(scenario)
    rows, _ = parallel.reset(seed=5)
    alone, _ = single.reset(seed=5)
    for _ in range(4):
        assert all(rows[f"shepherd_{k}"].tobytes() == alone[k].tobytes() for k in range(2))
        rows, *_ = parallel.step({f"shepherd_{k}": np.array([0.5, 0.1], np.float32) for k in range(2)})
        alone, *_ = single.step(np.array([[0.5, 0.1]] * 2, np.float32))


class Watcher:
    """Keeps what it is given, and follows the goal's beams."""

    lidar = LIDAR

    def reset(self, rng):
        self.seen = []

    def act(self, observation, state):
        self.seen.append(observation.copy())
        return np.full((state.n_shepherds, 2), 0.3)


def test_controllers_are_given_the_imperfect_observation():
    rows = []
    for scenario in (SMALL, SMALL.but(imperfections=Imperfections(lost_beams=1.0))):
        watcher = Watcher()
        rows.append(run_episode(watcher, ShepherdingEnv(scenario, rewards={}, lidar=LIDAR), 2))
        assert any(seen.any() for seen in watcher.seen) == (scenario is SMALL)
    assert rows[0] == rows[1]
    (row,) = evaluate(Watcher(), lambda **env: ShepherdingEnv(SMALL, **env), [2])
    assert {**row, "controller": None} == {**rows[0], "controller": None}


# --------------------------------------------------------------------- settings


def test_they_survive_a_file_and_leave_a_scenario_without_them_as_it_was(tmp_path):
    scenario = SMALL.but(imperfections=ALL_WRONG)
    scenario.to_toml(tmp_path / "wrong.toml")
    assert load_scenario(tmp_path / "wrong.toml") == scenario
    assert "imperfections" not in SCENARIOS["paper"].to_dict()  # results are known by this table


@settings(max_examples=40, deadline=None)
@given(
    lost=st.floats(0, 1), noise=st.floats(0, 10), delay=st.integers(0, 5), seed=st.integers(0, 99),
    reading=st.sampled_from([0.0, 1e-9, 3.0, 49.99999, math.inf]),
)  # fmt: skip
def test_whatever_goes_wrong_frames_are_proximities(lost, noise, delay, seed, reading):
    wrong = Imperfections(lost_beams=lost, range_noise=noise, scan_delay=delay)
    sight = Sight(LIDAR, wrong, np.random.default_rng(seed))
    for _ in range(3):
        frame = sight.frame(scan_of(reading, LIDAR))
        assert frame.dtype == np.float32 and frame.shape == (3, 3, 64)
        assert ((frame >= 0) & (frame <= 1)).all()


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"lost_beams": 1.1}, "Imperfections.lost_beams: .*less than or equal to 1"),
        ({"lost_beams": -0.1}, "Imperfections.lost_beams: .*greater than or equal to 0"),
        ({"range_noise": math.nan}, "Imperfections.range_noise: .*finite"),
        ({"scan_delay": 1.5}, "Imperfections.scan_delay: .*integer"),
        ({"action_noise": -1}, "Imperfections.action_noise"),
        ({"fog": 1}, "Imperfections.fog: there is no such field"),
    ],
)
def test_impossible_ones_are_named(values, message):
    with pytest.raises(SettingsError, match=message):
        Imperfections(**values)
    with pytest.raises(SettingsError, match=message):
        Scenario.from_dict({"imperfections": values})


def test_something_else_is_named():
    with pytest.raises(SettingsError, match=r"Scenario.imperfections: .*given: 3"):
        Scenario.from_dict({"imperfections": 3})
