"""The flock's rule: each term by hand, the whole against plain Python, and what must not matter."""

import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from shepherd_phys.avoidance import NO_PUSH
from shepherd_phys.flock import FLOCKS, FlockModel, Reynolds, Strombom, boids, desired
from shepherd_phys.settings import SettingsError
from shepherd_phys.state import WorldState

QUIET = Strombom(inertia=0, attraction=0, repulsion=0, flight=0, noise=0)
"""No term at all; each test switches on what it looks at."""


class Draws:
    """Stands for a generator, with draws that the test chooses."""

    def __init__(self, draws):
        self.draws = np.asarray(draws, dtype=float)

    def random(self, shape):
        assert shape == self.draws.shape
        return self.draws


def world(sheep, shepherds=((0.0, 0.0),), heading=None, speed=None):
    sheep = np.array(sheep, dtype=float).reshape(-1, 2)
    shepherds = np.array(shepherds, dtype=float).reshape(-1, 2)
    n, p = len(sheep), len(shepherds)
    return WorldState(
        step=0, time=0.0, goal_pos=np.zeros(2), goal_radius=2.5, sheep_pos=sheep, sheep_vel=np.zeros((n, 2)),
        sheep_heading=np.tile([0.0, 1.0], (n, 1)) if heading is None else np.array(heading, dtype=float),
        sheep_goal_distance=np.zeros(n), sheep_in_goal=np.zeros(n, bool), sheep_arrived=np.zeros(n, bool),
        sheep_radius=np.full(n, 0.15), sheep_max_speed=np.ones(n) if speed is None else np.array(speed, dtype=float),
        shepherd_pos=shepherds, shepherd_vel=np.zeros((p, 2)), shepherd_angle=np.zeros(p),
        shepherd_radius=np.full(p, 0.25), shepherd_max_speed=np.full(p, 1.5), shepherd_path=np.zeros(p),
        collisions=0, obstacles=(),
    )  # fmt: skip


def velocities(model, state, angle=0.0, graze=1.0):
    return model.velocities(state, Draws(np.tile([graze, angle / (2 * math.pi)], (state.n_sheep, 1))))


def scene(seed, n_sheep=40, n_shepherds=3, spread=2.0):
    rng = np.random.default_rng(seed)
    angle = rng.uniform(0, 2 * np.pi, n_sheep)
    return world(
        rng.normal(0, spread, (n_sheep, 2)), rng.uniform(-10, 10, (n_shepherds, 2)),
        np.column_stack([np.cos(angle), np.sin(angle)]), rng.uniform(0.5, 1.5, n_sheep),
    )  # fmt: skip


def unit(x, y):
    length = math.hypot(x, y)
    return (x / length, y / length) if length > 0 else (0.0, 0.0)


def naive(m, state, draws):
    """The rule as `Strombom` states it, one sheep after the other."""
    sheep, result = state.sheep_pos.tolist(), []
    for i, (x, y) in enumerate(sheep):
        speed, (u, v) = state.sheep_max_speed[i], state.sheep_heading[i]
        ex, ey = math.cos(2 * math.pi * draws[i][1]), math.sin(2 * math.pi * draws[i][1])
        near = [
            (x - a, y - b) for a, b in state.shepherd_pos.tolist() if math.hypot(x - a, y - b) <= m.detection_radius
        ]
        if not near:
            moves = draws[i][0] < m.graze_probability
            result.append((speed * ex, speed * ey) if moves else (0.0, 0.0))
            continue
        others = sorted(((x - a) ** 2 + (y - b) ** 2, j) for j, (a, b) in enumerate(sheep) if j != i)
        nearest = [sheep[j] for _, j in others[: m.n_neighbours]]
        k = max(len(nearest), 1)
        cx, cy = unit(sum(a - x for a, _ in nearest) / k, sum(b - y for _, b in nearest) / k)
        units = [unit(x - sheep[j][0], y - sheep[j][1]) for d2, j in others if math.sqrt(d2) < m.sheep_distance]
        ax, ay = unit(sum(a for a, _ in units), sum(b for _, b in units))
        flights = [unit(a, b) for a, b in near]
        sx, sy = unit(sum(a for a, _ in flights), sum(b for _, b in flights))
        hx = m.inertia * u + m.attraction * cx + m.repulsion * ax + m.flight * sx + m.noise * ex
        hy = m.inertia * v + m.attraction * cy + m.repulsion * ay + m.flight * sy + m.noise * ey
        wx, wy = unit(hx, hy) if (hx, hy) != (0, 0) else (u, v)
        result.append((speed * wx, speed * wy))
    return np.array(result).reshape(-1, 2)


