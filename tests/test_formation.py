"""What the tuned teams share: sub-flocks in order, places round the goal."""

import numpy as np
import pytest
from scenes import NOTHING, arranged

from shepherd_phys.bodies import BODIES, Disc, built
from shepherd_phys.controllers import CONTROLLERS
from shepherd_phys.controllers.formation import SLACK, TeamSettings, flocks_out
from shepherd_phys.controllers.places import beyond, in_order, leak_places, make_way
from shepherd_phys.controllers.strombom import StrombomTeam
from shepherd_phys.envs import ShepherdingEnv
from shepherd_phys.geometry import surfaces
from shepherd_phys.obstacles import Wall
from shepherd_phys.scenario import Scenario
from shepherd_phys.world import World

TUNED = ("strombom", "pierson", "elfiqi", "occlusion")


def flocks(*places):
    """Ten sheep at each place."""
    return [list(place) for place in places for _ in range(10)]


def test_sub_flocks_not_home_soonest_done_first_and_crumbs_last():
    sheep = [*flocks([20, 0], [0, 12], [-5, 0]), [7, 7]]
    state = arranged(sheep, [[30, 0]])
    assert [f[0].tolist() for f in flocks_out(state, 3.0, 5.5).sheep] == [[7, 7], [0, 12], [20, 0]]
    assert [f[0].tolist() for f in flocks_out(state, 3.0, 5.5, crumb=0.2).sheep] == [[0, 12], [20, 0], [7, 7]]
    assert flocks_out(state, 3.0, 25.0, crumb=0.2).sheep == []


def test_a_team_keeps_to_its_sub_flock_until_another_is_much_sooner_done():
    team = StrombomTeam()
    team.reset(np.random.default_rng(0))

    def at_work(*places):
        state = arranged(flocks(*places), [[0, 20]] * 3)
        team.act(NOTHING, state)
        return team._at.tolist()

    assert at_work([15, 0], [-16, 0]) == [15, 0]
    assert at_work([17, 0], [-16, 0]) == [17, 0]
    assert at_work([20.5, 0], [-16, 0]) == [-16, 0]


def test_a_small_team_stands_behind_the_sheep_that_leans_out_furthest():
    state = arranged([[1, 0], [0, -3], [-2, 0]], [[0, 20]])
    assert leak_places(state, 12.0) == pytest.approx(np.array([[0, -12]]))
    pair = arranged([[1, 0], [0, -3], [-2, 0]], [[1, 20], [0, -20]])
    assert leak_places(pair, 12.0) == pytest.approx(np.array([[0, 12], [0, -12]]), abs=1e-9)


def test_slots_are_taken_without_crossing_on_the_far_side_too():
    """Both just short of 180 degrees: the two go round opposite ways, each the one nearer to it."""
    assert in_order(np.deg2rad([177.0, 174.0]), np.deg2rad([-30.0, 30.0])).tolist() == [0, 1]
    assert in_order(np.deg2rad([20.0, -20.0]), np.deg2rad([-30.0, 30.0])).tolist() == [1, 0]
    assert in_order(np.empty(0), np.empty(0)).tolist() == []


def test_targets_too_near_the_goal_move_straight_out():
    moved = beyond(np.array([[3.0, 4.0], [12.0, 0.0]]), np.zeros(2), 10.0)
    assert moved == pytest.approx(np.array([[6.0, 8.0], [12.0, 0.0]]))


@pytest.mark.slow
@pytest.mark.parametrize("n_shepherds", [1, 2, 3, 6])
@pytest.mark.parametrize("name", TUNED)
def test_every_tuned_team_delivers_two_flocks_and_holds_them(name, n_shepherds):
    env = ShepherdingEnv(Scenario(n_flocks=2, shepherds=n_shepherds), rewards={}, lidar=None)
    controller = CONTROLLERS[name]()
    observation, _ = env.reset(seed=1)
    controller.reset(env.user_rng)
    for _ in range(1000):  # the whole episode: six of strombom are still on their way after 700
        observation, *_, info = env.step(controller.act(observation, env.state))
    assert info["in_goal"] > 0.9


def test_two_that_meet_head_on_both_step_to_their_right():
    pos, targets = np.array([[0.0, 0.0], [0.6, 0.0], [0.3, 5.0]]), np.array([[5.0, 0.0], [-5.0, 0.0], [0.3, 9.0]])
    aside = make_way(pos, targets)
    assert aside[0] == pytest.approx([np.cos(1.2), -np.sin(1.2)])
    assert aside[1] == pytest.approx([0.6 - np.cos(1.2), np.sin(1.2)])
    assert aside[2].tolist() == [0.3, 9.0]
    behind = make_way(pos[:2], np.array([[5.0, 0.0], [5.0, 0.0]]))
    assert behind[1].tolist() == [5.0, 0.0]  # who is in front goes on
    arrived = make_way(pos[:2], pos[:2])
    assert arrived.tolist() == pos[:2].tolist()


WALLED = (Wall((-15.0, 0.0), (-4.0, 0.0)), Wall((4.0, 0.0), (15.0, 0.0)), Wall((0.0, 6.0), (0.0, 18.0)))


@pytest.mark.parametrize("name", TUNED)
def test_every_tuned_team_walks_and_leads_its_flock_round_walls(name):
    world = World(Scenario(n_sheep=40, n_flocks=1, obstacles=WALLED))
    drawn = world.reset(0)
    # the goal is on one side of the first wall, flock and shepherds are on the other
    flock = drawn.sheep_pos - drawn.sheep_pos.mean(axis=0) + (-9.5, -8.0)
    start = drawn.but(goal_pos=(-10.0, 10.0), sheep_pos=flock, shepherd_pos=[(-20, -10), (-14, 4), (-8, 15)])
    state = world.reset_to(start, seed=1)
    controller = CONTROLLERS[name]()
    controller.reset(world.user_rng)
    around, nearest = surfaces(WALLED), np.inf
    for _ in range(700):
        state = world.step(controller.act(NOTHING, state))
        nearest = min(nearest, around.static_distances(state.shepherd_pos)[0].min())
    assert state.sheep_in_goal.mean() >= 0.95
    assert nearest > 0.25  # the radius of a shepherd: none touched a wall


@pytest.mark.parametrize(("radius", "through"), [(0.25, 0.0), (0.8, 7.5)])
def test_a_shepherd_takes_a_gap_through_which_it_fits(radius, through):
    fence = (Wall((0.0, -30.0), (0.0, -0.65)), Wall((0.0, 0.65), (0.0, 6.0)), Wall((0.0, 9.0), (0.0, 30.0)))
    world = World(Scenario(n_sheep=1, n_flocks=1, shepherds=(Disc(radius=radius),), obstacles=fence))
    drawn = world.reset(0)
    state = world.reset_to(drawn.but(goal_pos=(-30.0, 0.0), sheep_pos=[(12.0, 0.0)], shepherd_pos=[(-5.0, 0.0)]), 1)
    team = CONTROLLERS["strombom"]()
    team.reset(world.user_rng)
    for _ in range(200):
        state = world.step(team.act(NOTHING, state))
        if state.shepherd_pos[0, 0] > 0:
            break
    assert state.shepherd_pos[0] == pytest.approx([0.0, through], abs=1.0)
    assert state.collisions == 0


def test_no_body_of_the_library_needs_more_room_than_the_teams_leave():
    for body in BODIES.values():
        assert built(body(), "shepherd")[2] + SLACK <= TeamSettings().clearance
