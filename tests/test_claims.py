"""The verdicts on the paper's claims, against hand-worked cases."""

import json
import math
import random

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from shepherd_phys.controllers import CONTROLLERS
from shepherd_phys.controllers.claims import (
    COHESION,
    EVERYWHERE,
    EXPERIMENTS,
    FLOCKS,
    HEURISTICS,
    LEARNED,
    LITERAL,
    Trials,
    judge,
)
from shepherd_phys.controllers.summary import correlation, ranks, spearman
from shepherd_phys.controllers.verdicts import FAILS, HOLDS, UNDECIDED, Side

SEEDS = [41, 7, 1000, 3, 12, 8, 90, 66, 5, 23]
N = len(SEEDS)


def rows(method, delivered=100.0, path=100.0, points=EVERYWHERE, seeds=SEEDS):
    """Rows of a method; ``delivered`` and ``path`` are numbers, lists by trial, or functions of (flocks, n)."""

    def of(what, at, i):
        what = what(at) if callable(what) else what
        return what[i] if isinstance(what, list) else what

    return [
        {
            "controller": method,
            "n_flocks": at[0],
            "cohesion": at[1],
            "seed": seed,
            "in_goal_end": of(delivered, at, i),
            "path_length": of(path, at, i),
        }
        for at in points
        for i, seed in enumerate(seeds)
    ]


def heuristics(delivered=100.0, path=200.0):
    return [row for name in HEURISTICS for row in rows(name, delivered, path)]


def claim(name, found):
    (judged,) = judge(found, SEEDS, [name])
    return judged


def parts(name, found, method):
    return [part for part in claim(name, found).parts if part.method == method]