def both(model, state, draws):
    """Velocities by brute force and by the grid."""
    return [
        desired(
            state.sheep_pos, state.sheep_heading, state.sheep_max_speed, state.shepherd_pos, draws, model.inertia,
            model.attraction, model.repulsion, model.flight, model.noise, model.detection_radius,
            model.sheep_distance, model.n_neighbours, model.graze_probability, use_grid, NO_PUSH,
        )
        for use_grid in (False, True)
    ]  # fmt: skip


# Each term alone, by hand


def test_inertia_keeps_the_heading():
    state = world([[3, 0]], heading=[[0.6, 0.8]], speed=[2.0])
    np.testing.assert_allclose(velocities(QUIET.but(inertia=0.5), state), [[1.2, 1.6]])


def test_attraction_points_to_the_mean_of_the_nearest():
    # the two nearest of sheep 0 are at (2, 0) and (0, 2) from it: mean (1, 1); the third is further
    state = world([[1, 1], [3, 1], [1, 3], [-8, 1]], shepherds=[[0, 0]])
    v = velocities(QUIET.but(attraction=1.05, n_neighbours=2), state)
    np.testing.assert_allclose(v[0], [math.sqrt(0.5), math.sqrt(0.5)])


def test_of_equally_near_sheep_those_with_lower_indices_count():
    state = world([[1, 0], [1, 2], [3, 0], [-1, 0]])
    v = velocities(QUIET.but(attraction=1, n_neighbours=1), state)
    np.testing.assert_allclose(v[0], [0, 1])


def test_repulsion_adds_units_over_sheep_nearer_than_r_a():
    # nearer than 1: at (0.5, 0) and (0, 0.25), units away (-1, 0) and (0, -1); at exactly 1 does not count
    state = world([[5, 5], [5.5, 5], [5, 5.25], [4, 5]])
    v = velocities(QUIET.but(repulsion=2, sheep_distance=1.0), state)
    np.testing.assert_allclose(v[0], [-math.sqrt(0.5), -math.sqrt(0.5)])


def test_flight_adds_units_over_shepherds_within_r_s():
    # at distances 10 (counts) and 3, units away (1, 0) and (0, 1); the third is out of sight
    state = world([[10, 3]], shepherds=[[0, 3], [10, 0], [20.5, 3]])
    np.testing.assert_allclose(velocities(QUIET.but(flight=1), state), [[math.sqrt(0.5), math.sqrt(0.5)]])


def test_noise_points_where_the_second_draw_says():
    np.testing.assert_allclose(
        velocities(QUIET.but(noise=0.3), world([[1, 1]]), angle=2.0), [[math.cos(2), math.sin(2)]]
    )


def test_all_terms_together():
    # H = (0, 1), C = (1, 0), R_a = (-1, 0), R_s = (1, 0), eps = (0, -1)
    state = world([[4, 0], [4.2, 0]], shepherds=[[0, 0]])
    v = velocities(Strombom(), state, angle=1.5 * math.pi)
    h = np.array([1.05 - 2 + 1, 0.5 - 0.3])
    np.testing.assert_allclose(v[0], h / np.hypot(*h), rtol=1e-12)


# Corners


def test_without_any_term_the_heading_stays():
    state = world([[1, 1]], heading=[[0.6, -0.8]])
    np.testing.assert_allclose(velocities(QUIET, state), [[0.6, -0.8]])


