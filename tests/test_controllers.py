"""Targets by hand; actions that are always finite and allowed; determinism."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scenes import NOTHING, arranged

from shepherd_phys.controllers import CONTROLLERS, POLICIES, Random, StrombomLiteral, StrombomTeam
from shepherd_phys.controllers.places import ring_places, round_about, walk
from shepherd_phys.controllers.strombom import StrombomSettings, team_targets
from shepherd_phys.envs import ShepherdingEnv
from shepherd_phys.scenario import Scenario
from shepherd_phys.settings import SettingsError
from shepherd_phys.state import sub_flocks
from shepherd_phys.world import World

BASE = {n: World(Scenario(n_sheep=n, n_flocks=1, shepherds=3, goal_pos=(0.0, 0.0))).reset(0) for n in (1, 4, 10)}


def test_driving_in_a_v_behind_the_centroid():
    state = arranged([[10, 1], [10, -1], [11, 0], [9, 0]], [[20, 0]] * 3)
    targets = team_targets(state, state.sheep_pos, 5.0, 4.0, 8.0, math.radians(35))
    for target, degrees in zip(targets, (-35, 0, 35), strict=True):
        a = math.radians(degrees)
        assert target == pytest.approx([10 + 8 * math.cos(a), 8 * math.sin(a)])


def test_collecting_distinct_outliers_furthest_first():
    sheep = [[10, 0]] * 8 + [[10, 12], [10, -9]]
    state = arranged(sheep, [[20, 0]] * 3)
    gcm = np.mean(sheep, axis=0)
    targets = team_targets(state, state.sheep_pos, 5.0, 4.0, 8.0, math.radians(35))
    for target, outlier in zip(targets, ([10, 12], [10, -9]), strict=False):
        way = np.array(outlier) - gcm
        assert target == pytest.approx(outlier + 4.0 * way / np.linalg.norm(way))
    assert np.linalg.norm(targets[2] - gcm) == pytest.approx(8.0)  # nobody left to collect: it keeps its place in the V


def test_literal_stand_offs_scale_with_r_a():
    """N = 100, r_a = 0.4: f(N) = 8.62 m, drive 4 m behind the centroid, stop within 1.2 m."""
    rng = np.random.default_rng(0)
    sheep = rng.normal(0, 1, (100, 2)) + [15, 0]
    state = arranged(sheep, [[30, 0]])
    literal = StrombomLiteral(noise=0.0)
    literal.reset(rng)
    gcm = sheep.mean(axis=0)
    target = gcm + 4.0 * gcm / np.linalg.norm(gcm)
    way = target - [30, 0]
    assert literal.act(NOTHING, state)[0] == pytest.approx(way / np.linalg.norm(way))
    near = arranged(sheep, [sheep[0] + [1.1, 0]])
    assert literal.act(NOTHING, near).tolist() == [[0.0, 0.0]]


def test_walking_slows_only_to_arrive():
    state = arranged([[50, 50]], [[0, 0], [0, 0], [0, 0]])
    action = walk(state, np.array([[10.0, 0.0], [0.0, 0.15], [0.0, 0.0]]), 0.0, 0.0, np.random.default_rng(0))
    assert action == pytest.approx(np.array([[1.0, 0.0], [0.0, 0.5], [0.0, 0.0]]))


def test_terminal_rule_rings_a_delivered_flock_evenly_beyond_its_influence():
    state = arranged([[0.5, 0], [-0.5, 0], [0, 0.5], [0, -0.5]], [[9, 1], [-9, 1], [0, -9]])
    places = ring_places(state, 10.0)
    assert np.linalg.norm(places, axis=1) == pytest.approx([10.0] * 3)
    bearing = np.sort(np.arctan2(places[:, 1], places[:, 0]))
    assert np.diff(bearing) == pytest.approx([2 * math.pi / 3] * 2)
    assert (np.linalg.norm(places - state.shepherd_pos, axis=1) < 6).all()


def test_walking_round_a_disc_and_not_through_it():
    center = np.zeros(2)
    pos = np.array([[-12.0, 0.5], [-12.0, 8.0], [-12.0, 0.5], [-2.0, 0.0], [12.0, 0.0]])
    targets = np.array([[12.0, 0.5], [12.0, 11.0], [-20.0, 0.0], [9.0, 3.0], [11.0, 0.0]])
    now = round_about(pos, targets, center, 10.0)
    # through the middle: a place on the edge, on the nearer side, a wedge ahead
    bearing = math.atan2(0.5, -12.0) - 0.35
    assert now[0] == pytest.approx([10 * math.cos(bearing), 10 * math.sin(bearing)])
    assert np.linalg.norm(now[1]) == pytest.approx(10.0)  # the straight way cuts through the disc's upper part
    assert now[2].tolist() == targets[2].tolist()  # away from the disc: straight on
    assert np.linalg.norm(now[3]) == pytest.approx(10.0)  # from inside: outwards
    assert now[4].tolist() == targets[4].tolist()  # up to the edge and no further: straight on


def test_nobody_drives_from_nearer_to_the_goal_than_the_ring():
    rng = np.random.default_rng(0)
    team = StrombomTeam()
    team.reset(rng)
    sheep = rng.normal(0, 1, (40, 2)) + [
        5.0,
        0.0,
    ]  # the V would stand 8.5 m behind a centroid 5 m from the goal, or nearer
    state = arranged(sheep, [[10.6, 0.0], [10.0, 4.0], [10.0, -4.0]])
    for _ in range(200):
        step = team.act(NOTHING, state) * 0.3
        state = state.but(shepherd_pos=state.shepherd_pos + step)
        assert np.linalg.norm(state.shepherd_pos, axis=1).min() > 10.0


def test_sub_flocks_by_single_linkage():
    points = np.array([[0, 0], [2, 0], [4, 0], [20, 0], [22.9, 0], [50, 0]], float)
    assert sub_flocks(points, 3.0).tolist() == [0, 0, 0, 1, 1, 2]
    assert sub_flocks(points, 2.0).tolist() == [0, 1, 2, 3, 4, 5]
    assert sub_flocks(points[:0], 2.0).tolist() == []


HEURISTICS = [name for name in CONTROLLERS if name not in POLICIES]  # policies act on observations
AWKWARD = {
    "one sheep": ([[3.0, 4.0]], [[9.0, 9.0]]),
    "sheep on the centroid and on the goal": ([[0.0, 0.0], [0.0, 0.0]], [[5.0, 0.0], [5.0, 0.0]]),
    "a shepherd on a sheep": ([[8.0, 0.0], [9.0, 0.0]], [[8.0, 0.0]]),
    "a shepherd on its target": ([[8.0, 0.0]], [[16.5, 0.0], [16.5, 0.0]]),
    "centroid on the goal, sheep apart": ([[-9.0, 0.0], [9.0, 0.0]], [[0.0, 0.0]]),
    "all delivered": ([[0.1, 0.0], [0.0, 0.2]], [[0.0, 0.0], [9.0, 0.0], [0.0, 9.0]]),
    "six on one spot": ([[7.0, 7.0]] * 5, [[1.0, 1.0]] * 6),
    "far away": ([[1e6, -1e6]] * 3, [[0.0, 0.0]]),
}


@pytest.mark.parametrize("name", HEURISTICS)
@pytest.mark.parametrize("scene", AWKWARD)
def test_actions_are_finite_and_allowed_in_awkward_scenes(name, scene):
    state = arranged(*AWKWARD[scene])
    controller = CONTROLLERS[name]()
    controller.reset(np.random.default_rng(0))
    for _ in range(3):
        action = controller.act(NOTHING, state)
        assert action.shape == (state.n_shepherds, 2)
        assert np.isfinite(action).all()
        assert np.linalg.norm(action, axis=1).max() <= 1 + 1e-12


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32), st.sampled_from(sorted(HEURISTICS)), st.integers(1, 40), st.integers(1, 6))
def test_actions_are_finite_and_allowed_anywhere(seed, name, n_sheep, n_shepherds):
    rng = np.random.default_rng(seed)
    state = arranged(rng.normal(0, rng.choice([0.1, 3, 15]), (n_sheep, 2)), rng.normal(0, 12, (n_shepherds, 2)))
    controller = CONTROLLERS[name]()
    controller.reset(rng)
    action = controller.act(NOTHING, state)
    assert action.shape == (n_shepherds, 2)
    assert np.isfinite(action).all()
    assert np.linalg.norm(action, axis=1).max() <= 1 + 1e-12


@pytest.mark.parametrize("name", CONTROLLERS)
def test_an_episode_is_determined_by_its_seed(name):
    def positions():
        controller = CONTROLLERS[name]()
        env = ShepherdingEnv("small", rewards={}, lidar=controller.lidar)
        observation, _ = env.reset(seed=6)
        controller.reset(env.user_rng)
        for _ in range(60):
            observation, *_ = env.step(controller.act(observation, env.state))
        return env.state.shepherd_pos.tobytes()

    assert positions() == positions()


def test_the_tuned_team_delivers_a_small_flock_and_idle_does_not():
    """And holds it: the terminal rule."""
    scenario = Scenario(n_sheep=30, n_flocks=1, shepherds=3, n_steps=700)
    most = {}
    for name in ("strombom", "idle"):
        env = ShepherdingEnv(scenario, rewards={}, lidar=None)
        controller = CONTROLLERS[name]()
        observation, _ = env.reset(seed=3)
        controller.reset(env.user_rng)
        for _ in range(scenario.n_steps):
            observation, *_, info = env.step(controller.act(observation, env.state))
        most[name] = info["in_goal"]
    assert most["strombom"] > 0.9
    assert most["idle"] < 0.1


def test_random_keeps_a_velocity_and_refuses_nonsense():
    controller = Random(hold=5)
    controller.reset(np.random.default_rng(1))
    state = BASE[4]
    first = controller.act(NOTHING, state)
    assert (controller.act(NOTHING, state.but(step=3)) == first).all()
    assert (controller.act(NOTHING, state.but(step=5)) != first).any()
    with pytest.raises(SettingsError, match="Random.hold: must be a whole number"):
        Random(hold=0)
    with pytest.raises(SettingsError, match="StrombomSettings.link: .*greater than 0"):
        StrombomSettings(link=0)
