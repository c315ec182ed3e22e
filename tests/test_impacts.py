"""Nothing gets through thin and small obstacles of any kind at the default engine settings; the experiment can fail."""

import pytest

from shepherd_phys.bodies import Disc
from shepherd_phys.scripts.impacts import KINDS, impacts


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


@pytest.mark.slow
def test_none_of_a_hundred_thousand_gets_through():
    result = impacts(100_000, seed=2)
    assert result["impacts"] >= 100_000
    assert result["tunnelled"] == 0
    assert result["deepest_overlap_at_rest_m"] < 0.01
