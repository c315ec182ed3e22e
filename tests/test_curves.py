"""Learning curves: where they level off, claim c8, how they are binned, what pages and drawings make of them."""

import itertools
import json

import numpy as np
import pytest

from shepherd_phys.controllers.claims import judge
from shepherd_phys.controllers.curves import (
    COLUMNS,
    WINDOW,
    averaged,
    curve_of,
    final_value,
    later_by,
    level_off,
    levels_off_at,
    steps_at,
)
from shepherd_phys.controllers.verdicts import FAILS, HOLDS, UNDECIDED
from shepherd_phys.learning.preset import load_preset
from shepherd_phys.learning.studies import Run, ablations, deciding_every, figure1, variants
from shepherd_phys.scripts.curves import VALIDATIONS, binned
from shepherd_phys.scripts.learning_pages import ablations_page, figure1_page
from shepherd_phys.scripts.pages import claims_page, part_cells
from shepherd_phys.scripts.studies import HOME_COLUMNS, time_to_home


def rows(reward, values, seed=0, recipe="fast", **more):
    """A curve of a run: evaluation k, after (k + 1) million shepherd-steps, in the rollout k + 1."""
    return [
        {
            **dict.fromkeys(COLUMNS),
            **{"recipe": recipe, "reward": reward, "seed": seed, "rollout": k + 1},
            **{"shepherd_steps": (k + 1) * 1_000_000, "decisions": (k + 1) * 200_000, "seconds": 100.0 * (k + 1)},
            **{"episode_reward": value, "in_goal_end": value, "path_length": 200.0, **more},
        }
        for k, value in enumerate(values)
    ]


def step(at, n=40, high=10.0):
    """0 before evaluation ``at``, ``high`` from there on."""
    return [0.0] * at + [high] * (n - at)


# ---- levelling off --------------------------------------------------------------------------------------------------


def test_level_off_by_hand():
    # a step at evaluation 10: the average over five is 0, 2, 4, 6, 8, 10 at evaluations 9 to 14
    curve = np.array([step(10, 20), step(0, 20), [*range(20)]], dtype=np.float64)
    assert averaged(curve)[0].tolist() == [0.0] * 6 + [2.0, 4.0, 6.0, 8.0] + [10.0] * 6
    # constant: at the first average; a ramp: 5 % of its range of 15 is less than one step, so at its end
    assert level_off(curve).tolist() == [14, WINDOW - 1, 19]


def test_what_is_within_five_percent_is_level():
    # the average at evaluation 9 is 9.6 or 9.4: the one lies within 0.5 of the end, the other does not
    near, far = ([0.0] * 5 + [first] * 5 + [10.0] * 5 for first in (9.6, 9.4))
    assert level_off(np.array([near])).tolist() == [9]
    assert level_off(np.array([far])).tolist() == [10]


def test_a_curve_that_leaves_the_band_again_levels_off_later():
    dips = step(5, 60)
    dips[40:45] = [5.0] * 5
    # the dip's last trace in the average, 9, is at evaluation 48
    assert level_off(np.array([dips])).tolist() == [49]


def test_a_curve_still_rising_has_not_levelled_off():
    assert levels_off_at(curve_of(rows("wild", range(30)), "fast", "wild")) is None
    assert levels_off_at(curve_of(rows("wild", step(10)), "fast", "wild")) == 15e6
    assert levels_off_at(curve_of(rows("wild", [1.0] * WINDOW), "fast", "wild")) is None
    assert levels_off_at(curve_of(rows("wild", [1.0] * 2 * WINDOW), "fast", "wild")) == 5e6
    assert levels_off_at(curve_of([], "fast", "wild")) is None and final_value(curve_of([], "fast", "wild")) is None


def test_what_moves_in_the_last_tenth_has_not_levelled_off():
    """Of 100 evaluations the tail begins at the 90th; a step at evaluation k (from 0) is over at the (k + 5)th."""
    for at, found in ((84, 89e6), (85, None), (94, None)):
        curve = curve_of(rows("wild", step(at, 100)), "fast", "wild")
        assert levels_off_at(curve) == found
        assert steps_at(curve, level_off(curve.values)).tolist() == [found or np.inf]
    # of 20 evaluations the last five, which make the final value, are more than a tenth
    assert levels_off_at(curve_of(rows("wild", step(10, 20)), "fast", "wild")) == 15e6
    assert levels_off_at(curve_of(rows("wild", step(11, 20)), "fast", "wild")) is None


