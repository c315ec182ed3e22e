"""Scenarios drawn anew."""

import numpy as np
import pytest
from team_scenes import SMALL

from shepherd_phys.envs.mixture import Mixture
from shepherd_phys.layouts import Fenced, Scattered
from shepherd_phys.lidar import CHANNELS
from shepherd_phys.scenario import SCENARIOS
from shepherd_phys.settings import SettingsError
from shepherd_phys.world import World


def test_mixture_draws_within_its_ranges_and_from_its_stream():
    mixture = Mixture(base=SMALL, n_flocks=(1, 3), n_neighbours=(2, 5))
    drawn = [mixture(np.random.default_rng(k), 0) for k in range(60)]
    assert {s.n_flocks for s in drawn} == {1, 2, 3}
    assert {s.flock.n_neighbours for s in drawn} == {2, 3, 4, 5}
    assert all(s.but(n_flocks=2, flock=SMALL.flock) == SMALL for s in drawn)
    assert mixture(np.random.default_rng(7), 0) == mixture(np.random.default_rng(7), 5)
    kept = mixture.but(n_neighbours=None)(np.random.default_rng(0), 0)
    assert kept.flock == SMALL.flock
    with pytest.raises(SettingsError, match="n_flocks may be 9, more than there are sheep"):
        Mixture(base=SMALL, n_flocks=(1, 9))
    with pytest.raises(SettingsError, match="base.flock_sizes: a mixture draws its own"):
        Mixture(base=SMALL.but(flock_sizes=(1, 5)), n_flocks=(1, 2))
    with pytest.raises(SettingsError, match="the smaller number comes first"):
        Mixture(n_flocks=(3, 1))
    with pytest.raises(SettingsError, match=r"n_flocks.*integer.*given: 'a'"):
        Mixture(n_flocks=(1, "a"))


def test_flocks_of_a_mixture_may_differ_in_size():
    mixture = Mixture(base=SMALL, n_flocks=(1, 4), n_neighbours=None, uneven=0.5)
    drawn = [mixture(np.random.default_rng(k), 0) for k in range(400)]
    uneven = [s for s in drawn if s.flock_sizes is not None]
    assert 150 < len(uneven) < 250
    for s in uneven:
        assert len(s.flock_sizes) == s.n_flocks and sum(s.flock_sizes) == SMALL.n_sheep and min(s.flock_sizes) >= 1
    # two flocks of six sheep: 1 + binomial(4, u) with u uniform gives every size from 1 to 5 alike
    sizes = [s.flock_sizes[0] for s in uneven if s.n_flocks == 2]
    assert set(sizes) == {1, 2, 3, 4, 5}
    world = World(uneven[0])
    assert world.reset(0).n_sheep == SMALL.n_sheep
    assert all(s.flock_sizes is None for s in (mixture.but(uneven=0.0)(np.random.default_rng(k), 0) for k in range(20)))


def test_a_mixture_gives_each_sheep_of_a_larger_herd_as_much_of_the_goal():
    mixture = Mixture(base=SMALL, n_flocks=(1, 3), n_neighbours=None, n_sheep=(5, 20), uneven=0.5)
    rng = np.random.default_rng(0)
    drawn = [mixture(rng, 0) for _ in range(400)]
    assert {s.n_sheep for s in drawn} == set(range(5, 21))
    rooms = [s.goal_radius**2 / s.n_sheep for s in drawn]
    assert rooms == pytest.approx([SMALL.goal_radius**2 / SMALL.n_sheep] * 400)
    # 5 to 10 is as likely as 10 to 20, but that what lies between 9.5 and 10 is rounded up
    assert 150 < sum(s.n_sheep < 10 for s in drawn) < 220
    assert all(sum(s.flock_sizes) == s.n_sheep for s in drawn if s.flock_sizes is not None)
    assert World(drawn[0]).reset(0).n_sheep == drawn[0].n_sheep
    assert mixture.but(n_sheep=(7, 7))(rng, 0).n_sheep == 7
    with pytest.raises(SettingsError, match=r"n_flocks may be 3, more than there are sheep \(2\)"):
        mixture.but(n_sheep=(2, 9))


def test_the_extremes_of_a_mixture_hold_the_most_that_is_drawn():
    mixture = Mixture(base=SCENARIOS["scattered"], others=(SMALL,), n_flocks=(1, 2), n_sheep=(6, 24), density=(0, 0.2))
    full, small = mixture.extremes()
    assert (full.layout, full.n_sheep) == (Scattered(density=0.2), 24)
    assert small.n_sheep == 24 and small.goal_radius == pytest.approx(2 * SMALL.goal_radius)
    assert small.layout is None


def test_a_mixture_draws_among_scenarios_and_densities():
    mixture = Mixture(
        base=SCENARIOS["scattered"],
        others=(SCENARIOS["paper"], SCENARIOS["fence"]),
        n_flocks=(1, 2),
        density=(0.0, 0.05),
    )
    drawn = [mixture(np.random.default_rng(k), 0) for k in range(300)]
    kinds = [type(s.layout).__name__ for s in drawn]
    assert {kind: kinds.count(kind) > 70 for kind in set(kinds)} == dict.fromkeys(
        ("Scattered", "NoneType", "Fenced"), True
    )
    covered = [s.layout.density for s in drawn if isinstance(s.layout, Scattered)]
    assert 0 <= min(covered) < 0.01 and 0.04 < max(covered) <= 0.05
    fenced = next(s for s in drawn if isinstance(s.layout, Fenced))
    assert fenced.flock_distance == SCENARIOS["fence"].flock_distance and fenced.flock_spread is not None
    assert (
        mixture.channels == CHANNELS
        and mixture.but(base=SCENARIOS["paper"], density=None, others=()).channels != CHANNELS
    )
    with pytest.raises(SettingsError, match="density: no base scatters obstacles"):
        Mixture(density=(0.0, 0.1))
    with pytest.raises(SettingsError, match="the smaller number comes first"):
        mixture.but(density=(0.1, 0.0))
    with pytest.raises(SettingsError, match="n_flocks may be 90, more than there are sheep"):
        Mixture(base=SCENARIOS["paper"].but(n_sheep=100), others=(SMALL,), n_flocks=(1, 90))
