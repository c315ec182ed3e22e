"""What a critic sees of the whole world, by hand and by its symmetries."""

import numpy as np
import pytest
from scenes import arranged
from team_scenes import view


def test_the_critics_view_by_hand():
    # one sheep in the goal to the east, one 6 m outside it to the north, one between two rings and two bearings
    between = (2.5 + 4.75) * np.array([np.cos(np.pi / 8), np.sin(np.pi / 8)])
    state = arranged([[1.0, 0.0], [0.0, 8.5], between], [[-12.5, 0.0], [0.0, -3.5]])
    seen = view(state, [0.0, np.pi / 2])
    sheep = seen[:, :64].reshape(2, 8, 8) * 3
    expected = np.zeros((8, 8))  # rings by bearings
    expected[0, 0] = 1.0
    expected[3, 2] = 1.0
    expected[2, :2] += 0.25
    expected[3, :2] += 0.25
    assert sheep[0] == pytest.approx(expected, abs=1e-6)
    assert sheep[1] == pytest.approx(np.roll(expected, -2, axis=1), abs=1e-6)  # its x axis is the world's y axis
    others = seen[:, 64:96].reshape(2, 4, 8) * 6
    assert (others[0, 0, 6], others[0].sum()) == pytest.approx((1.0, 1.0))  # south, 1 m from the border
    # west, 10 m from the border, between rings at 6 and 12 m; west is 90 degrees to the left of north
    assert (others[1, 1, 2], others[1, 2, 2], others[1].sum()) == pytest.approx((1 / 3, 2 / 3, 1.0))
    assert seen[0, 96:] == pytest.approx([-12.5 / 25, 0.0, 1 / 3, 1 / 3, 2 / 6])
    assert seen[1, 96:] == pytest.approx([-3.5 / 25, 0.0, 1 / 3, 1 / 3, 2 / 6], abs=1e-7)


def test_the_critics_view_turns_with_the_frame_and_does_not_care_who_is_who():
    rng = np.random.default_rng(0)
    sheep, shepherds = rng.normal(0, 12, (30, 2)), rng.normal(0, 15, (4, 2))
    a = 1.234
    turned = np.array([[np.cos(a), np.sin(a)], [-np.sin(a), np.cos(a)]])
    seen = view(arranged(sheep, shepherds), [0.0] * 4)
    assert seen[:, :64].sum(axis=1) == pytest.approx(np.ones(4), rel=1e-5)
    assert seen[:, 64:96].sum(axis=1) * 6 == pytest.approx(np.full(4, 3.0), rel=1e-5)
    again = view(arranged(sheep @ turned, shepherds @ turned), [a] * 4)
    assert again == pytest.approx(seen, abs=1e-5)
    order = [2, 0, 3, 1]
    mixed = view(arranged(sheep[::-1], shepherds[order]), [0.0] * 4)
    assert mixed == pytest.approx(seen[order], abs=1e-6)


def test_the_critic_in_a_mirror_sees_the_mirrored_world():
    rng = np.random.default_rng(4)
    sheep, shepherds, angle = rng.normal(0, 15, (30, 2)), rng.normal(0, 15, (3, 2)), rng.uniform(-3, 3, 3)
    flip = np.array([1.0, -1.0])
    mirrored = view(arranged(sheep, shepherds), angle, mirrored=True)
    np.testing.assert_allclose(mirrored, view(arranged(sheep * flip, shepherds * flip), -angle), atol=1e-6)
    assert not np.allclose(mirrored, view(arranged(sheep, shepherds), angle))