def test_coincident_bodies_have_no_direction():
    state = world([[0, 0], [0, 0], [0, 0]], shepherds=[[0, 0]], heading=[[1, 0], [0, 1], [0, -1]])
    np.testing.assert_allclose(velocities(Strombom(noise=0), state), [[1, 0], [0, 1], [0, -1]])


def test_a_sheep_at_r_s_is_threatened_and_one_beyond_grazes():
    v = velocities(QUIET.but(flight=1), world([[10.0, 0], [10.001, 0]]))
    np.testing.assert_allclose(v, [[1, 0], [0, 0]])


@pytest.mark.parametrize("n_sheep", [0, 1, 2, 3])
@pytest.mark.parametrize("n_shepherds", [0, 1, 2, 6])
def test_few_sheep_any_shepherds(n_sheep, n_shepherds):
    state = scene(11, n_sheep, n_shepherds)
    draws = np.random.default_rng(12).random((n_sheep, 2))
    for v in both(Strombom(), state, draws):
        np.testing.assert_allclose(v, naive(Strombom(), state, draws), atol=1e-12)


def test_more_neighbours_than_sheep_are_all_sheep():
    state = scene(13, 20)
    draws = np.random.default_rng(14).random((20, 2))
    for a, b in zip(
        both(Strombom(n_neighbours=19), state, draws), both(Strombom(n_neighbours=900), state, draws), strict=True
    ):
        np.testing.assert_array_equal(a, b)


# Grazing


def test_grazing_sheep_stand_or_step_with_probability_p():
    state = world(np.zeros((4000, 2)), shepherds=[[11, 0]], speed=np.full(4000, 0.7))
    v = Strombom().velocities(state, np.random.default_rng(15))
    moving = v.any(axis=1)
    assert abs(moving.mean() - 0.05) < 4 * math.sqrt(0.05 * 0.95 / 4000)
    np.testing.assert_allclose(np.hypot(*v[moving].T), 0.7)
    assert np.hypot(*v[moving].mean(axis=0)) < 0.7 * 3 / math.sqrt(moving.sum())


@pytest.mark.parametrize(("p", "moving"), [(0.0, 0), (1.0, 50)])
def test_never_and_always(p, moving):
    v = Strombom(graze_probability=p).velocities(scene(16, 50, 0), np.random.default_rng(17))
    assert v.any(axis=1).sum() == moving


def test_every_step_takes_the_same_draws():
    for state in (scene(18, 30, 0), scene(18, 30, 3)):
        used, expected = np.random.default_rng(19), np.random.default_rng(19)
        Strombom().velocities(state, used)
        expected.random((30, 2))
        assert used.random() == expected.random()


# The whole rule


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 10**6), n_sheep=st.integers(1, 70), n_shepherds=st.integers(0, 6), n=st.integers(1, 80),
    spread=st.floats(0.2, 12), r_a=st.floats(0, 5),
)  # fmt: skip
def test_the_kernel_is_the_rule(seed, n_sheep, n_shepherds, n, spread, r_a):
    state = scene(seed, n_sheep, n_shepherds, spread)
    model = Strombom(n_neighbours=n, sheep_distance=r_a)
    draws = np.random.default_rng(seed).random((n_sheep, 2))
    expected = naive(model, state, draws)
    for v in both(model, state, draws):
        np.testing.assert_allclose(v, expected, atol=1e-12, rtol=0)
    np.testing.assert_allclose(model.velocities(state, Draws(draws)), expected, atol=1e-12, rtol=0)


