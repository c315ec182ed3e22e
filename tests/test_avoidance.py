"""How sheep feel obstacles: worked by hand, the same for shapes that kernels do not know, and in the flock's rule."""

import math

import numpy as np
import pymunk
import pytest
from scenes import arranged

from shepherd_phys.avoidance import NO_PUSH, Avoidance
from shepherd_phys.flock import Strombom
from shepherd_phys.obstacles import Box, Fence, Pillar, Polygon, Wall
from shepherd_phys.scenario import SCENARIOS, Scenario
from shepherd_phys.settings import SettingsError
from shepherd_phys.world import World

MANY = (
    Pillar((0.0, 0.0), 1.0),
    Wall((-6.0, 4.0), (3.0, 5.0)),
    Box((5.0, -2.0), (2.0, 1.0), 0.4),
    Polygon(((-6.0, -6.0), (-3.0, -6.0), (-5.0, -3.0))),
    Fence((4.0, 2.0), (4.0, 9.0), gap=1.5),
)


def test_the_push_of_one_surface_falls_off_as_written():
    state = arranged([[3.0, 0.0], [2.0, 0.0], [0.0, 3.01], [0.0, -1.5]], [[50.0, 50.0]])
    pushed = Avoidance().pushes(state.but(obstacles=(Pillar((0.0, 0.0), 1.0),)))
    assert pushed[1] == pytest.approx([1.5 * math.exp(-2 * 1.0 / 2.0), 0.0])
    assert pushed[3] == pytest.approx([0.0, -1.5 * math.exp(-2 * 0.5 / 2.0)])
    assert pushed[[0, 2]].tolist() == [[0.0, 0.0], [0.0, 0.0]]  # 2 m away, and further


def test_surfaces_add_up_and_those_of_el_fiqi_reach_further():
    state = arranged([[0.0, 0.0]], [[50.0, 50.0]]).but(obstacles=(Pillar((0.0, 2.0), 1.0), Pillar((4.0, 0.0), 1.0)))
    assert Avoidance().pushes(state)[0] == pytest.approx([0.0, -1.5 * math.exp(-1.0)])
    wide = Avoidance(weight=3.0, range=5.0).pushes(state)[0]
    assert wide == pytest.approx([-3.0 * math.exp(-2 * 3.0 / 5.0), -3.0 * math.exp(-2 * 1.0 / 5.0)])


class Own(pymunk.Circle):
    """A shape that kernels do not know."""


class Bush:
    def shapes(self, body):
        return [Own(body, 1.0, (0.0, 0.0))]


def test_shapes_of_a_users_own_push_as_the_librarys_do():
    sheep = np.random.default_rng(0).uniform(-4, 4, (50, 2))
    state = arranged(sheep, [[50.0, 50.0]])
    known = Avoidance(range=3.0).pushes(state.but(obstacles=MANY))
    unknown = Avoidance(range=3.0).pushes(state.but(obstacles=(Bush(), *MANY[1:])))
    assert np.abs(known).max() > 0.1
    assert unknown == pytest.approx(known, abs=1e-12)


@pytest.mark.parametrize("reach", [0.5, 2.0, 5.0])
def test_nothing_is_culled_that_counts(reach):
    sheep = np.random.default_rng(1).uniform(-9, 11, (300, 2))
    state = arranged(sheep, [[50.0, 50.0]]).but(obstacles=MANY)
    distance, away = state.surroundings.static_distances(state.sheep_pos)
    size = np.where(distance < reach, 1.5 * np.exp(-2 * distance / reach), 0.0)
    assert Avoidance(range=reach).pushes(state) == pytest.approx((size[:, :, None] * away).sum(axis=1), abs=1e-12)


def test_in_the_open_there_is_no_push():
    assert Avoidance().pushes(arranged([[0.0, 0.0]], [[5.0, 0.0]])) is NO_PUSH


def test_the_push_is_added_before_the_direction_is_normalised():
    flock = Strombom(inertia=0.0, attraction=0.0, repulsion=0.0, noise=0.0)
    state = arranged([[0.0, 0.0]], [[-5.0, 0.0]]).but(obstacles=(Pillar((0.0, 2.0), 1.0),))
    wish = np.array([1.0, -1.5 * math.exp(-1.0)])
    found = flock.velocities(state, np.random.default_rng(0))
    assert found[0] == pytest.approx(wish / np.hypot(*wish))
    unfelt = flock.but(avoidance=Avoidance(weight=0.0)).velocities(state, np.random.default_rng(0))
    assert unfelt[0] == pytest.approx([1.0, 0.0])
    grazing = state.but(shepherd_pos=[[-50.0, 0.0]])
    assert flock.but(graze_probability=0.0).velocities(grazing, np.random.default_rng(0)).tolist() == [[0.0, 0.0]]


def test_driven_sheep_keep_off_a_wall_that_they_feel():
    gaps = []
    for weight in (0.0, 1.5):
        scenario = Scenario(
            n_sheep=20, n_flocks=1, shepherds=1, obstacles=(Wall((-20, 0), (20, 0)),),
            flock=Strombom(n_neighbours=10, avoidance=Avoidance(weight=weight)),
        )  # fmt: skip
        world = World(scenario)
        start = world.reset(0)
        around = start.sheep_pos - start.sheep_pos.mean(axis=0)
        state = world.reset_to(start.but(sheep_pos=around + (0.0, 6.0), shepherd_pos=[[0.0, 11.0]]), 0)
        for _ in range(60):
            state = world.step([[0.0, -0.6]])
        gaps.append(np.abs(state.sheep_pos[:, 1]).min())
    assert gaps[1] > gaps[0] + 0.05


def test_it_is_a_setting_of_the_flock_that_files_hold(tmp_path):
    scenario = SCENARIOS["fence"].but(flock=Strombom(avoidance=Avoidance(weight=3.0, range=5.0)))
    scenario.to_toml(tmp_path / "a.toml")
    assert Scenario.from_toml(tmp_path / "a.toml") == scenario
    with pytest.raises(SettingsError, match=r"Avoidance.range: .*greater than 0.*given: 0"):
        Avoidance(range=0.0)


def test_the_table_of_an_open_world_is_what_it_was():
    """Results are known by it: episodes of open worlds that were run before there were obstacles stay valid."""
    table = SCENARIOS["paper"].to_dict()
    assert "avoidance" not in table["flock"]
    assert not {"layout", "goal_keep_out", "body_keep_out", "flock_spread"} & set(table)
    felt = SCENARIOS["paper"].but(flock=Strombom(avoidance=Avoidance(weight=3.0)))
    assert Scenario.from_dict(felt.to_dict()) == felt
    assert SCENARIOS["lattice"].to_dict()["flock"]["avoidance"] == Avoidance().to_dict()
