"""Who goes where, and who pushes, by hand."""

import math

import numpy as np
import pytest
from scenes import arranged, one_flock

from shepherd_phys.controllers import Occlusion
from shepherd_phys.controllers.places import WEDGE
from shepherd_phys.controllers.occlusion import occlusion_targets, shared_out


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