@pytest.mark.parametrize("size", [300, 2000])
@pytest.mark.parametrize("kind", ["gauss", "lattice", "coincident", "flocks", "strays"])
def test_the_grid_is_brute_force(kind, size):
    rng = np.random.default_rng(20)
    sheep = {
        "gauss": rng.standard_normal((size, 2)) * math.sqrt(size / 100),
        "lattice": rng.permutation(np.stack(np.divmod(np.arange(size), 40), -1)) * 0.25,
        "coincident": np.full((size, 2), 0.3),
        "flocks": rng.standard_normal((size, 2)) + rng.integers(0, 3, (size, 1)) * 25.0,
        "strays": rng.standard_normal((size, 2)) * rng.choice([1.0, 1e3], (size, 1), p=[0.98, 0.02]),
    }[kind]
    state = world(sheep, [[-3, 2], [40, 40]])
    brute, grid = both(Strombom(detection_radius=1e5), state, rng.random((size, 2)))
    np.testing.assert_allclose(grid, brute, atol=1e-12, rtol=0)


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 10**6), turn=st.floats(-4, 4), dx=st.floats(-100, 100), dy=st.floats(-100, 100))
def test_the_rule_moves_and_turns_with_the_world(seed, turn, dx, dy):
    state = scene(seed)
    draws = np.random.default_rng(seed).random((40, 2))
    c, s = math.cos(turn), math.sin(turn)
    rotation = np.array([[c, -s], [s, c]])
    moved = state.but(
        sheep_pos=state.sheep_pos @ rotation.T + [dx, dy], shepherd_pos=state.shepherd_pos @ rotation.T + [dx, dy],
        sheep_heading=state.sheep_heading @ rotation.T,
    )  # fmt: skip
    turned = np.column_stack([draws[:, 0], (draws[:, 1] + turn / (2 * math.pi)) % 1.0])
    model = Strombom(n_neighbours=10)
    expected = model.velocities(state, Draws(draws)) @ rotation.T
    np.testing.assert_allclose(model.velocities(moved, Draws(turned)), expected, atol=1e-10)


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 10**6))
def test_the_order_of_the_sheep_does_not_matter(seed):
    state, rng = scene(seed, 60), np.random.default_rng(seed)
    draws, order = rng.random((60, 2)), rng.permutation(60)
    shuffled = state.but(
        sheep_pos=state.sheep_pos[order], sheep_heading=state.sheep_heading[order],
        sheep_max_speed=state.sheep_max_speed[order],
    )  # fmt: skip
    model = Strombom(n_neighbours=25)
    expected = model.velocities(state, Draws(draws))[order]
    np.testing.assert_allclose(model.velocities(shuffled, Draws(draws[order])), expected, atol=1e-12)


def test_the_same_seed_gives_the_same_bits():
    for size in (100, 1200):
        state = scene(21, size)
        first, again = (Strombom().velocities(state, np.random.default_rng(22)) for _ in range(2))
        np.testing.assert_array_equal(first, again)


def test_speeds_are_the_sheeps_own_and_read_only_states_are_accepted():
    state = scene(23, 80).but(sheep_max_speed=np.linspace(0.1, 2, 80))
    assert not state.sheep_max_speed.flags.writeable
    v = Strombom(detection_radius=100).velocities(state, np.random.default_rng(24))
    np.testing.assert_allclose(np.hypot(*v.T), state.sheep_max_speed)


# Reynolds


SILENT = Reynolds(inertia=0, cohesion=0, alignment=0, separation=0, flight=0)