def test_seeds_are_aligned_by_rollout():
    one, other = rows("wild", [1.0, None, 3.0, 4.0]), rows("wild", [5.0, 6.0, 7.0], seed=1)
    curve = curve_of([*reversed(one), *other, *rows("any", [9.0] * 4)], "fast", "wild")
    assert (curve.seeds, curve.steps.tolist(), curve.values.tolist()) == ((0, 1), [1e6, 3e6], [[1.0, 3.0], [5.0, 7.0]])
    assert curve.rollouts == (1, 3)
    assert [own.tolist() for own in curve.until(2)[2:]] == [[1e6], [[1.0], [5.0]]]
    assert final_value(curve) == 4.0


# ---- claim c8 -------------------------------------------------------------------------------------------------------


def study(wild, other, recipe="fast"):
    """Runs whose curves step up at these evaluations."""
    return [
        row
        for reward, steps in (("wild", wild), ("any", other))
        for seed, at in enumerate(steps)
        for row in rows(reward, step(at), seed, recipe)
    ]


def c8(curves):
    (claim,) = judge([], [], ["c8"], curves)
    return claim


def test_c8_holds_fails_and_is_undecided():
    held = c8(study([10, 10, 10], [20, 20, 20]))
    (part,) = held.parts
    assert (held.verdict, part.method, part.rival, part.recipe) == (HOLDS, "any", "wild", "fast")
    assert (part.value, part.low, part.high) == (10.0, 10.0, 10.0)  # million shepherd-steps
    assert c8(study([20, 20, 20], [10, 10, 10])).verdict == FAILS
    assert c8(study([10, 10, 10], [10, 10, 10])).verdict == FAILS  # not before
    mixed = c8(study([8, 15, 28], [9, 14, 29]))
    assert mixed.verdict == UNDECIDED
    assert mixed.parts[0].low < 0 < mixed.parts[0].high


def test_c8_is_undecided_on_curves_that_do_not_level_off():
    """Forty evaluations: the tail begins at 35 million, before the last five."""
    rising, level = [38, 38, 38], [10, 10, 10]
    for wild, other, note in (
        (rising, [37, 38, 39], "neither levels off"),
        (level, rising, "any does not level off"),
        (rising, level, "wild does not level off"),
    ):
        claim = c8(study(wild, other))
        (part,) = claim.parts
        assert (claim.verdict, part.note, part.value, part.budget) == (UNDECIDED, note, None, 40e6)
        assert json.dumps(claim.to_dict(), allow_nan=False)


def test_a_longer_curve_may_level_off_before_the_shorter_ones_tail():
    """Why nothing is known of a curve that has not levelled off, not even a bound."""
    rises = [*step(10, 38), 11.6, 11.6]
    assert levels_off_at(curve_of(rows("wild", rises), "fast", "wild")) is None
    assert levels_off_at(curve_of(rows("wild", [*rises, *[10.5] * 60]), "fast", "wild")) == 15e6


def test_c8_is_undecided_where_another_draw_of_seeds_would_not_have_levelled_off():
    """One seed of wild of four is late: drawn twice, it moves the end."""
    few = [[10.0 * (k >= 10) + 0.4 * (k >= 38) * late for k in range(40)] for late in (0, 0, 0, 10)]
    curves = [row for seed, values in enumerate(few) for row in rows("wild", values, seed)]
    claim = c8([*curves, *study([], [20, 20, 20])])
    (part,) = claim.parts
    assert (claim.verdict, part.value, part.low, part.high) == (UNDECIDED, 10.0, -np.inf, np.inf)
    assert part_cells(part.to_dict())[2] == "10.00 [-∞, ∞]"
    assert claim.to_dict()["parts"][0]["low"] is None


def test_c8_compares_curves_of_one_length():
    """Of the longer one what the shorter one has: where a curve levels off depends on its end."""
    longer = [row for seed in range(3) for row in rows("any", [*step(20), *[50.0] * 40], seed)]
    claim = c8([*study([10] * 3, []), *longer])
    assert (claim.verdict, claim.parts[0].value, claim.parts[0].budget) == (HOLDS, 10.0, 40e6)


def test_c8_waits_for_what_it_needs():
    def note(curves):
        claim = c8(curves)
        assert claim.verdict == UNDECIDED
        return claim.parts[0].note

    assert note([]) == "not run: wild, any"
    assert note(study([10, 10, 10], [])) == "not run: any"
    assert note(study([10, 10, 10], [20, 20])) == "fewer than 3 seeds"
    few = [row for row in study([10] * 3, [20] * 3) if row["rollout"] < WINDOW]
    assert note(few) == "fewer than 5 evaluations"


