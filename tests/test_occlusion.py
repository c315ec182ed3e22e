"""Who goes where, and who pushes, by hand."""

import math

import numpy as np
import pytest
from scenes import NOTHING, arranged, one_flock

from shepherd_phys.controllers import Occlusion
from shepherd_phys.controllers.occlusion import occlusion_targets, shared_out, traded
from shepherd_phys.controllers.places import WEDGE
from shepherd_phys.controllers.routes import Routes
from shepherd_phys.geometry import surfaces
from shepherd_phys.obstacles import Pillar, Wall


def targets_of(pos, goal=(0.0, 0.0), center=(20.0, 0.0), radius=2.0):
    pos = np.array([pos], float)
    targets, _ = occlusion_targets(
        pos, np.array([goal]), np.array([center]), np.array([radius]), np.array([radius + 4.0]), 8.0
    )
    return targets[0]


def test_a_sub_flock_each_from_the_largest_on_and_the_rest_to_the_largest():
    centers = np.array([[0, 0], [20, 0], [40, 0]], float)
    pos = np.array([[19, 0], [21, 0], [22, 0], [1, 0]], float)
    # the second is largest and takes shepherd 0, the third takes 2, the first 3; 1 is left over
    assert shared_out(pos, centers, np.array([5, 50, 45])).tolist() == [1, 1, 2, 0]
    assert shared_out(pos[:1], centers, np.array([5, 50, 45])).tolist() == [1]


def test_straight_behind_the_flock_it_pushes():
    assert targets_of([30, 0]) == pytest.approx([26, 0])


def test_the_cone_in_which_the_goal_is_hidden():
    """At (20 + 10 cos a, 10 sin a): beta is the angle there between the flock 10 m on and the goal."""
    limit = math.atan(0.2)
    for degrees in (5, 10, 15, 20, 40):
        a = math.radians(degrees)
        here = np.array([20 + 10 * math.cos(a), 10 * math.sin(a)])
        beta = a - math.atan2(here[1], here[0])
        distance = np.linalg.norm(targets_of(here) - [20, 0])
        assert distance == pytest.approx(6.0 if beta < limit else 10.0)


def test_it_circles_in_the_sense_that_shrinks_the_angle():
    above, below = targets_of([20, 10]), targets_of([20, -10])
    a = math.pi / 2 - WEDGE
    assert above - [20, 0] == pytest.approx([10 * math.cos(a), 10 * math.sin(a)])
    assert below - [20, 0] == pytest.approx([10 * math.cos(a), -10 * math.sin(a)])


def test_sheep_behind_the_goal_hide_nothing():
    """Shepherd, goal and flock in a line, in that order: pushing would drive the flock away."""
    assert np.linalg.norm(targets_of([-10, 0]) - [20, 0]) == pytest.approx(10.0)


def test_behind_a_long_flock_it_stands_near_enough_to_be_felt():
    """R_c is 9 m across; towards the shepherd the flock reaches 1 m."""
    sheep = np.array([[20, y] for y in range(-9, 10)] + [[21, 0], [19, 0]], float)
    targets = Occlusion()._targets(arranged(sheep, [[30, 0]]), one_flock(sheep))
    assert targets == pytest.approx(np.array([[25.0, 0.0]]))


def walks(state, steps=400, slow=0.3):
    """Where shepherds come to that walk unhindered while the sheep stand still: (steps, P, 2)."""
    team = Occlusion()
    team.reset(np.random.default_rng(0))
    ways = []
    for _ in range(steps):
        state = state.but(shepherd_pos=state.shepherd_pos + slow * team.act(NOTHING, state))
        ways.append(state.shepherd_pos)
    return np.array(ways)


def test_a_wall_across_its_circle_does_not_send_it_back_and_forth():
    """The circle of 10 m round the flock cuts the wall; the shepherd ends where the flock hides the goal."""
    sheep = [[20 + x, y] for x in (-1, 0, 1) for y in (-1, 0, 1)]
    for wall in (Wall((14.0, 4.0), (24.0, 14.0)), Wall((4.0, 7.0), (36.0, 7.0)), Wall((16.0, 8.0), (36.0, 8.0))):
        state = arranged(sheep, [[8.0, 12.0]]).but(obstacles=(wall,))
        way = walks(state)[:, 0]
        assert way[-1, 0] > 24 and abs(way[-1, 1]) < 3
        assert surfaces((wall,)).static_distances(way)[0].min() > 0.25


def test_behind_a_flock_means_on_its_side_of_a_wall():
    team = Occlusion()
    team.reset(np.random.default_rng(0))
    sheep = [[20, y] for y in (-1, 0, 1)]
    for x, behind in ((40.0, 29.0), (28.0, 27.0), (23.0, 29.0)):  # none; it stands nearer; too near to stand before it
        state = arranged(sheep, [[20.0, 20.0]]).but(obstacles=(Wall((x, -30.0), (x, 30.0)),))
        team.act(NOTHING, state)
        assert team._behind(np.array([[20.0, 0.0]]), np.zeros((1, 2)), np.ones(1))[0] == pytest.approx([behind, 0.0])


def test_nobody_steps_aside_into_a_wall():
    """Two meet head-on beside a wall: the one that has it on its right goes on, the other steps to its right."""
    team = Occlusion()
    team.reset(np.random.default_rng(0))
    pos, targets = np.array([[0.0, 0.0], [0.6, 0.0]]), np.array([[5.0, 0.0], [-5.0, 0.0]])
    state = arranged([[30, 0]], pos).but(obstacles=(Wall((-9.0, -0.6), (9.0, -0.6)),))
    team.act(NOTHING, state)
    aside = team._aside(pos, targets)
    assert aside[0].tolist() == [5.0, 0.0]
    assert aside[1] == pytest.approx([0.6 - math.cos(1.2), math.sin(1.2)])


def test_places_round_the_goal_are_traded_where_one_stands_in_the_others_way():
    pos, places = np.array([[0.0, 0.0], [1.0, 0.1]]), np.array([[8.0, 0.0], [1.0, 0.0]])
    free = Routes(surfaces((Pillar((0.0, 20.0), 1.0),)), 0.5)
    assert traded(free, pos, places).tolist() == [[1.0, 0.0], [8.0, 0.0]]
    assert traded(free, pos, places[::-1]).tolist() == [[1.0, 0.0], [8.0, 0.0]]
    # as the crow flies each would be nearer to the other's, across a long wall
    walled = Routes(surfaces((Wall((0.5, -30.0), (0.5, 30.0)),)), 0.5)
    pos, places = np.array([[-1.0, 0.0], [2.0, -8.0]]), np.array([[-1.0, -8.0], [2.0, 0.0]])
    assert traded(walled, pos, places).tolist() == places.tolist()