def naive_boids(m, state, draws, pushed=None):
    """The rule as `Reynolds` states it, one sheep after the other."""
    sheep, moving, result = state.sheep_pos.tolist(), state.sheep_vel.tolist(), []
    for i, (x, y) in enumerate(sheep):
        speed, (u, v) = state.sheep_max_speed[i], moving[i]
        flights = [
            unit(x - a, y - b) for a, b in state.shepherd_pos.tolist() if math.hypot(x - a, y - b) <= m.detection_radius
        ]
        if not flights:
            angle, moves = 2 * math.pi * draws[i][1], draws[i][0] < m.graze_probability
            result.append((speed * math.cos(angle), speed * math.sin(angle)) if moves else (0.0, 0.0))
            continue
        others = [(math.hypot(x - a, y - b), j) for j, (a, b) in enumerate(sheep) if j != i]
        near = [j for d, j in others if d <= m.neighbour_radius]
        cohesion = unit(sum(sheep[j][0] - x for j in near), sum(sheep[j][1] - y for j in near))
        alignment = unit(sum(moving[j][0] for j in near), sum(moving[j][1] for j in near))
        apart = [unit(x - sheep[j][0], y - sheep[j][1]) for d, j in others if d < m.sheep_distance]
        terms = [
            (m.inertia / speed, (u, v)), (m.cohesion, cohesion), (m.alignment, alignment),
            (m.separation, unit(sum(a for a, _ in apart), sum(b for _, b in apart))),
            (m.flight, unit(sum(a for a, _ in flights), sum(b for _, b in flights))),
        ]  # fmt: skip
        terms += [(1.0, pushed[i])] if pushed is not None else []
        wx, wy = (sum(weight * term[k] for weight, term in terms) for k in range(2))
        scale = speed / max(1.0, math.hypot(wx, wy))
        result.append((scale * wx, scale * wy))
    return np.array(result).reshape(-1, 2)


def moving_scene(seed, n_sheep=40, n_shepherds=3, spread=2.0):
    state = scene(seed, n_sheep, n_shepherds, spread)
    return state.but(sheep_vel=np.random.default_rng(seed + 1).normal(0, 0.7, (n_sheep, 2)))


def test_each_urge_of_a_boid_by_hand():
    # neighbours of sheep 0 at (1, 1): those at (4, 1) and (1, 5), not the one at (7, 1); two of them move
    state = world([[1, 1], [4, 1], [1, 5], [7, 1]]).but(sheep_vel=[[0.3, 0.4], [0, 1], [1, 0], [-1, -1]])
    assert velocities(SILENT.but(inertia=0.5), state)[0] == pytest.approx([0.15, 0.2])
    assert velocities(SILENT.but(cohesion=0.5), state)[0] == pytest.approx([0.3, 0.4])
    assert velocities(SILENT.but(alignment=0.5), state)[0] == pytest.approx([0.5 / math.sqrt(2)] * 2)
    assert velocities(SILENT.but(flight=0.5), state)[0] == pytest.approx([0.5 / math.sqrt(2)] * 2)
    close = world([[5, 5], [5.3, 5], [5, 4.75], [5, 5.4]])  # the last one, at 0.4 m, is not below it
    assert velocities(SILENT.but(separation=0.5), close)[0] == pytest.approx([-0.5 / math.sqrt(2), 0.5 / math.sqrt(2)])


def test_a_boid_that_wants_more_than_its_top_speed_has_that():
    state = world([[3, 0], [4, 0]], speed=[0.6, 1.0])
    assert velocities(Reynolds(), state)[0] == pytest.approx([0.6, 0.0])


def test_a_boid_alone_flees_and_one_out_of_sight_grazes():
    state = world([[0, 9], [0, 10.001]])
    assert velocities(Reynolds(neighbour_radius=0.5), state)[0] == pytest.approx([0, 1])
    assert velocities(Reynolds(), state)[1].tolist() == [0, 0]
    assert velocities(Reynolds(), state, angle=1.0, graze=0.04)[1] == pytest.approx([math.cos(1), math.sin(1)])


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 10**6), n_sheep=st.integers(0, 70), n_shepherds=st.integers(0, 6), r=st.floats(0, 8),
    spread=st.floats(0.2, 12), r_a=st.floats(0, 5),
)  # fmt: skip
def test_the_boids_kernel_is_the_rule(seed, n_sheep, n_shepherds, r, spread, r_a):
    state = moving_scene(seed, n_sheep, n_shepherds, spread)
    draws = np.random.default_rng(seed).random((n_sheep, 2))
    model = Reynolds(neighbour_radius=r, sheep_distance=r_a)
    expected = naive_boids(model, state, draws)
    np.testing.assert_allclose(model.velocities(state, Draws(draws)), expected, atol=1e-12, rtol=0)
    pushed = np.random.default_rng(seed).normal(0, 1, (n_sheep, 2))
    for use_grid, push in itertools.product((False, True), (NO_PUSH, pushed)):
        v = boids(
            state.sheep_pos, state.sheep_vel, state.sheep_max_speed, state.shepherd_pos, draws, 0.5, 1.0, 1.0, 1.5, 2.0,
            r, r_a, 10.0, 0.05, use_grid, push,
        )  # fmt: skip
        of_rule = naive_boids(model, state, draws, push) if len(push) else expected
        np.testing.assert_allclose(v, of_rule, atol=1e-12, rtol=0)