def test_the_papers_recipe_is_judged_beside():
    curves = [*study([10] * 3, [20] * 3), *study([20] * 3, [10] * 3, "paper")]
    claim = c8(curves)
    assert [(part.recipe, part.verdict, part.counts) for part in claim.parts] == [
        ("fast", HOLDS, True),
        ("paper", FAILS, False),
    ]
    assert claim.verdict == HOLDS
    one = c8([*study([10] * 3, [20] * 3), *rows("wild", step(10), recipe="paper")])
    assert one.parts[1].note == "not run: any" and one.verdict == HOLDS
    page = claims_page({"trials": 100, "seed": 1, "version": "9", "claims": [claim.to_dict()]})
    assert (
        "| any - wild | recipe fast, 40.00 M shepherd-steps | 10.00 [10.00, 10.00] | > 0 | holds |" in page.splitlines()
    )
    late = part_cells(c8(study([10] * 3, [38] * 3)).parts[0].to_dict())
    assert late[2:] == ("any does not level off", "> 0", "undecided")


def test_the_interval_is_of_seeds_resampled_apart():
    """Three seeds of wild that level off at 14, 14 and 24 e6, and of any at 34 e6: what resampling can give."""
    curves = study([10, 10, 20], [30, 30, 30])
    later = later_by(curve_of(curves, "fast", "any"), curve_of(curves, "fast", "wild"))
    # wild's mean is 0, 2/3, 1 of its end: at the third seed's step it is still outside, unless that seed is not drawn
    assert (later.value, later.low, later.high) == (10e6, 10e6, 20e6)


# ---- rows -----------------------------------------------------------------------------------------------------------


def test_neighbouring_rollouts_become_one_row():
    own = rows("wild", [None, 1.0, 3.0, 5.0, None, None, None])
    assert binned(own, 1) == [*own[1:4], own[6]]  # those that say something, and the last
    halves = binned(own, 2)
    assert [(row["rollout"], row["shepherd_steps"], row["episode_reward"]) for row in halves] == [
        (2, 2_000_000, 1.0),
        (4, 4_000_000, 4.0),
        (8, 7_000_000, None),
    ]


def validation(seed, checkpoint, delivered, recipe="fast", reward="wild"):
    return [
        {
            **dict.fromkeys(VALIDATIONS),
            **{"recipe": recipe, "reward": reward, "seed": seed, "checkpoint": checkpoint, "n_flocks": k + 1},
            **{"shepherd_steps": checkpoint * 480_000, "seconds": checkpoint * 60.5, "in_goal_end": value},
            **{"cohesion": 40, "n_shepherds": 3, "trials": 20, "path_length": 100.0},
        }
        for k, value in enumerate(delivered)
    ]


def test_the_time_to_home_by_hand():
    runs = [Run(f"wild-{seed}", "fast", load_preset("fast").but(seed=seed)) for seed in (0, 1)]
    checks = [
        *validation(0, 1, [99.0, 96.9]),
        *validation(0, 2, [97.0, 100.0]),
        *validation(0, 3, [90.0, 100.0]),
        *validation(0, 4, [100.0, 100.0]),
        *validation(1, 1, [100.0, 96.9]),
        *validation(1, 1, [100.0, 100.0], reward="any"),
    ]
    home = time_to_home(runs, checks)
    assert all(tuple(row) == HOME_COLUMNS for row in home)
    told = ("seed", "checkpoint", "shepherd_steps", "seconds", "n_flocks", "validated", "confirmed_mean")
    assert [tuple(row[name] for name in told) for row in home] == [
        (0, 2, 960_000, 121.0, 1, 97.0, None),
        (0, 2, 960_000, 121.0, 2, 100.0, None),
        (1, None, None, None, None, None, None),
    ]


# ---- pages and drawings ---------------------------------------------------------------------------------------------

CURVES = [row for seed in (0, 1) for row in rows("wild", step(10), seed)] + rows("any", [1.0] * 3, recipe="paper")
SPREAD = "98.0 (97.0 to 99.0) | 95.0 (90.0 to 100.0)"
"""What the page tells of their ends."""
CHECKS = validation(0, 1, [0.0, 0.0]) + validation(0, 2, [99.0, 90.0]) + validation(1, 2, [97.0, 100.0])


