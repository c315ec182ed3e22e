"""How a team that acts by a policy holds the herd once it is home, by its lidar."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st
from scenes import arranged
from test_learned import SMALL, random_weights, spec_of

from shepherd_phys.controllers import POLICIES, Policy
from shepherd_phys.controllers.evaluation import run_episode, trial_seed
from shepherd_phys.controllers.hold import Hold, HomeHerd
from shepherd_phys.controllers.policy_files import PolicyError
from shepherd_phys.envs import ShepherdingEnv
from shepherd_phys.layouts import Scattered
from shepherd_phys.learning.preset import load_preset
from shepherd_phys.lidar import Lidar
from shepherd_phys.observation import encode, observe
from shepherd_phys.scenario import SCENARIOS, Scenario
from shepherd_phys.settings import SettingsError
from shepherd_phys.world import World

LIDAR = Lidar(stack=1, frame="goal")
HOME = ((0.0, 0.0), (2.0, 1.0), (0.0, 5.2))  # the last one 2.7 m outside the border


def frames(sheep, shepherds, goal=(0.0, 0.0), lidar=LIDAR, goal_radius=2.5):
    """What shepherds at these places see, and the beams that point at the goal."""
    world = World(Scenario(n_sheep=len(sheep), n_flocks=1, shepherds=len(shepherds), goal_radius=goal_radius))
    world.reset_to(arranged(sheep, shepherds, goal), 0)
    seen = encode(world.scan(lidar), lidar)[:, None]
    return seen, observe(seen, np.zeros(len(shepherds), np.int64), lidar)[1]


def herd(sheep, shepherds, home=3.0, **how):
    return HomeHerd(LIDAR, home)(*frames(sheep, shepherds, **how))


AROUND = ((14.0, 0.0), (0.0, -8.5), (-9.0, 12.0))


@pytest.mark.parametrize("goal_radius", [1.5, 2.5, 3.54])
def test_how_far_the_goals_centre_is_by_how_wide_it_looks(goal_radius):
    told = herd(((0.0, 0.0),), AROUND, goal_radius=goal_radius)
    np.testing.assert_allclose(told, [14.0, 8.5, 15.0], atol=0.15)  # beams are 0.7 degrees apart


def test_only_those_hold_who_see_no_sheep_that_is_not_home():
    assert np.isfinite(herd(HOME, AROUND)).all()
    assert np.isnan(herd((*HOME, (0.0, -6.0)), AROUND)).all()
    assert np.isfinite(herd((*HOME, (0.0, -6.0)), AROUND, 4.0)).all()
    # a sheep in the shadow of another is not seen: the first shepherd has them in a line, the others do not
    shadow = herd(((2.0, 0.0), (-6.0, 0.0)), AROUND)
    assert np.isfinite(shadow).tolist() == [True, False, False]


def test_nobody_holds_inside_the_goal_or_without_sight_of_it_or_of_sheep():
    assert np.isfinite(herd(HOME, ((14.0, 0.0), (1.0, 0.0), (0.0, 9.0)))).tolist() == [True, False, True]
    seen, offset = frames(HOME, AROUND)
    seen[1, :, LIDAR.channels.index("goal")] = 0.0
    assert np.isfinite(HomeHerd(LIDAR, 3.0)(seen, offset)).tolist() == [True, False, True]
    seen, offset = frames(HOME, AROUND)
    seen[1, :, LIDAR.channels.index("sheep")] = 0.0
    assert np.isfinite(HomeHerd(LIDAR, 3.0)(seen, offset)).tolist() == [True, False, True]


def test_lost_beams_change_it_little():
    seen, offset = frames(HOME, AROUND)
    whole = HomeHerd(LIDAR, 3.0)(seen, offset)
    for seed in range(20):
        lost = (seen * (np.random.default_rng(seed).random(seen.shape) > 0.1)).astype(np.float32)
        turned = observe(lost, np.zeros(3, np.int64), LIDAR)[1]
        assert HomeHerd(LIDAR, 3.0)(lost, turned) == pytest.approx(whole, abs=0.4)


def test_it_goes_by_the_newest_frame_whatever_the_channels_and_sectors():
    whole, offset = frames(HOME, AROUND)
    for lidar in (
        LIDAR.but(stack=2, sectors=64),
        LIDAR.but(stack=2, channels=("sheep", "goal")),
        LIDAR.but(stack=2, channels=("sheep", "shepherds", "goal", "obstacles")),
    ):
        (newest, _), (older, _) = (frames(sheep, AROUND, lidar=lidar) for sheep in (HOME, (*HOME, (0.0, -6.0))))
        told = HomeHerd(lidar, 3.0)(np.concatenate((older, newest), axis=1), offset)
        np.testing.assert_array_equal(told, HomeHerd(LIDAR, 3.0)(whole, offset))
        assert np.isnan(HomeHerd(lidar, 3.0)(np.concatenate((newest, older), axis=1), offset)).all()


def test_on_the_border_half_of_the_beams_see_the_goal_and_nobody_holds():
    seen, offset = frames(HOME, AROUND)
    row = seen[0, 0, LIDAR.channels.index("goal")]
    row[:] = 0.0
    row[:255] = 0.999
    assert np.isfinite(HomeHerd(LIDAR, 40.0)(seen, offset)[0])
    row[255] = 0.999
    assert np.isnan(HomeHerd(LIDAR, 40.0)(seen, offset)[0])


@hypothesis_settings(max_examples=30, deadline=None)
@given(angle=st.floats(0, 6.28), x=st.floats(-20, 20), y=st.floats(-20, 20))
def test_it_is_the_same_wherever_the_scene_lies_and_however_it_is_turned(angle, x, y):
    turned = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    moved = [np.array(points) @ turned.T + (x, y) for points in (HOME, AROUND)]
    assert herd(*moved, goal=(x, y)) == pytest.approx(herd(HOME, AROUND), abs=0.3)


def acts(policy, sheep, shepherds):
    """Actions in the goal frame: along the way to the goal, and across."""
    seen, offset = frames(sheep, shepherds)
    policy.reset(np.random.default_rng(0))
    action = policy.act(seen.reshape(len(shepherds), -1, LIDAR.beams), World(Scenario()).reset(0))
    angle = -2 * np.pi * offset / LIDAR.beams
    along = np.cos(angle) * action[:, 0] - np.sin(angle) * action[:, 1]
    return np.column_stack((along, np.sin(angle) * action[:, 0] + np.cos(angle) * action[:, 1]))


def test_who_holds_goes_to_the_ring_and_keeps_its_way_along_it():
    weights = random_weights(SMALL, LIDAR)
    weights["action.weight"] *= 0.0
    weights["action.bias"][:] = -0.5, 0.3

    def team(**hold):
        return Policy(spec_of(LIDAR, hold=Hold(**hold)), weights)

    plain = Policy(spec_of(LIDAR), weights)
    near = ((10.9, 0.0), (0.0, -8.5), (-9.0, 12.0))
    np.testing.assert_allclose(acts(plain, HOME, near), [(-0.5, 0.3)] * 3, atol=1e-6)
    far = 1 / np.hypot(1.0, 0.3)  # who goes at full speed ahead goes no faster for its way along
    np.testing.assert_allclose(acts(team(rest=0.2), HOME, near), [(0.4, 0.3), (-0.5, 0.3), (far, 0.3 * far)], atol=0.15)
    # what is slow altogether is standing still; for who does not hold it is the policy's own limit that counts
    assert np.flatnonzero(acts(team(rest=0.9), HOME, near).any(axis=1)).tolist() == [2]
    np.testing.assert_allclose(acts(team(rest=0.9), (*HOME, (0.0, -6.0)), near), [(-0.5, 0.3)] * 3, atol=1e-6)

    # from within, only where that is wanted: 8.5 m off a ring of 10.5 m that may be left by half a metre
    np.testing.assert_allclose(
        acts(team(rest=0.2, inside=0.5), HOME, near)[1], (-1.0, 0.3) / np.hypot(1.0, 0.3), atol=0.15
    )
    np.testing.assert_allclose(acts(team(rest=0.2, inside=1.9), HOME, near)[1], (-0.5, 0.3), atol=1e-6)
    # and in a team that is large enough
    np.testing.assert_allclose(acts(team(), HOME, near[:2]), [(-0.5, 0.3)] * 2, atol=1e-6)
    assert acts(team(team=2), HOME, near[:2])[0, 0] > 0.2


def test_it_comes_after_the_mirror_and_chance_is_of_the_episodes_seed():
    weights = random_weights(SMALL, LIDAR)
    weights["action.weight"] *= 0.0
    weights["action.bias"][:] = -0.5, 0.3
    # sheep to the left of the goal as seen by the first, to its right as seen by the second
    sheep, shepherds = ((0.0, -2.0),), ((14.0, 0.0), (-14.0, 0.0), (0.0, 14.0))
    how = {"mirror": "left", "hold": Hold(rest=0.2)}
    done = acts(Policy(spec_of(LIDAR, **how), weights), sheep, shepherds)
    ahead, across = np.array((1.0, 0.3)) / np.hypot(1.0, 0.3)
    np.testing.assert_allclose(done[:2], [(ahead, -across), (ahead, across)], atol=1e-6)
    noisy = Policy(spec_of(LIDAR, noise=0.5, **how), weights)
    assert np.any(acts(noisy, HOME, AROUND) != acts(Policy(spec_of(LIDAR, **how), weights), HOME, AROUND))
    np.testing.assert_array_equal(acts(noisy, HOME, AROUND), acts(noisy, HOME, AROUND))


@pytest.mark.parametrize("lidar", [Lidar(), Lidar(frame="goal", channels=("goal",))])
def test_holding_needs_the_goal_ahead_and_sheep_to_see(lidar):
    with pytest.raises(PolicyError, match=r"action.hold: needs the frame 'goal' and the channel of sheep"):
        spec_of(lidar, hold=Hold())


def test_collie_holds_a_herd_that_its_policy_alone_would_not_press_home():
    collie = POLICIES["collie"]()
    assert collie.spec.action.hold is not None
    alone = Policy(replace(collie.spec, action=collie.spec.action.but(hold=None)), collie.weights)
    large = Scenario(n_sheep=200, goal_radius=2.5 * 2**0.5, n_flocks=2, shepherds=3, terminate_on_success=False)
    env = ShepherdingEnv(large, lidar=collie.lidar, rewards={})
    held, loose = (run_episode(policy, env, 2)["in_goal_end"] for policy in (collie, alone))
    assert held >= 97 and loose < 80


def test_collie_obstacles_gets_where_its_policy_alone_stays():
    shipped = POLICIES["collie-obstacles"]()
    assert shipped.spec.action.wander is not None
    alone = Policy(replace(shipped.spec, action=shipped.spec.action.but(hold=None, wander=None)), shipped.weights)
    trees = SCENARIOS["scattered"].but(layout=Scattered(density=0.05), n_flocks=2, terminate_on_success=False)
    env = ShepherdingEnv(trees, lidar=shipped.lidar, rewards={})
    gets, stays = (run_episode(policy, env, trial_seed(10_000, 0))["in_goal_end"] for policy in (shipped, alone))
    assert gets >= 97 and stays < 50


def test_nobody_can_stand_further_inside_a_ring_than_its_centre():
    assert Hold(ring=9.0, inside=9.0).inside == 9.0
    with pytest.raises(SettingsError, match=r"Hold: inside: must be no more than ring, 9.0 \(given: 20.0\)"):
        Hold(ring=9.0, inside=20.0)


@pytest.mark.parametrize("name", POLICIES)
def test_shipped_policies_act_as_their_presets_say(name):
    preset = load_preset("fast" if name in ("wild", "any", "original") else name)
    assert POLICIES[name]().spec.action == preset.acting()
