import math

import numpy as np
import pymunk
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from shepherd_phys.geometry import DISC, OBSTACLES, POLYGON, SEGMENT, SHEEP, SHEPHERDS, compile_shapes

coordinate = st.floats(-5.0, 5.0, allow_subnormal=False)
point = st.tuples(coordinate, coordinate)
radius = st.floats(0.0, 2.0, allow_subnormal=False)


@st.composite
def shapes(draw, body):
    kind = draw(st.sampled_from(("circle", "segment", "polygon")))
    if kind == "circle":
        return pymunk.Circle(body, draw(radius) + 0.01, draw(point))
    if kind == "segment":
        a, b = draw(point), draw(point)
        return pymunk.Segment(body, a, (b[0] + 11.0, b[1]), draw(radius))
    x, y = draw(point)
    n, turn, size = draw(st.integers(3, 7)), draw(st.floats(0.0, 6.0)), draw(st.floats(0.1, 3.0))
    corners = [(x + size * math.cos(turn + 6.28 * i / n), y + size * math.sin(turn + 6.28 * i / n)) for i in range(n)]
    return pymunk.Poly(body, corners, radius=draw(radius))


@settings(deadline=None)  # numba compiles on the first call
@given(st.data(), point)
def test_distances_are_those_of_pymunk(data, where):
    body = pymunk.Space().static_body
    shape = data.draw(shapes(body))
    shape.cache_bb()
    expected = shape.point_query(where)
    distance, away = compile_shapes([(shape, -1, OBSTACLES)]).static_distances(np.array([where]))
    assert distance[0, 0] == pytest.approx(expected.distance, abs=1e-12)
    assert away[0, 0] == pytest.approx(tuple(expected.gradient), abs=1e-9)


def test_hand_worked_distances():
    body = pymunk.Space().static_body
    found = compile_shapes(
        [
            (pymunk.Circle(body, 1.0, (3.0, 0.0)), -1, OBSTACLES),
            (pymunk.Segment(body, (-1.0, 2.0), (1.0, 2.0), 0.5), -1, OBSTACLES),
            (pymunk.Poly(body, [(-4.0, -1.0), (-2.0, -1.0), (-2.0, 1.0), (-4.0, 1.0)], radius=0.25), -1, OBSTACLES),
        ]
    ).static_distances(np.array([[0.0, 0.0], [3.5, 0.0]]))
    assert found[0] == pytest.approx(np.array([[2.0, 1.5, 1.75], [-0.5, math.hypot(2.5, 2.0) - 0.5, 5.25]]))
    assert found[1][0] == pytest.approx(np.array([[-1.0, 0.0], [0.0, -1.0], [1.0, 0.0]]))
    assert found[1][1, 0] == pytest.approx((1.0, 0.0))  # out of the disc, not towards its centre


def test_inside_a_polygon_away_is_the_shortest_way_out():
    body = pymunk.Space().static_body
    box = pymunk.Poly(body, [(0.0, 0.0), (4.0, 0.0), (4.0, 4.0), (0.0, 4.0)])
    distance, away = compile_shapes([(box, -1, OBSTACLES)]).static_distances(np.array([[3.0, 2.0]]))
    assert distance[0, 0] == pytest.approx(-1.0)
    assert away[0, 0] == pytest.approx((1.0, 0.0))


def test_only_what_stands_still_is_measured():
    space = pymunk.Space()
    body = pymunk.Body(1.0, 1.0)
    geometry = compile_shapes(
        [(pymunk.Circle(body, 1.0), 0, SHEEP), (pymunk.Circle(space.static_body, 1.0, (3.0, 0.0)), -1, OBSTACLES)]
    )
    distance, away = geometry.static_distances(np.zeros((2, 2)))
    assert distance.shape == (2, 1)
    assert away.shape == (2, 1, 2)
    assert distance[0, 0] == pytest.approx(2.0)


def test_the_table_tells_kind_body_channel_and_corners():
    body = pymunk.Body(1.0, 1.0)
    geometry = compile_shapes(
        [
            (pymunk.Circle(body, 0.5, (1.0, 2.0)), 4, SHEEP),
            (pymunk.Segment(body, (0.0, 0.0), (2.0, 0.0), 0.1), 5, SHEPHERDS),
            (pymunk.Poly.create_box(body, (2.0, 2.0)), 6, SHEPHERDS),
        ]
    )
    assert geometry.known
    assert not geometry.has_obstacles
    assert geometry.shapes.table.tolist() == [
        [DISC, 4, SHEEP, 0, 1],
        [SEGMENT, 5, SHEPHERDS, 1, 2],
        [POLYGON, 6, SHEPHERDS, 3, 4],
    ]
    assert geometry.shapes.radius.tolist() == [0.5, 0.1, 0.0]
    assert geometry.shapes.corners[0].tolist() == [1.0, 2.0, 0.0, 0.0]
    normals = geometry.shapes.corners[3:, 2:]
    assert np.hypot(*normals.T) == pytest.approx(1.0)
    assert not geometry.shapes.corners.flags.writeable


def test_a_static_body_that_was_moved_is_compiled_where_it_stands():
    space = pymunk.Space()
    body = pymunk.Body(body_type=pymunk.Body.STATIC)
    body.position, body.angle = (1.0, 2.0), 0.5
    shape = pymunk.Poly(body, [(1.0, 0.0), (3.0, 0.0), (2.0, 2.0)], radius=0.1)
    space.add(body, shape)
    where = (0.3, -0.7)
    distance, _ = compile_shapes([(shape, -1, OBSTACLES)]).static_distances(np.array([where]))
    assert distance[0, 0] == pytest.approx(shape.point_query(where).distance, abs=1e-12)


def test_a_shape_of_somebodys_own_class_is_not_known_and_still_measured():
    class Bush(pymunk.Circle):
        pass

    space = pymunk.Space()
    bush = Bush(space.static_body, 1.0, (0.0, 3.0))
    space.add(bush)
    wall = pymunk.Segment(space.static_body, (-1.0, -1.0), (1.0, -1.0), 0.0)
    geometry = compile_shapes([(bush, -1, OBSTACLES), (wall, -1, OBSTACLES)])
    assert not geometry.known
    assert geometry.has_obstacles
    distance, away = geometry.static_distances(np.zeros((1, 2)))
    assert distance == pytest.approx(np.array([[1.0, 2.0]]))
    assert away[0] == pytest.approx(np.array([[0.0, 1.0], [0.0, -1.0]]))


def test_nothing_compiles_to_nothing():
    distance, away = compile_shapes([]).static_distances(np.zeros((3, 2)))
    assert distance.shape == (3, 0)
    assert away.shape == (3, 0, 2)
