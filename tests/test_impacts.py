"""Nothing gets through thin walls and small pillars at the default engine settings; and the experiment can fail."""

from shepherd_phys.scripts.impacts import impacts


def test_no_body_tunnels_at_the_defaults():
    result = impacts(1_200, seed=1)
    assert result["impacts"] == result["touched"] == 1_200
    assert result["tunnelled"] == 0


def test_one_engine_step_is_too_few_and_the_experiment_says_so():
    assert impacts(240, seed=1, substeps=1)["tunnelled"] > 10