def test_many_boids_over_cells_are_the_rule():
    rng = np.random.default_rng(5)
    sheep = np.concatenate([rng.normal(0, 6, (380, 2)), rng.normal(0, 200, (20, 2))])
    state = world(sheep, [[-3, 2], [40, 40]]).but(sheep_vel=rng.normal(0, 1, (400, 2)))
    model, draws = Reynolds(detection_radius=1e5), rng.random((400, 2))
    v = model.velocities(state, Draws(draws))
    np.testing.assert_allclose(v, naive_boids(model, state, draws), atol=1e-11, rtol=0)


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 10**6), turn=st.floats(-4, 4), dx=st.floats(-100, 100), dy=st.floats(-100, 100))
def test_boids_move_turn_and_change_places_with_the_world(seed, turn, dx, dy):
    state, rng = moving_scene(seed), np.random.default_rng(seed)
    draws, order = rng.random((40, 2)), rng.permutation(40)
    c, s = math.cos(turn), math.sin(turn)
    rotation = np.array([[c, -s], [s, c]])
    moved = state.but(
        sheep_pos=(state.sheep_pos @ rotation.T + [dx, dy])[order],
        shepherd_pos=state.shepherd_pos @ rotation.T + [dx, dy],
        sheep_vel=(state.sheep_vel @ rotation.T)[order], sheep_max_speed=state.sheep_max_speed[order],
    )  # fmt: skip
    turned = np.column_stack([draws[:, 0], (draws[:, 1] + turn / (2 * math.pi)) % 1.0])[order]
    model = Reynolds(neighbour_radius=3.0)
    expected = (model.velocities(state, Draws(draws)) @ rotation.T)[order]
    np.testing.assert_allclose(model.velocities(moved, Draws(turned)), expected, atol=1e-9)


def test_boids_draw_what_strombom_draws():
    for state in (moving_scene(18, 30, 0), moving_scene(18, 30, 3)):
        used, expected = np.random.default_rng(19), np.random.default_rng(19)
        Reynolds().velocities(state, used)
        expected.random((30, 2))
        assert used.random() == expected.random()


def test_boids_by_name():
    assert isinstance(Reynolds(), FlockModel)
    assert FLOCKS["Reynolds"] is Reynolds
    m = Reynolds()
    assert (m.inertia, m.cohesion, m.alignment, m.separation, m.flight) == (0.5, 1.0, 1.0, 1.5, 2.0)
    assert (m.neighbour_radius, m.sheep_distance, m.detection_radius, m.graze_probability) == (5.0, 0.4, 10.0, 0.05)
    with pytest.raises(SettingsError, match=r"Reynolds.n_neighbours: there is no such field"):
        Reynolds(n_neighbours=40)


# Settings


def test_defaults_and_limits():
    assert isinstance(Strombom(), FlockModel)
    assert FLOCKS["Strombom"] is Strombom
    m = Strombom()
    assert (m.inertia, m.attraction, m.repulsion, m.flight, m.noise) == (0.5, 1.05, 2.0, 1.0, 0.3)
    assert (m.detection_radius, m.sheep_distance, m.n_neighbours, m.graze_probability) == (10.0, 0.4, 40, 0.05)
    for bad in ({"n_neighbours": 0}, {"graze_probability": 1.1}, {"noise": -1}, {"cohesion": 3}):
        with pytest.raises(SettingsError, match=f"Strombom.{next(iter(bad))}"):
            Strombom(**bad)
