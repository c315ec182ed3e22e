"""Ways round obstacles: hand-worked turns, shortest ways against a naive search, and walks that keep clear."""

from itertools import pairwise

import numpy as np
import pymunk
import pytest
from scipy.sparse.csgraph import dijkstra

from shepherd_phys.controllers.routes import Routes
from shepherd_phys.geometry import surfaces
from shepherd_phys.obstacles import Pillar, Polygon, Wall

CLEARANCE = 0.5


def routes(*obstacles, clearance=CLEARANCE):
    return Routes(surfaces(obstacles), clearance)


def way(plan, start, target):
    """All turns of the way, ends included."""
    places = [np.asarray(start, float)]
    while len(places) < 100:
        ahead = plan.towards(places[-1][None], np.array([target], float))[0]
        if np.array_equal(ahead, places[-1]):
            return np.array(places)
        places.append(ahead)
    raise AssertionError("it never arrives")


def length(places):
    return np.hypot(*np.diff(places, axis=0).T).sum()


def test_a_clear_way_is_straight():
    plan = routes(Pillar((0.0, 0.0), 1.0))
    targets = np.array([[5.0, 2.0], [-5.0, 3.0]])
    assert plan.towards(np.array([[-5.0, 2.0], [-5.0, 0.0]]), targets).tolist() == targets.tolist()
    assert routes().towards(np.array([[-5.0, 2.0]]), targets[:1]).tolist() == targets[:1].tolist()


def test_round_a_pillar_the_way_is_hardly_longer_than_a_taut_string():
    """Two tangents of length sqrt(25 - 2.25) to the circle of radius 1.5, and the arc between."""
    places = way(routes(Pillar((0.0, 0.0), 1.0)), [-5, 0], [5, 0])
    taut = 2 * np.sqrt(25 - 2.25) + 1.5 * (np.pi - 2 * np.arccos(1.5 / 5))
    assert taut <= length(places) < 1.02 * taut


def test_round_the_nearer_end_of_a_wall():
    places = way(routes(Wall((-5.0, 0.0), (2.0, 0.0), 0.2)), [0, -3], [0, 3])
    assert len(places) > 2
    assert (places[1:-1, 0] >= 2.0).all()


def test_a_target_inside_an_obstacle_is_the_nearest_place_clear_of_it():
    square = Polygon(((-2, -2), (2, -2), (2, 2), (-2, 2)))
    place = routes(square).towards(np.array([[5.0, 0.0]]), np.array([[1.5, 0.2]]))
    assert place == pytest.approx(np.array([[2.5, 0.2]]), abs=1e-5)
    beside = routes(square).towards(np.array([[5.0, 0.0]]), np.array([[2.1, 0.2]]))
    assert beside == pytest.approx(np.array([[2.5, 0.2]]), abs=1e-5)
    pillar = routes(Pillar((3.0, 0.0), 1.0)).towards(np.array([[3.0, 5.0]]), np.array([[3.0, 0.0]]))
    assert pillar == pytest.approx(np.array([[3.0, 1.5]]), abs=1e-5)
    wall = routes(Wall((0.0, 0.0), (4.0, 0.0), 0.2)).towards(np.array([[2.0, -5.0]]), np.array([[2.0, 0.0]]))
    assert wall == pytest.approx(np.array([[2.0, -0.6]]), abs=1e-5)


def test_who_starts_within_the_clearance_or_inside_walks_out():
    plan = routes(Pillar((0.0, 0.0), 1.0))
    target = np.array([[5.0, 0.0]])
    assert plan.towards(np.array([[1.2, 0.0]]), target).tolist() == target.tolist()
    assert plan.towards(np.array([[0.1, 0.0]]), target).tolist() == target.tolist()
    behind = plan.towards(np.array([[-1.2, 0.0]]), target)
    assert behind.tolist() != target.tolist()


def test_where_there_is_no_way_the_target_stays():
    corners = [(-2.0, -2.0), (2.0, -2.0), (2.0, 2.0), (-2.0, 2.0)]
    cage = [Wall(a, b) for a, b in zip(corners, corners[1:] + corners[:1], strict=True)]
    assert routes(*cage).towards(np.array([[5.0, 0.0]]), np.array([[0.0, 0.0]])).tolist() == [[0.0, 0.0]]


