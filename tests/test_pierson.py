"""The arc by hand."""

import math

import numpy as np
import pytest
from scenes import NOTHING, arranged, one_flock

from shepherd_phys.controllers import Pierson, PiersonReconstructed
from shepherd_phys.controllers.pierson import PiersonGains, PiersonSettings, arc_places, arc_width
from shepherd_phys.settings import SettingsError


@pytest.mark.parametrize("m", [2, 3, 4, 5, 6])
def test_no_push_is_a_ring_and_full_push_is_one_spot(m):
    assert arc_width(0.0, m) == pytest.approx(2 * math.pi * (m - 1) / m)
    assert arc_width(1.0, m) == pytest.approx(0.0, abs=1e-5)
    places = arc_places(np.zeros(2), 0.0, 8.0, arc_width(0.0, m), m)
    turn = np.diff(np.sort(np.arctan2(places[:, 1], places[:, 0])))
    assert turn == pytest.approx([2 * math.pi / m] * (m - 1))


@pytest.mark.parametrize("m", [2, 3, 4, 5, 6])
@pytest.mark.parametrize("push", [0.1, 0.5, 0.9])
def test_the_arc_gives_the_push(m, push):
    delta = arc_width(push, m) * (2 * np.arange(1, m + 1) - m - 1) / (2 * m - 2)
    assert np.cos(delta).sum() == pytest.approx(m * push)


def test_three_shepherds_in_closed_form():
    """1 + 2 cos(Delta / 2) = 3 v_hat; at 2/3 Delta is 120 degrees: two at 60 degrees, one straight behind."""
    assert arc_width(2 / 3, 3) == pytest.approx(2 * math.pi / 3)
    places = arc_places(np.array([10.0, 0.0]), math.pi, 8.0, 2 * math.pi / 3, 3)  # to the goal is along -x
    root = 4 * math.sqrt(3)
    assert places == pytest.approx(np.array([[14, -root], [18, 0], [14, root]]))


def test_a_lone_shepherd_stands_straight_behind():
    assert arc_width(0.3, 1) == 0.0
    assert arc_places(np.array([0.0, 5.0]), -math.pi / 2, 7.0, 0.0, 1) == pytest.approx(np.array([[0.0, 12.0]]))


def test_tuned_places_go_to_shepherds_in_their_order_round_the_flock():
    """Centroid 20 m out, so full push, floored at 60 degrees; extent (1 + 1) / 2 + 6 = 7 m."""
    sheep = [[21, 0], [19, 0], [20, 1], [20, -1]]
    team = Pierson()
    state = arranged(sheep, [[30, 5], [30, -5], [30, 0]])
    targets = team._targets(state, one_flock(sheep))
    side = 7 * math.cos(math.pi / 6)
    assert targets == pytest.approx(np.array([[20 + side, 3.5], [20 + side, -3.5], [27, 0]]))


def test_reconstructed_tracks_its_place_with_its_gain():
    """Centroid 12 m out, k 0.1, l 2: v = 1 m/s = the sheep's speed, so the place is straight behind."""
    literal = PiersonReconstructed(PiersonGains(gain=0.1, ahead=2.0, radius=6.0, tracking=0.5))
    literal.reset(np.random.default_rng(0))
    state = arranged([[12, 0], [12, 0]], [[18, 1.5], [18, -30]])
    assert literal.act(NOTHING, state) == pytest.approx(np.array([[0, -0.5], [0, 1]]), abs=1e-5)


def test_impossible_settings_are_refused():
    with pytest.raises(SettingsError, match="PiersonSettings.min_push"):
        PiersonSettings(min_push=2)
    with pytest.raises(SettingsError, match="PiersonGains.radius"):
        PiersonGains(radius=0)
