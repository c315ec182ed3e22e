"""Measures of an episode, trial seeds, intervals and paired differences, against hand-worked cases."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from shepherd_phys.controllers.evaluation import (
    COLUMNS,
    METRICS,
    ControllerError,
    checked_controller,
    evaluate,
    parameters_of,
    run_episode,
    trial_seed,
)
from shepherd_phys.controllers.summary import intervals, paired_differences, summarise, summary_columns
from shepherd_phys.state import WorldState


def state(step, in_goal, arrived, n_sheep=20, n_shepherds=2, **changes):
    """A state in which the first ``in_goal`` sheep are in and the first ``arrived`` have been in."""
    inside = np.arange(n_sheep) < in_goal
    values = {
        "step": step,
        "time": step * 0.2,
        "goal_pos": np.zeros(2),
        "goal_radius": 2.5,
        "sheep_pos": np.where(inside[:, None], 0.0, 9.0) * np.ones(2),
        "sheep_vel": np.zeros((n_sheep, 2)),
        "sheep_heading": np.tile([1.0, 0.0], (n_sheep, 1)),
        "sheep_goal_distance": np.where(inside, 0.0, 10.0),
        "sheep_in_goal": inside,
        "sheep_arrived": np.arange(n_sheep) < arrived,
        "sheep_radius": np.full(n_sheep, 0.15),
        "sheep_max_speed": np.ones(n_sheep),
        "shepherd_pos": np.zeros((n_shepherds, 2)),
        "shepherd_vel": np.zeros((n_shepherds, 2)),
        "shepherd_angle": np.zeros(n_shepherds),
        "shepherd_radius": np.full(n_shepherds, 0.25),
        "shepherd_max_speed": np.full(n_shepherds, 1.5),
        "shepherd_path": np.zeros(n_shepherds),
        "collisions": 0,
        "obstacles": (),
    }
    return WorldState(**{**values, **changes})


class FilmEnv:
    """Plays given states back; the action is only looked at."""

    def __init__(self, film, lidar=None, rewards=None, terminated=False):
        self.film, self.lidar, self.rewards = film, lidar, rewards
        self.terminated = terminated
        self.user_rng = np.random.default_rng(0)
        self.actions = []
        self.closed = False

    @property
    def state(self):
        return self.film[self.at]

    def reset(self, *, seed=None):
        self.at, self.seed = 0, seed
        self.user_rng = np.random.default_rng(seed)
        return np.zeros((2, 0)), {}

    def step(self, action):
        self.actions.append(action)
        self.at += 1
        over = self.at == len(self.film) - 1
        return np.zeros((2, 0)), 0.0, over and self.terminated, over and not self.terminated, {}

    def close(self):
        self.closed = True


class Still:
    lidar = None

    def reset(self, rng):
        self.drawn = rng.random()

    def act(self, observation, state):
        return np.zeros((state.n_shepherds, 2))


def film(*counts, arrived=0, **last):
    states = [state(i, n, max(n, arrived)) for i, n in enumerate(counts)]
    return [*states[:-1], states[-1].but(**last)]


# ---- one episode --------------------------------------------------------------------------------------------------


def test_a_row_by_hand():
    played = film(0, 10, 19, 5, arrived=19, shepherd_path=[3.0, 4.0], collisions=7)
    assert run_episode(Still(), FilmEnv(played), 11) == {
        "seed": 11,
        "in_goal_end": 25.0,
        "ever_in_goal": 95.0,
        "mean_occupancy": pytest.approx(100 * (10 + 19 + 5) / 60),
        "path_length": 3.5,
        "time_to_95": 0.4,
        "reached_95": True,
        "success": False,
        "collisions": 7,
        "steps": 3,
    }


def test_never_reached_is_the_length_of_the_episode():
    found = run_episode(Still(), FilmEnv(film(0, 18, 18)), 0)
    assert (found["time_to_95"], found["reached_95"], found["success"]) == (0.4, False, False)


def test_reached_before_the_first_step_and_kept():
    found = run_episode(Still(), FilmEnv(film(20, 20), terminated=True), 0)
    assert (found["time_to_95"], found["reached_95"], found["success"]) == (0.0, True, True)
    assert (found["in_goal_end"], found["ever_in_goal"], found["mean_occupancy"]) == (100.0, 100.0, 100.0)


@pytest.mark.parametrize(("n", "enough"), [(100, 95), (20, 19), (7, 7), (40, 38), (1, 1), (60, 57)])
def test_95_percent_counts_exactly(n, enough):
    for count, success in ((enough, True), (enough - 1, False)):
        played = [state(0, 0, 0, n), state(1, count, count, n)]
        assert run_episode(Still(), FilmEnv(played), 0)["success"] is success


def test_no_shepherds():
    found = run_episode(Still(), FilmEnv([state(0, 0, 0, n_shepherds=0), state(1, 0, 0, n_shepherds=0)]), 0)
    assert found["path_length"] == 0.0


def test_rows_are_plain_data_and_have_the_columns():
    found = run_episode(Still(), FilmEnv(film(0, 1)), np.int64(3))
    assert {type(value) for value in found.values()} <= {int, float, bool}
    assert tuple(found) == ("seed", *METRICS)


def test_the_columns_are_those_of_the_specification():
    assert ", ".join(COLUMNS) == (
        "controller, n_flocks, cohesion, n_shepherds, n_sheep, scenario, seed, in_goal_end, ever_in_goal, "
        "mean_occupancy, path_length, time_to_95, reached_95, success, collisions, steps, settings_hash, version"
    )


def test_the_controller_draws_from_the_envs_stream():
    controller = Still()
    run_episode(controller, FilmEnv(film(0, 1)), 5)
    assert controller.drawn == np.random.default_rng(5).random()


class Wild:
    """Wraps an env as Gymnasium does: the state is only on the unwrapped one."""

    def __init__(self, env):
        self.unwrapped = env
        self.reset, self.step = env.reset, env.step


def test_a_wrapped_env():
    assert run_episode(Still(), Wild(FilmEnv(film(0, 20))), 0)["success"]


@pytest.mark.parametrize(
    ("action", "message"),
    [
        (np.full((2, 2), np.nan), "holds a NaN or an infinity"),
        ([[0.0, np.inf], [0.0, 0.0]], "holds a NaN or an infinity"),
        (np.zeros(2), r"must have the shape \(2, 2\), has \(2,\)"),
        (np.zeros((3, 2)), r"must have the shape \(2, 2\), has \(3, 2\)"),
        (None, "must have the shape|holds a NaN"),
        ("left", "must be an array of numbers"),
        ([[0, 0], [0]], "must be an array of numbers"),
    ],
)
def test_bad_actions_name_the_controller_and_never_reach_the_env(action, message):
    class Bad(Still):
        def act(self, observation, state):
            return action

    env = FilmEnv(film(0, 1))
    with pytest.raises(ControllerError, match=rf"^controller .*Bad, step 0: .*({message})"):
        run_episode(Bad(), env, 0)
    assert env.actions == []


# ---- many ---------------------------------------------------------------------------------------------------------


def test_evaluate_makes_one_env_without_rewards_and_takes_seeds_as_they_are():
    made = []

    def make_env(**arguments):
        made.append(FilmEnv(film(0, 20), **arguments))
        return made[-1]

    rows = evaluate(Still(), make_env, seeds=range(20_000, 20_003))
    assert [row["seed"] for row in rows] == [20_000, 20_001, 20_002]
    assert {row["controller"] for row in rows} == {"Still"}
    assert [(env.lidar, env.rewards, env.closed) for env in made] == [(None, {}, True)]
    assert evaluate(Still, make_env, seeds=[20_000]) == rows[:1]


def test_what_is_no_controller_is_told_what_it_lacks():
    class Half:
        lidar = None

        def act(self, observation, state): ...

    class Greedy(Still):
        def __init__(self, food): ...

    with pytest.raises(ControllerError, match=r"Half: lacks reset; a controller has"):
        checked_controller(Half())
    with pytest.raises(ControllerError, match=r"int: lacks lidar and reset and act"):
        evaluate(3, FilmEnv, [0])
    with pytest.raises(ControllerError, match=r"Greedy: cannot be made without arguments"):
        checked_controller(Greedy)


def test_parameters():
    class Settled(Still):
        def settings(self):
            return {"a": 1}

    class Told(Settled):
        def to_dict(self):
            return {"b": 2}

    assert [parameters_of(cls()) for cls in (Still, Settled, Told)] == [{}, {"a": 1}, {"b": 2}]


def test_trial_seeds_are_fixed_for_ever():
    # published results hang on these numbers
    assert [trial_seed(20_000, i) for i in range(3)] == [708042867668439813, 6359048639295609796, 6860638520428838029]
    assert trial_seed(20_001, 0) != trial_seed(20_000, 1)


@given(st.integers(0, 10**7), st.integers(0, 10**6))
def test_trial_seeds_depend_on_root_and_trial_alone(root, trial):
    seed = trial_seed(root, trial)
    assert 0 <= seed < 2**63
    assert seed == trial_seed(root, trial)


def test_100_000_trials_are_all_different():
    assert len({trial_seed(20_000, trial) for trial in range(100_000)}) == 100_000


# ---- summaries ----------------------------------------------------------------------------------------------------


def rows_of(controller, values, n_flocks=1, first_seed=0):
    return [
        {"controller": controller, "n_flocks": n_flocks, "seed": first_seed + i, **dict.fromkeys(METRICS, value)}
        for i, value in enumerate(values)
    ]


def test_intervals_of_a_known_distribution_cover_its_mean():
    rng = np.random.default_rng(3)
    samples = rng.normal(5.0, 2.0, (300, 60))
    mean, low, high = intervals(samples, resamples=1000).T
    np.testing.assert_allclose(mean, samples.mean(axis=1))
    assert np.all((low <= mean) & (mean <= high))
    covered = np.mean((low <= 5.0) & (high >= 5.0))
    assert 0.88 <= covered <= 0.98
    # the width is that of the normal theory, 2 x 1.96 s / sqrt(n), to a few percent
    theory = 2 * 1.96 * samples.std(axis=1) / np.sqrt(60)
    assert np.mean((high - low) / theory) == pytest.approx(1.0, abs=0.05)


def test_intervals_of_constants_and_of_one_trial():
    np.testing.assert_array_equal(intervals(np.full((1, 30), 0.5)), [[0.5, 0.5, 0.5]])
    np.testing.assert_array_equal(intervals(np.array([[7.0]])), [[7.0, 7.0, 7.0]])


def test_intervals_do_not_depend_on_the_block(monkeypatch):
    values = np.random.default_rng(0).random((2, 50))
    whole = intervals(values)
    monkeypatch.setattr("shepherd_phys.controllers.summary.BLOCK", 50 * 1000)
    np.testing.assert_array_equal(intervals(values), whole)


def test_a_summary_does_not_depend_on_the_order_of_rows():
    rng = np.random.default_rng(0)
    rows = rows_of("a", rng.random(30)) + rows_of("b", rng.random(30))
    shuffled = [rows[i] for i in rng.permutation(60)]

    def by_name(summary):
        return sorted(summary, key=lambda row: row["controller"])

    assert by_name(summarise(shuffled)) == by_name(summarise(rows))


def test_a_summary_by_hand():
    (point,) = summarise(rows_of("a", [True, False, True, True]), metrics=["success"])
    assert (point["controller"], point["trials"], point["success_mean"]) == ("a", 4, 0.75)
    assert 0.0 <= point["success_low"] <= 0.75 <= point["success_high"] <= 1.0
    assert summarise([]) == []
    assert summary_columns(["a"], ["m"]) == ("a", "trials", "m_mean", "m_low", "m_high")


def test_paired_differences_use_the_same_seeds_of_the_same_point():
    rng = np.random.default_rng(1)
    noise = 100 * rng.random(40)
    rows = rows_of("base", noise[:30]) + rows_of("better", noise[10:40] + 1.0, first_seed=10)
    rows += rows_of("base", noise, n_flocks=2) + rows_of("alone", noise, n_flocks=3)
    (found,) = paired_differences(rows, "base")
    assert (found["controller"], found["baseline"], found["n_flocks"], found["trials"]) == ("better", "base", 1, 20)
    # unpaired, the noise would drown it
    for part in ("mean", "low", "high"):
        assert found[f"path_length_diff_{part}"] == pytest.approx(1.0)


def test_a_baseline_that_is_not_there():
    with pytest.raises(ValueError, match="no row has the controller 'nobody'"):
        paired_differences(rows_of("a", [1.0]), "nobody")