def test_lengths_are_those_of_the_ways_walked():
    plan, ends = routes(Wall((-5.0, 0.0), (2.0, 0.0), 0.2)), ([0.0, -3.0], [0.0, 3.0])
    starts, targets = np.array([ends[0], ends[0], ends[0]]), np.array([ends[1], ends[0], [4.0, 0.0]])
    assert plan.lengths(starts, targets) == pytest.approx([length(way(plan, *ends)), 0.0, 5.0])


def test_straight_ways_to_places_that_are_clear():
    plan = routes(Pillar((0.0, 0.0), 1.0))
    pos = np.array([[-5.0, 0.0]] * 4)
    places = np.array([[5.0, 0.0], [-2.0, 0.0], [-1.2, 0.0], [5.0, 4.0]])  # behind, before, too near, past it
    assert plan.are_clear(pos, places).tolist() == [False, True, False, True]


def test_ways_outside_a_disc_are_those_round_a_pillar_in_its_place():
    """The walker's centre keeps out of the disc: clearance and all."""
    wall = Wall((0.0, 2.0), (0.0, 9.0))
    plan, ends = routes(wall).outside(np.array([[0.0, 0.0, 3.0]])), ([-8.0, 0.5], [8.0, 0.5])
    assert way(plan, *ends) == pytest.approx(way(routes(wall, Pillar((0.0, 0.0), 2.5)), *ends))
    assert way(plan, [1.0, 0.0], [8.0, 0.0]).tolist() == [[1.0, 0.0], [8.0, 0.0]]  # out of it
    assert plan.are_clear(np.array([[-8.0, 0.0]]), np.array([[-2.0, 0.0]])).tolist() == [False]
    assert routes(wall).outside(np.empty((0, 3))).towards(*np.array([[[-8.0, 5.0]], [[8.0, 5.0]]])).shape == (1, 2)


class Crescent:
    """An obstacle of a user's own, with a shape that is not pymunk's own."""

    class Own(pymunk.Circle):
        pass

    def shapes(self, body):
        return [self.Own(body, 1.0, (0.0, 0.0))]


def test_a_shape_of_a_users_own_counts_as_its_box():
    places = way(routes(Crescent()), [-5, 0], [5, 0])
    assert len(places) > 2
    assert np.abs(places[1:-1]).max(axis=1).min() >= 1.5 - 1e-6


def scene(rng):
    """Pillars, walls and triangles, overlapping as they come."""
    obstacles = []
    for _ in range(rng.integers(1, 9)):
        x, y = rng.uniform(-8, 8, 2)
        kind = rng.integers(3)
        if kind == 0:
            obstacles.append(Pillar((x, y), rng.uniform(0.2, 1.5)))
        elif kind == 1:
            dx, dy = rng.uniform(-6, 6, 2)
            obstacles.append(Wall((x, y), (x + dx, y + dy), rng.uniform(0.1, 0.5)))
        else:
            turn, size = rng.uniform(0, 2 * np.pi), rng.uniform(0.5, 2)
            bearings = turn + np.array([0.0, 2.0, 4.2])
            obstacles.append(Polygon(tuple(zip(x + size * np.cos(bearings), y + size * np.sin(bearings), strict=True))))
    return obstacles


def least_distance(geometry, a, b, n=400):
    t = np.linspace(0, 1, n)[:, None]
    distance, _ = geometry.static_distances((1 - t) * a + t * b)
    return distance.min(axis=0)


@pytest.mark.parametrize("seed", range(12))
def test_the_shortest_of_all_ways_and_clear_all_along(seed):
    rng = np.random.default_rng(seed)
    geometry = surfaces(tuple(scene(rng)))
    plan = Routes(geometry, CLEARANCE)
    ends = [p for p in rng.uniform(-12, 12, (40, 2)) if geometry.static_distances(p[None])[0].min() > CLEARANCE][:2]
    # the naive search: all ways between all nodes, looked at in small steps
    places = np.array([*ends, *plan._nodes])
    graph = np.zeros((len(places), len(places)))
    for i in range(len(places)):
        for j in range(i):
            if least_distance(geometry, places[i], places[j]).min() > CLEARANCE - 1e-6:
                graph[i, j] = graph[j, i] = np.hypot(*(places[i] - places[j]))
    shortest = dijkstra(graph, indices=0)[1]
    if np.isinf(shortest):
        assert plan.towards(ends[0][None], ends[1][None])[0].tolist() == ends[1].tolist()
        return
    found = way(plan, *ends)
    assert length(found) == pytest.approx(shortest, abs=1e-3)
    for a, b in pairwise(found):
        assert least_distance(geometry, a, b).min() > CLEARANCE - 1e-6
