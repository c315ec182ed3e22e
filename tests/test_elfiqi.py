"""Strays, fan and circle by hand."""

import math

import numpy as np
import pytest
from scenes import NOTHING, arranged, one_flock

from shepherd_phys.controllers import Elfiqi, ElfiqiLiteral
from shepherd_phys.controllers.elfiqi import (
    ElfiqiSettings,
    elfiqi_targets,
    nearest_strays,
    shepherd_repulsion,
    undisturbing,
)
from shepherd_phys.obstacles import Pillar

COMPACT = [[21, 0], [19, 0], [20, 1], [20, -1]]


def test_each_shepherd_takes_the_stray_nearest_to_itself_in_order():
    flock = np.array([[0, 0]] * 8 + [[0, 10], [0, -10]], float)
    pos = np.array([[1, 9], [2, 9], [0, 0]], float)
    assert nearest_strays(pos, flock, 5.0).tolist() == [8, 9, -1]
    assert nearest_strays(pos, flock, 11.0).tolist() == [-1, -1, -1]


def test_published_targets():
    """Driving: 9 m behind, the others 30 degrees to each side of the first, as far out as that one is now."""
    state = arranged(COMPACT, [[32, 0], [0, 9], [0, -9]])
    side = 12 * math.cos(math.pi / 6)
    assert elfiqi_targets(state, 5.0, 4.0) == pytest.approx(np.array([[29, 0], [20 + side, -6], [20 + side, 6]]))
    sheep = [[20, 0]] * 9 + [[20, 10]]  # centroid (20, 1), a stray 9 m above it
    targets = elfiqi_targets(arranged(sheep, [[40, 40], [50, 1]]), 5.0, 4.0)
    assert targets[0].tolist() == [20, 14]
    behind = np.array([20, 1]) / math.hypot(20, 1)
    assert targets[1] == pytest.approx([20, 1] + 9 * behind)


def test_the_fourth_and_fifth_refer_to_the_second_and_third():
    """pi / 10 = 18 degrees for five shepherds."""
    pos = [[30, 0], [20, -8], [20, 7], [0, 1], [0, 2]]
    targets = elfiqi_targets(arranged(COMPACT, pos), 5.0, 4.0) - [20, 0]
    for target, (length, degrees) in zip(targets, [(9, 0), (10, -18), (10, 18), (8, -108), (7, 108)], strict=True):
        a = math.radians(degrees)
        assert target == pytest.approx([length * math.cos(a), length * math.sin(a)])


def test_nobody_steps_into_the_circle_but_near_its_targets_bearing():
    center, safe, step = np.zeros(2), 19.0, np.full(3, 0.3)
    pos = np.array([[-19.0, 0.0], [19.0, 0.0], [-10.0, 0.0]])
    targets = np.array([[0.0, 9.0], [9.0, 0.0], [0.0, 9.0]])
    following = pos + np.array([[0.3, 0.0], [-0.3, 0.0], [0.3, 0.0]])
    now = undisturbing(pos, following, targets, center, safe, step)
    a = math.pi - 0.3 / 19
    assert now[0] == pytest.approx([19 * math.cos(a), 19 * math.sin(a)])  # round it, the shorter way
    assert now[1].tolist() == [18.7, 0.0]  # within the wedge: in
    assert np.linalg.norm(now[2]) == pytest.approx(10.3)  # already inside: outwards and on


def test_shepherds_repel_one_another_within_two_metres():
    push = shepherd_repulsion(np.array([[0.0, 0.0], [1.0, 0.0], [9.0, 0.0]]))
    assert push == pytest.approx(np.array([[-math.exp(-1), 0], [math.exp(-1), 0], [0, 0]]))


def test_published_obstacles_repel():
    """Surface 1 m to the left: 2 exp(-2 / 5) = 1.34 to the right outweighs the way to the target."""
    literal = ElfiqiLiteral()
    literal.reset(np.random.default_rng(0))
    state = arranged([[0, 20], [0, 20]], [[8.0, 60.0]]).but(obstacles=(Pillar((6.0, 60.0), 1.0),))
    assert literal.act(NOTHING, state)[0, 0] > 0.5
    assert literal.act(NOTHING, state.but(obstacles=()))[0, 0] < 0


def test_tuned_drivers_fan_out_to_fixed_places_without_crossing():
    targets = Elfiqi(ElfiqiSettings())._targets(arranged(COMPACT, [[32, 3], [32, -3], [32, 0]]), one_flock(COMPACT))
    side, up = 8.5 * math.cos(math.pi / 6), 8.5 / 2
    assert targets == pytest.approx(np.array([[20 + side, up], [20 + side, -up], [28.5, 0]]))