def half(low, high):
    """Values by trial: their mean is half-way, its interval straddles it."""
    return [low, high] * (N // 2)


# ---- one part: its interval and the claimed side --------------------------------------------------------------------


@pytest.mark.parametrize(
    ("side", "low", "high", "verdict"),
    [
        (Side(least=95.0), 95.0, 100.0, HOLDS),
        (Side(least=95.0), 94.9, 100.0, UNDECIDED),
        (Side(least=95.0), 90.0, 95.0, UNDECIDED),
        (Side(least=95.0), 90.0, 94.9, FAILS),
        (Side(most=50.0, strict=True), 0.0, 49.9, HOLDS),
        (Side(most=50.0, strict=True), 0.0, 50.0, UNDECIDED),
        (Side(most=50.0, strict=True), 50.0, 60.0, FAILS),
        (Side(most=50.0, strict=True), 50.1, 60.0, FAILS),
        (Side(least=0.0, strict=True), 0.1, 0.2, HOLDS),
        (Side(least=0.0, strict=True), 0.0, 0.2, UNDECIDED),
        (Side(least=0.0, strict=True), -0.2, 0.0, FAILS),
        (Side(least=-150.0, most=-50.0), -150.0, -50.0, HOLDS),
        (Side(least=-150.0, most=-50.0), -151.0, -60.0, UNDECIDED),
        (Side(least=-150.0, most=-50.0), -60.0, -49.0, UNDECIDED),
        (Side(least=-150.0, most=-50.0), -200.0, 0.0, UNDECIDED),
        (Side(least=-150.0, most=-50.0), -49.0, 10.0, FAILS),
        (Side(least=-150.0, most=-50.0), -300.0, -151.0, FAILS),
        (Side(least=0.0), math.nan, 1.0, UNDECIDED),
        (Side(least=0.0), -1.0, math.nan, UNDECIDED),
    ],
)
def test_a_side_and_an_interval(side, low, high, verdict):
    assert side.verdict(low, high) == verdict


def test_sides_say_what_they_claim():
    sides = [Side(least=95.0), Side(most=50.0, strict=True), Side(least=0.0, strict=True), Side(-150.0, -50.0)]
    assert [str(side) for side in sides] == ["≥ 95", "< 50", "> 0", "-150 to -50"]


# ---- rank correlation -----------------------------------------------------------------------------------------------


def test_equal_values_share_the_average_of_their_ranks():
    assert ranks(np.array([[30.0], [10.0], [20.0], [20.0]])).ravel().tolist() == [4.0, 1.0, 2.5, 2.5]
    assert ranks(np.array([[7.0], [7.0], [7.0]])).ravel().tolist() == [2.0, 2.0, 2.0]


def test_spearman_by_hand():
    x = np.array([10.0, 25.0, 40.0, 55.0])
    y = np.array([[1.0, 9.0, 10.0, 3.0], [2.0, 8.0, 20.0, 3.0], [5.0, 7.0, 20.0, 3.0], [6.0, 6.0, 30.0, 3.0]])
    rho = spearman(x, y)
    assert rho[:3] == pytest.approx([1.0, -1.0, 4.5 / math.sqrt(5.0 * 4.5)])  # ranks 1, 2.5, 2.5, 4 in the third
    assert math.isnan(rho[3])
    assert math.isnan(spearman(np.ones(4), y)[0])


@settings(deadline=None)  # scipy is loaded in the first example
@given(st.lists(st.tuples(st.integers(0, 4), st.integers(0, 4)), min_size=3, max_size=8))
def test_spearman_is_pearson_of_scipys_ranks(pairs):
    stats = pytest.importorskip("scipy.stats")
    x, y = np.array(pairs, dtype=np.float64).T
    expected = math.nan
    if len(set(x)) > 1 and len(set(y)) > 1:
        expected = np.corrcoef(stats.rankdata(x), stats.rankdata(y))[0, 1]
    assert spearman(x, y[:, None])[0] == pytest.approx(expected, nan_ok=True)


def test_a_resample_without_order_widens_the_interval_both_ways():
    x = np.arange(3.0)
    always = np.array([[1.0] * N, [2.0] * N, [3.0] * N])
    assert correlation(x, always) == (1.0, 1.0, 1.0)
    once = np.array([[1.0] * (N - 1) + [0.0], [1.0] * N, [1.0] * N])  # a third of the resamples miss that trial
    value, low, high = correlation(x, once)
    assert value > 0.8
    assert (low, high) == (-1.0, 1.0)
    value, low, high = correlation(x, np.ones((3, N)))
    assert math.isnan(value)
    assert (low, high) == (-1.0, 1.0)


def test_the_same_trials_in_another_order_are_equal():
    values = [28.999999999999996, 57.99999999999999, 56.00000000000001] * 7
    sums = {sum(random.Random(i).sample(values, len(values))) for i in range(20)}
    assert len(sums) > 1  # so that ranks of plain means would differ
    series = np.array([random.Random(i).sample(values, len(values)) for i in range(6)])
    assert math.isnan(correlation(np.arange(6.0), series)[0])


# ---- the claims -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "delivered", "verdict"),
    [
        ("c1", 95.0, HOLDS),
        ("c1", 94.0, FAILS),
        ("c1", half(90.0, 100.0), UNDECIDED),
        ("c2", 80.0, HOLDS),
        ("c2", 79.0, FAILS),
        ("c2", half(60.0, 100.0), UNDECIDED),
    ],
)
def test_wild_and_any_deliver(name, delivered, verdict):
    found = claim(name, rows("wild", delivered) + rows("any"))
    assert found.verdict == verdict
    points = FLOCKS[:1] if name == "c1" else FLOCKS[1:]
    assert [(part.method, part.at) for part in found.parts] == [(m, at) for m in ("wild", "any") for at in points]
    for part in found.parts:
        assert part.verdict == (verdict if part.method == "wild" else HOLDS)


def test_one_point_is_enough_to_fail():
    found = claim("c2", rows("any") + rows("wild", lambda at: 10.0 if at == (4, 40) else 100.0))
    assert found.verdict == FAILS
    assert [part.at for part in found.parts if part.verdict == FAILS] == [(4, 40)]
    assert claim("c2", rows("any") + rows("wild", lambda at: 10.0 if at == (2, 70) else 100.0)).verdict == HOLDS


@pytest.mark.parametrize(
    ("delivered", "verdict"), [(49.0, HOLDS), (50.0, FAILS), (90.0, FAILS), (half(0.0, 100.0), UNDECIDED)]
)
def test_original_fails_throughout(delivered, verdict):
    found = claim("c3", rows("original", lambda at: delivered if at == (2, 85) else 10.0))
    assert found.verdict == verdict
    assert [part.at for part in found.parts] == list(EVERYWHERE)


