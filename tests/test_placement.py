"""Where worlds start: who is drawn where, and no overlap."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from shepherd_phys.placement import PlacementError, flock_of, place, relax
from shepherd_phys.settings import SettingsError


def least_gap(pos, radius):
    distance = np.hypot(*(pos[:, None] - pos[None]).transpose(2, 0, 1)) - radius[:, None] - radius
    return distance[np.triu_indices(len(pos), 1)].min(initial=np.inf)


def test_flocks_are_even_and_the_larger_come_first():
    assert np.bincount(flock_of(100, 3)).tolist() == [34, 33, 33]
    assert np.bincount(flock_of(101, 3)).tolist() == [34, 34, 33]
    assert np.bincount(flock_of(2, 3)).tolist() == [1, 1]
    assert np.bincount(flock_of(6, 3, (1, 3, 2))).tolist() == [1, 3, 2]


def test_sizes_that_are_given_move_sheep_between_flocks_and_nothing_else():
    arguments = {"n_sheep": 5, "n_flocks": 2, "n_shepherds": 1, "flock_sd": 1e-9}
    goal, even, shepherd = place(np.random.default_rng(3), **arguments)
    same_goal, uneven, same_shepherd = place(np.random.default_rng(3), **arguments, flock_sizes=(1, 4))
    np.testing.assert_array_equal(goal, same_goal)
    np.testing.assert_array_equal(shepherd, same_shepherd)
    np.testing.assert_allclose(even, even[[0, 0, 0, 3, 3]], atol=1e-7)
    np.testing.assert_allclose(uneven, even[[0, 3, 3, 3, 3]], atol=1e-7)


def test_the_same_seed_places_the_same_in_the_documented_order():
    goal, sheep, shepherds = place(np.random.default_rng(8), n_sheep=7, n_flocks=2, n_shepherds=3)
    rng = np.random.default_rng(8)
    expected_goal = 50.0 * (rng.random(2) - 0.5)
    bearing, distance = 2 * np.pi * rng.random(2), 10 + 10 * rng.random(2)
    centres = expected_goal + distance[:, None] * np.column_stack([np.cos(bearing), np.sin(bearing)])
    np.testing.assert_array_equal(goal, expected_goal)
    np.testing.assert_array_equal(sheep, centres[[0, 0, 0, 0, 1, 1, 1]] + rng.standard_normal((7, 2)))
    np.testing.assert_array_equal(shepherds, 50.0 * (rng.random((3, 2)) - 0.5))


def test_a_given_goal_moves_the_flocks_and_nothing_else():
    goal, sheep, shepherds = place(np.random.default_rng(9), n_sheep=5, n_flocks=1, n_shepherds=2)
    given_goal, moved, same = place(
        np.random.default_rng(9), n_sheep=5, n_flocks=1, n_shepherds=2, goal_pos=(3.0, -4.0)
    )
    np.testing.assert_array_equal(given_goal, [3.0, -4.0])
    np.testing.assert_allclose(moved - given_goal, sheep - goal, atol=1e-12)
    np.testing.assert_array_equal(same, shepherds)


def test_where_things_are_drawn():
    goals, distances, bearings, spreads, shepherds = [], [], [], [], []
    for seed in range(400):
        goal, sheep, team = place(np.random.default_rng(seed), n_sheep=40, n_flocks=2, n_shepherds=3)
        goals.append(goal)
        shepherds.append(team)
        for flock in (0, 1):
            members = sheep[flock_of(40, 2) == flock]
            x, y = members.mean(axis=0) - goal
            distances.append(np.hypot(x, y))
            bearings.append(np.arctan2(y, x))
            spreads.append(members.std(axis=0, ddof=1))
    for drawn in (np.array(goals), np.concatenate(shepherds)):
        assert np.abs(drawn).max() <= 25
        assert np.abs(drawn.mean(axis=0)).max() < 2.5 and np.abs(drawn.std(axis=0) - 50 / 12**0.5).max() < 1.5
    assert 9 < min(distances) < 11 and 19 < max(distances) < 21 and abs(np.mean(distances) - 15) < 0.4
    assert abs(np.mean(np.exp(1j * np.array(bearings)))) < 0.1
    assert abs(np.mean(spreads) - 1) < 0.03


def test_bearings_can_be_narrowed():
    _, sheep, _ = place(
        np.random.default_rng(1), n_sheep=50, n_flocks=50, n_shepherds=1, flock_bearing=(1.0, 1.2),
        flock_distance=(14.0, 20.0), flock_sd=0.0, goal_pos=(0.0, 0.0),
    )  # fmt: skip
    bearing, distance = np.arctan2(sheep[:, 1], sheep[:, 0]), np.hypot(sheep[:, 0], sheep[:, 1])
    assert bearing.min() >= 1.0 and bearing.max() <= 1.2 and distance.min() >= 14 and distance.max() <= 20


@pytest.mark.parametrize("size", [1, 2, 50, 100, 700])
def test_a_flock_is_relaxed_and_stays_compact(size):
    pos = np.random.default_rng(2).standard_normal((size, 2)) * np.sqrt(size / 100)
    radius = np.full(size, 0.15)
    placed = relax(pos, radius)
    assert least_gap(placed, radius) >= 0
    assert placed.std() <= 1.15 * pos.std() + 0.15
    np.testing.assert_array_equal(placed, relax(pos, radius))


@settings(max_examples=80, deadline=None)
@given(
    pos=st.lists(
        st.tuples(st.one_of(st.floats(-3, 3), st.sampled_from([0.0, 0.5, 1e5])), st.floats(-3, 3)),
        min_size=1, max_size=90,
    ),
    seed=st.integers(0, 100),
)  # fmt: skip
def test_no_overlap_is_left(pos, seed):
    radius = np.random.default_rng(seed).uniform(0.05, 0.4, len(pos))
    placed = relax(np.array(pos), radius)
    assert least_gap(placed, radius) >= 0


def test_coincident_bodies_part():
    radius = np.full(150, 0.15)
    placed = relax(np.zeros((150, 2)), radius)
    assert least_gap(placed, radius) >= 0
    assert np.hypot(placed[:, 0], placed[:, 1]).max() < 4


def test_bodies_with_room_stay_where_they_are():
    pos = np.array([[0.0, 0.0], [1.0, 0.0], [5.0, 5.0], [5.1, 5.0]])
    placed = relax(pos, np.full(4, 0.3))
    np.testing.assert_array_equal(placed[:2], pos[:2])
    np.testing.assert_allclose(placed[2:].mean(axis=0), [5.05, 5.0])


def test_fixed_bodies_stay_and_nothing_is_changed_in_place():
    pos = np.random.default_rng(3).uniform(-1, 1, (30, 2))
    before, radius, movable = pos.copy(), np.full(30, 0.15), np.arange(30) > 0
    placed = relax(pos, radius, movable=movable)
    np.testing.assert_array_equal(pos, before)
    np.testing.assert_array_equal(placed[0], pos[0])
    assert least_gap(placed, radius) >= 0


def right_of_zero(pos, radius):
    return np.column_stack([np.maximum(pos[:, 0], radius), pos[:, 1]])


def test_bodies_are_pushed_out_of_what_is_solid():
    pos, radius = np.random.default_rng(4).standard_normal((80, 2)), np.full(80, 0.15)
    placed = relax(pos, radius, push_out=right_of_zero)
    assert least_gap(placed, radius) >= 0
    assert (placed[:, 0] >= radius).all()


def in_a_box(pos, radius):
    return np.clip(pos, -0.5, 0.5)


def test_too_little_room_is_an_error_that_says_so():
    with pytest.raises(
        PlacementError, match=r"of 40 bodies still overlap another or an obstacle after 25 sweeps: n_sheep, flock_sd"
    ):
        relax(np.random.default_rng(5).standard_normal((40, 2)), np.full(40, 0.3), push_out=in_a_box, max_sweeps=25)
    assert issubclass(PlacementError, SettingsError)


def test_two_fixed_bodies_that_overlap_are_an_error():
    with pytest.raises(PlacementError, match="2 of 3 bodies"):
        relax(np.zeros((3, 2)), np.full(3, 0.1), movable=np.array([False, False, True]))


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_positions_must_be_finite(bad):
    with pytest.raises(PlacementError, match="finite"):
        relax(np.array([[0.0, bad]]), np.ones(1))