def test_figure_1_as_a_page():
    home = [
        dict(zip(HOME_COLUMNS, (0, 2, 960_000, 121.0, 1, 97.0, 100, 96.5, 95.0, 98.0), strict=True)),
        dict(zip(HOME_COLUMNS, (0, 2, 960_000, 121.0, 2, 100.0, 99, None, None, None), strict=True)),
        {**dict.fromkeys(HOME_COLUMNS), "seed": 1},
    ]
    lines = figure1_page(CURVES, CHECKS, home).splitlines()
    assert "| recipe | reward | seeds | final reward | levels off at | 1 flock | 2 flocks | rate | time |" in lines
    assert f"| fast | wild | 2 | 10.00 | 15.00 | {SPREAD} | 10,000 | 1:06:40 |" in lines
    assert "| paper | any | 1 | 1.00 | not within 3.00 |  |  | 10,000 | 0:05:00 |" in lines
    assert any("one process each" in line and "`paper`" in line for line in lines)
    assert "| 0 | 0.96 | 0:02:01 | 96.5 [95.0, 98.0] | not confirmed |" in lines
    assert "| 1 | not reached |  |  |  |" in lines


def test_the_time_of_a_scheme_is_of_the_runs_that_were_trained_alone():
    slow = [{**row, "seconds": 3.0 * row["seconds"]} for row in CURVES if (row["recipe"], row["seed"]) == ("fast", 1)]
    curves = [row for row in CURVES if (row["recipe"], row["seed"]) != ("fast", 1)] + slow
    home = [{**dict.fromkeys(HOME_COLUMNS), "seed": 0}]
    assert f"| fast | wild | 2 | 10.00 | 15.00 | {SPREAD} | 10,000 | 1:06:40 |" in figure1_page(curves, CHECKS, home)
    assert f"| fast | wild | 2 | 10.00 | 15.00 | {SPREAD} |  |  |" in figure1_page(curves, CHECKS, [])


def test_the_ablations_as_a_page():
    late = rows("wild", step(10, high=60.0), 0, "b") + rows("wild", [1.0] * 40, 1, "b")
    lines = ablations_page([*CURVES[:40], *late], CHECKS[:4]).splitlines()
    both = "99.0 | 90.0"
    assert f"| fast | 1 | 40.00 | 8,000,000 | {both} | 10.00 | never |" in lines
    assert "| b | 2 | 40.00 | 8,000,000 |  |  | 30.50 | 11.00 (1 of 2) |" in lines


def test_curves_are_drawn(tmp_path):
    pytest.importorskip("matplotlib")
    from test_figures import has, pixels

    from shepherd_phys.scripts.figures import STYLES
    from shepherd_phys.scripts.learning_figures import LINES, draw_ablations, draw_figure1

    drawn = draw_figure1(CURVES, CHECKS)
    assert drawn == draw_figure1(CURVES, CHECKS)
    picture = pixels(drawn, tmp_path)
    assert has(picture, STYLES["wild"][0]) and has(picture, STYLES["any"][0])
    assert not has(picture, STYLES["pierson"][0])
    half = picture.shape[1] // 2
    changed = (picture != pixels(draw_figure1(CURVES, CHECKS[:2]), tmp_path)).any(axis=2)
    assert changed[:, half:].any() and not changed[:, :half].any()
    two = [*CURVES, *rows("wild", step(20), recipe="b")]
    picture = pixels(draw_ablations(two), tmp_path)
    assert has(picture, LINES[1][0]) and not has(picture, LINES[2][0])  # fast and b on the left, paper on the right
    picture = pixels(draw_ablations([*two, *rows("wild", step(20), recipe="paper-b")]), tmp_path)
    assert has(picture[:, half:], LINES[1][0]) and not has(picture, LINES[2][0])


# ---- which runs -----------------------------------------------------------------------------------------------------


def changes(base, other, path=""):
    """What differs between two presets, as dotted names."""
    found = {}
    for name in {**base, **other}:
        a, b = base.get(name), other.get(name)
        if isinstance(a, dict) and isinstance(b, dict):
            found |= changes(a, b, f"{path}{name}.")
        elif a != b:
            found[path + name] = b
    return found