@pytest.mark.parametrize(
    ("delivered", "verdict"), [(99.0, HOLDS), (98.0, FAILS), (half(96.0, 100.0), UNDECIDED), (100.0, HOLDS)]
)
def test_learned_like_the_best_heuristic(delivered, verdict):
    others = [*heuristics(70.0), *rows("any"), *rows("strombom-literal"), *rows("idle")]
    others = [row for row in others if row["controller"] != "elfiqi"] + rows("elfiqi", 100.0)
    assert claim("c4", [*others, *rows("wild", delivered)]).verdict == verdict
    found = parts("c4", [*others, *rows("wild", delivered)], "wild")
    assert [part.at for part in found] == [(2, 40), (3, 40), (4, 40), (5, 40), (2, 10)]
    assert {part.rival for part in found} == {"elfiqi"}
    assert {part.verdict for part in found} == {verdict}


def test_differences_are_paired():
    shared = [float(10 * i) for i in range(N)]  # the trials differ by much more than the methods
    wild = [value + 1.0 for value in shared]
    found = parts("c4", heuristics(shared) + rows("any") + rows("wild", wild), "wild")
    assert {(part.value, part.low, part.high) for part in found} == {(1.0, 1.0, 1.0)}


def test_literal_heuristics_are_no_rivals():
    literal = [row for name in LITERAL for row in rows(name, 100.0, 400.0)]
    learned = rows("wild", 60.0, 100.0) + rows("any", 60.0, 100.0)
    assert claim("c4", heuristics(50.0) + learned + literal).verdict == HOLDS
    assert {part.rival for part in claim("c5", heuristics(50.0) + learned + literal).parts} == set(HEURISTICS)


def test_the_best_heuristic_is_known_only_when_all_were_run():
    found = parts("c4", rows("strombom") + rows("wild") + rows("any"), "wild")
    assert {part.verdict for part in found} == {UNDECIDED}
    assert {part.note for part in found} == {"not run: pierson, elfiqi, occlusion"}


@pytest.mark.parametrize(
    ("path", "verdict"),
    [(100.0, HOLDS), (150.0, HOLDS), (160.0, FAILS), (210.0, FAILS), (40.0, FAILS), (half(100.0, 200.0), UNDECIDED)],
)
def test_learned_paths_are_shorter(path, verdict):
    found = claim("c5", heuristics(50.0, 200.0) + rows("wild", path=path) + rows("any"))
    assert found.verdict == verdict
    own = [part for part in found.parts if part.method == "wild"]
    assert len(own) == len(HEURISTICS) * len(EVERYWHERE)
    assert {part.value for part in own} == {(np.mean(path) - 200.0)}


def test_heuristics_that_deliver_less_than_half_are_left_out():
    found = heuristics(lambda at: 49.0 if at == (3, 40) else 100.0) + rows("wild") + rows("any")
    assert [part.at for part in parts("c5", found, "any") if part.rival == "pierson"] == [
        at for at in EVERYWHERE if at != (3, 40)
    ]
    nothing = claim("c5", heuristics(49.0) + rows("wild") + rows("any"))
    assert (nothing.parts, nothing.verdict) == ((), UNDECIDED)


def test_collie_is_reported_beside():
    found = heuristics() + rows("wild") + rows("any") + rows("collie", 0.0, 500.0)
    for name in ("c4", "c5"):
        beside = parts(name, found, "collie")
        assert {(part.counts, part.verdict) for part in beside} == {(False, FAILS)}
        assert claim(name, found).verdict == HOLDS


@pytest.mark.parametrize(
    ("slope", "delivered", "paths"), [(0.5, HOLDS, FAILS), (-0.5, FAILS, HOLDS), (0.0, UNDECIDED, UNDECIDED)]
)
def test_what_follows_n(slope, delivered, paths):
    noise = [0.1 * i for i in range(N)]

    def value(at):
        return [50.0 + slope * at[1] + more for more in noise]

    found = rows("strombom", value, value) + rows("strombom-literal", value, value)
    for name, verdict in (("c6", delivered), ("c7", paths)):
        (own,), (beside,) = parts(name, found, "strombom"), parts(name, found, "strombom-literal")
        assert (own.verdict, own.counts, own.at) == (verdict, True, None)
        assert (beside.verdict, beside.counts) == (verdict, False)
        if slope:
            assert (own.value, own.low, own.high) == pytest.approx((np.sign(slope),) * 3)
        else:
            assert own.value is None
            assert own.note == "the same at every n: no correlation is defined"


