"""Nothing gets through thin and small obstacles of any kind at the default engine settings; the experiment can fail."""

import numpy as np
import pymunk
import pytest

from shepherd_phys.bodies import Disc
from shepherd_phys.scripts.impacts import KINDS, _Gap, _way_round, impacts


def test_no_body_tunnels_at_the_defaults():
    result = impacts(1_200, seed=1)
    assert result["impacts"] == 1_200
    assert result["touched"] > 1_190  # a few run past a small obstacle's edge
    assert result["tunnelled"] == 0
    assert result["tunnelled_by_kind"] == dict.fromkeys(KINDS, 0)
    assert result["deepest_overlap_at_rest_m"] < 0.01
    assert result["deepest_overlap_m"] > result["deepest_overlap_at_rest_m"]


def test_one_engine_step_is_too_few_and_the_experiment_says_so():
    assert impacts(240, seed=1, substeps=1)["tunnelled"] > 10


def test_the_shepherds_body_may_be_another():
    heavy = impacts(120, seed=1, shepherd=Disc(radius=0.4, mass=8.0, max_speed=1.0))
    assert heavy["tunnelled"] == 0
    assert heavy["touched"] > 110


def test_the_way_round_a_shape():
    square = pymunk.Poly(pymunk.Body(body_type=pymunk.Body.STATIC), [(0, 0), (1, 0), (1, 1), (0, 1)])
    straight_through = _way_round(square, np.array([-0.5, 0.25]), np.array([1.5, 0.25]))
    assert straight_through == pytest.approx(2 * np.hypot(0.5, 0.25) + 1.0)
    round_a_corner = _way_round(square, np.array([0.75, -0.25]), np.array([1.25, 0.375]))
    assert round_a_corner == pytest.approx(np.hypot(0.25, 0.25) + np.hypot(0.25, 0.375))
    disc = pymunk.Circle(square.body, 1.0)
    over = _way_round(disc, np.array([-2.0, 0.0]), np.array([2.0, 0.0]))
    assert over == pytest.approx(2 * np.sqrt(3) + np.pi / 3, rel=2e-3)  # tangents of 60 degrees, and the arc between


@pytest.mark.parametrize(
    ("start", "end", "through"),
    [((-0.15, 5.0), (0.14, 5.0), True), ((0.105, 4.659), (0.266, 4.822), False), ((0.1, 4.6), (0.3, 4.6), False)],
    ids=["through the middle", "round a corner", "beside it"],
)
def test_who_slides_round_a_corner_went_through_nothing(start, end, through):
    gaps = _Gap((KINDS["Polygon"](5.0),), np.array([0]))
    assert gaps.crossed(np.array([start]), np.array([end]), np.array([True]), 0.3).tolist() == [through]


@pytest.mark.slow
def test_none_of_a_hundred_thousand_gets_through():
    result = impacts(100_000, seed=2)
    assert result["impacts"] >= 100_000
    assert result["tunnelled"] == 0
    assert result["deepest_overlap_at_rest_m"] < 0.01