def test_variants_differ_in_what_they_say():
    plain = {name: preset.to_dict() for name, preset in variants().items()}
    assert {preset.lidar.sectors for preset in variants().values()} == {64}
    assert {preset.network for preset in variants().values()} == {load_preset("fast").network}
    assert plain["fast"] == load_preset("fast").but(wander=None).to_dict()
    less = {name: changes(plain["fast"], other) for name, other in plain.items() if name.startswith("fast-")}
    gamma = less["fast-every-step"].pop("ppo.gamma")
    assert less["fast-every-step"].pop("ppo.gae_lambda") ** 5 == pytest.approx(0.95)
    assert less == {
        "fast-world-frame": {"lidar.frame": "world"},
        "fast-team-credit": {"credit": "team"},
        "fast-own-critic": {"critic_sees": "own"},
        "fast-every-step": {"decision_interval": 1, "ppo.n_steps": 250},
        "fast-alpha-0": {"alpha": 0.0},
        "fast-original-world-frame": {"reward": "original", "lidar.frame": "world"},
    }
    assert gamma**5 == pytest.approx(0.98)
    papers = [name for name in plain if name.startswith("paper")]
    assert changes(load_preset("paper").to_dict(), plain[papers[0]]) == {"lidar.sectors": 64, "network.group": 4}
    more = [changes(plain[a], plain[b]) for a, b in itertools.pairwise(papers)]
    assert more == [{"lidar.frame": "goal"}, {"credit": "own"}, {"critic_sees": "world"}, {"decision_interval": 5}]


def test_deciding_less_often_keeps_the_second():
    fast = load_preset("fast")
    finer = deciding_every(fast, 1)
    assert finer.ppo.n_steps * finer.decision_interval == fast.ppo.n_steps * fast.decision_interval
    back = deciding_every(finer, 5)
    assert back.ppo.gamma == pytest.approx(fast.ppo.gamma) and back.ppo.n_steps == fast.ppo.n_steps


def test_alpha_reaches_the_occlusion_term_alone():
    fast = load_preset("fast")
    assert fast.scheme()["occlude"][1].alpha == 2.0
    without = fast.but(alpha=0.0).scheme()
    assert without["occlude"][1].alpha == 0.0 and without["occlude"][0] == 0.1
    assert {name: term for name, term in without.items() if name != "occlude"} == {
        name: term for name, term in fast.scheme().items() if name != "occlude"
    }


def test_the_runs_of_figure_1():
    runs = figure1(5, 1000, 2.0)
    assert [run.name for run in runs] == [
        "wild-1000000", "wild-1000001", "wild-1000002", "paper-wild-1000000",
        "any-1000000", "original-1000000", "any-1000001", "original-1000001", "any-1000002", "original-1000002",
        "wild-1000003", "any-1000003", "original-1000003", "wild-1000004", "any-1000004", "original-1000004",
    ]  # fmt: skip
    assert [run.timed for run in runs] == [True] * 3 + [False] * 13
    for run in [run for run in runs if run.recipe == "fast"]:
        preset = run.preset
        assert run.name == f"{preset.reward}-{preset.seed}" and run.hours == float("inf")
        assert set(changes(load_preset("fast").to_dict(), preset.to_dict())) <= {
            "budget", "reward", "seed", "validation.flocks", "validation.trials",
            "validation.passes",
        }  # fmt: skip
        assert (preset.validation.flocks, preset.validation.trials) == ((1, 2, 3, 4, 5), 20)
        assert (preset.validation.cohesion, preset.validation.shepherds, preset.validation.every) == ((40,), (3,), 1)
        assert (preset.budget, preset.validation.passes) == (1000, 97.0)
    paper = runs[3]
    assert (paper.recipe, paper.hours, paper.preset.reward, paper.preset.budget) == ("paper", 2.0, "wild", 300_000_000)
    assert [run.name for run in figure1(1, 1000, 0.0)] == ["wild-1000000", "any-1000000", "original-1000000"]


def test_no_variant_of_the_ablations_trains_longer_than_another():
    runs = ablations(3, 2_500_000)
    assert len(runs) == len({run.name for run in runs}) == 36
    assert {run.preset.seed for run in runs[:12]} == {1_000_000}  # seed by seed
    assert {(run.preset.budget, run.preset.validation.flocks) for run in runs} == {(2_500_000, (1, 2, 5))}
    lengths = [run.preset.n_rollouts * run.preset.rollout_steps for run in runs]
    assert min(lengths) >= 2_500_000 and max(lengths) <= 1.05 * min(lengths)
    assert runs[0].preset.checkpoint_rollouts <= load_preset("fast").checkpoint_rollouts
    assert ablations(1, 960_000)[0].preset == runs[0].preset.but(budget=960_000, checkpoint_rollouts=20)
