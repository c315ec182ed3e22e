"""Nearest neighbours: one answer by every way, ties included."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from shepherd_phys.cells import CELLS_PER_POINT, build, build_for
from shepherd_phys.neighbours import nearest, surroundings, threshold


def naive(pos, n):
    """Sorted by (distance, index), in plain Python."""
    rows = []
    for i, (x, y) in enumerate(pos.tolist()):
        others = sorted(((x - u) * (x - u) + (y - v) * (y - v), j) for j, (u, v) in enumerate(pos.tolist()) if j != i)
        rows.append(sorted(j for _, j in others[:n]))
    return np.array(rows, dtype=np.int64).reshape(len(pos), -1)


def scene(kind, size, seed):
    rng = np.random.default_rng(seed)
    gauss = rng.standard_normal((size, 2))
    side = int(np.ceil(np.sqrt(size)))
    lattice = np.stack(np.meshgrid(np.arange(side), np.arange(side)), -1).reshape(-1, 2)[:size] * 0.5
    return {
        "gauss": gauss,
        "far": gauss + np.array([3e4, -2e4]),
        "stragglers": np.concatenate([gauss[:-3], [[1e6, 0.0], [0.0, -1e7], [3e3, 3e3]]]),
        "flocks": gauss + rng.integers(0, 4, (size, 1)) * [400.0, 100.0],
        "heavy": rng.standard_cauchy((size, 2)) ** 3,
        "line": np.column_stack([gauss[:, 0], np.full(size, 2.0)]),
        "lattice": rng.permutation(lattice),
        "pairs": np.repeat(gauss, 2, axis=0)[:size],
        "coincident": np.full((size, 2), 0.3),
        "half": np.where(np.arange(size)[:, None] % 2, gauss, 0.0),
        "tiny": gauss * 1e-9,
    }[kind]


KINDS = [
    "gauss", "far", "stragglers", "flocks", "heavy", "line", "lattice", "pairs", "coincident", "half", "tiny"
]  # fmt: skip


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(("size", "n"), [(150, 40), (150, 1), (90, 88), (60, 59), (60, 400)])
def test_both_ways_find_what_sorting_finds(kind, size, n):
    pos = scene(kind, size, 3)
    expected = naive(pos, n)
    np.testing.assert_array_equal(nearest(pos, n, False), expected)
    np.testing.assert_array_equal(nearest(pos, n, True), expected)


@pytest.mark.parametrize("kind", KINDS)
def test_grid_is_brute_force_for_large_flocks(kind):
    pos = scene(kind, 1500, 4)
    np.testing.assert_array_equal(nearest(pos, 40, True), nearest(pos, 40, False))


coordinate = st.one_of(st.integers(-3, 3).map(float), st.floats(-50, 50), st.sampled_from([1e6, -1e6, 0.1, 0.3]))


@settings(max_examples=60, deadline=None)
@given(pos=st.lists(st.tuples(coordinate, coordinate), min_size=1, max_size=60), n=st.integers(1, 60))
def test_any_points(pos, n):
    pos = np.array(pos)
    expected = naive(pos, n)
    np.testing.assert_array_equal(nearest(pos, n, False), expected)
    np.testing.assert_array_equal(nearest(pos, n, True), expected)


@pytest.mark.parametrize("use_grid", [False, True])
@pytest.mark.parametrize("kind", ["gauss", "pairs", "flocks", "heavy"])
def test_sums(kind, use_grid):
    pos = scene(kind, 120, 5)
    wanted = np.arange(120) % 3 > 0
    towards, apart = surroundings(pos, wanted, 20, 0.7, use_grid, np.empty((0, 0), np.int64))
    for i, neighbours in enumerate(naive(pos, 20)):
        if not wanted[i]:
            assert not towards[i].any() and not apart[i].any()
            continue
        np.testing.assert_allclose(towards[i], (pos[neighbours] - pos[i]).sum(axis=0), rtol=1e-12, atol=1e-12)
        away = pos[i] - pos
        length = np.hypot(away[:, 0], away[:, 1])
        near = (length < 0.7) & (length > 0)
        np.testing.assert_allclose(apart[i], (away[near] / length[near, None]).sum(axis=0), atol=1e-12)


@settings(max_examples=200, deadline=None)
@given(
    values=st.lists(
        st.one_of(st.integers(0, 4).map(float), st.floats(0, 1e12), st.floats(0, 1e-12)), min_size=2, max_size=60
    ),
    data=st.data(),
)
def test_threshold_cuts_where_sorting_does(values, data):
    n = data.draw(st.integers(1, len(values) - 1))
    guess = data.draw(st.sampled_from([1e-300, 1e-6, 1.0, 1e9]))
    d2 = np.array(values)
    value, count = threshold(d2, len(d2), n, guess)
    ordered = np.sort(d2)
    assert count == (d2 <= value).sum()
    assert value >= ordered[n - 1]
    if count > n:
        assert value == ordered[n - 1]


@pytest.mark.parametrize("kind", KINDS)
def test_cells_hold_every_point_once_and_are_few(kind):
    pos = scene(kind, 1000, 6)
    for cells in (build(pos, 1e-7), build(pos, 0.3), build(pos, 1e9), build_for(pos, 40)):
        assert cells.rows * cells.columns == len(cells.start) - 1 <= CELLS_PER_POINT * 1000
        assert sorted(cells.order) == list(range(1000))
        np.testing.assert_array_equal(np.column_stack([cells.x, cells.y]), pos[cells.order])
        assert cells.start[0] == 0 and cells.start[-1] == 1000 and (np.diff(cells.start) >= 0).all()
        for c in np.flatnonzero(np.diff(cells.start)):
            assert (np.diff(cells.order[cells.start[c] : cells.start[c + 1]]) > 0).all()


def test_stragglers_do_not_coarsen_the_cells():
    tight = build_for(scene("gauss", 2000, 7), 40)
    strayed = build_for(scene("stragglers", 2000, 7), 40)
    assert strayed.size < 2 * tight.size


@pytest.mark.parametrize("bad", [np.nan, np.inf])
@pytest.mark.parametrize("use_grid", [False, True])
@pytest.mark.parametrize("n", [20, 48, 49])
def test_what_is_not_finite_does_not_hang_the_search(bad, use_grid, n):
    pos = scene("gauss", 50, 8)
    pos[7:9] = bad
    towards, apart = surroundings(pos, np.ones(50, bool), n, 0.4, use_grid, np.empty((0, 0), np.int64))
    assert towards.shape == apart.shape == (50, 2)