def test_c6_and_c7_are_about_every_method():
    everybody = [*HEURISTICS, "original", "any", "wild"]
    found = [row for name in everybody for row in rows(name, lambda at: float(at[1]), lambda at: 300.0 - at[1])]
    for name in ("c6", "c7"):
        assert claim(name, found).verdict == HOLDS
        assert [part.method for part in claim(name, found).parts] == everybody
        without = [row for row in found if row["controller"] != "any"]
        assert claim(name, without).verdict == UNDECIDED
        assert [part.note for part in parts(name, without, "any")] == ["not run"]


def test_without_learned_methods_their_claims_are_undecided():
    judged = {claim.name: claim for claim in judge(heuristics(), SEEDS)}
    assert list(judged) == [f"c{i}" for i in range(1, 9)]
    for name in ("c1", "c2", "c3", "c4", "c5"):
        assert judged[name].verdict == UNDECIDED
        assert {part.note for part in judged[name].parts} == {"not run"}
    assert {claim.verdict for claim in judge([], SEEDS)} == {UNDECIDED}


def test_without_learning_curves_theirs_is_undecided():
    c8 = judge([row for name in LEARNED for row in rows(name)], SEEDS)[-1]
    assert (c8.name, c8.verdict) == ("c8", UNDECIDED)
    assert [part.note for part in c8.parts] == ["not run: wild, any"]


def test_a_point_that_lacks_a_trial_was_not_run():
    full = rows("wild") + rows("any")
    lacking = [row for row in full if (row["controller"], row["n_flocks"], row["seed"]) != ("any", 3, SEEDS[4])]
    assert claim("c2", full).verdict == HOLDS
    assert claim("c2", lacking).verdict == UNDECIDED
    (part,) = [part for part in parts("c2", lacking, "any") if part.verdict == UNDECIDED]
    assert (part.at, part.value, part.note) == ((3, 40), None, "not run")
    n40 = [row for row in rows("pierson", lambda at: float(at[1])) if row["cohesion"] != 55]
    assert [part.note for part in parts("c6", n40, "pierson")] == ["not run: n = 55"]


def test_neither_order_nor_more_trials_matter():
    rng = np.random.default_rng(0)
    found = []
    for name in (*HEURISTICS, *LEARNED):
        for at in EVERYWHERE:
            found += rows(name, rng.uniform(0, 100, N).tolist(), rng.uniform(50, 300, N).tolist(), [at])
    shuffled = [*found, *rows("wild", 0.0, seeds=[1, 2])]
    random.Random(1).shuffle(shuffled)
    first, second = (json.dumps([claim.to_dict() for claim in judge(r, SEEDS)]) for r in (found, shuffled))
    assert first == second


def test_trials_come_in_the_order_of_the_seeds():
    found = rows("wild", [float(seed) for seed in SEEDS])
    assert Trials(reversed(found), SEEDS).values("wild", (1, 40), "in_goal_end").tolist() == SEEDS


# ---- the experiments ------------------------------------------------------------------------------------------------


def test_the_papers_points():
    assert EXPERIMENTS["figure2"].points == FLOCKS == ((1, 40), (2, 40), (3, 40), (4, 40), (5, 40))
    assert EXPERIMENTS["figure3"].points == COHESION == ((2, 10), (2, 25), (2, 40), (2, 55), (2, 70), (2, 85))
    assert len(EVERYWHERE) == 10


def test_every_controller_has_its_part():
    """A new one is put into a group: else it would be left out of the figures in silence."""
    # the paper's worlds have no obstacles: that policy has a study of its own
    groups = [*HEURISTICS, *LEARNED, *LITERAL, "collie-obstacles", "random", "idle"]
    assert set(CONTROLLERS) <= set(groups)
    assert len(set(groups)) == len(groups)
