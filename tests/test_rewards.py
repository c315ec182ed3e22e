"""Reward terms by hand, and against a naive reference on random scenes."""

import functools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from shepherd_phys.envs import ANY, ORIGINAL, SCHEMES, WILD, ShepherdingEnv
from shepherd_phys.envs.rewards import Distance, Effort, Gathered, Occlusion, Occupancy
from shepherd_phys.flock import Strombom
from shepherd_phys.lidar import Lidar
from shepherd_phys.scenario import Scenario
from shepherd_phys.settings import SettingsError
from shepherd_phys.state import WorldState
from shepherd_phys.world import World

FOUR = Scenario(n_sheep=4, n_flocks=1, shepherds=2, goal_pos=(0.0, 0.0), n_steps=10, flock=Strombom())


def arranged(scenario, sheep, shepherds, arrived=None):
    """A world with everybody in given places."""
    world = World(scenario)
    n = scenario.n_sheep
    state = world.reset(0).but(
        sheep_pos=sheep, shepherd_pos=shepherds, sheep_arrived=np.zeros(n, bool) if arrived is None else arrived
    )
    return world, world.reset_to(state, 0)


def test_occupancy_by_hand():
    _, state = arranged(FOUR, [[0, 0], [2.5, 0], [2.6, 0], [9, 0]], [[20, 0], [-20, 0]])
    assert Occupancy()(state, state, None, FOUR) == 2 / (4 * 10)  # the border belongs to the goal


def test_gathered_pays_once_nearly_all_are_in():
    _, three = arranged(FOUR, [[0, 0], [2.5, 0], [0, 1], [9, 0]], [[20, 0], [-20, 0]])
    _, all_in = arranged(FOUR, [[0, 0], [2.5, 0], [0, 1], [0, 2]], [[20, 0], [-20, 0]])
    assert [Gathered()(state, state, None, FOUR) for state in (three, all_in)] == [0.0, 0.1]
    assert Gathered(fraction=0.75)(three, three, None, FOUR) == 0.1
    with pytest.raises(SettingsError, match=r"Gathered.fraction: .*less than or equal to 1 .*given: 1.5"):
        Gathered(fraction=1.5)


@pytest.mark.parametrize(("norm", "divisor"), [("NT", 40), ("T", 10), ("none", 1)])
def test_distance_by_hand(norm, divisor):
    _, state = arranged(FOUR, [[0, 0], [3.5, 0], [0, -4.5], [3, 4]], [[20, 0], [-20, 0]])
    # outside by 1, 2 and 2.5 m
    assert Distance(norm=norm)(state, state, None, FOUR) == pytest.approx((3 + 5.5) / divisor, rel=1e-15)


def test_effort_is_the_path_over_that_of_running_all_the_time():
    scenario = FOUR.but(n_steps=8)
    effort = Effort()
    env = ShepherdingEnv(scenario, rewards={"effort": (-2.0, effort)}, lidar=None)
    env.reset(seed=0)
    paid, own, done = 0.0, np.zeros(2), False
    while not done:  # one runs, the other strolls
        _, reward, _, done, info = env.step([[1.0, 0.0], [0.0, 0.25]])
        paid += reward
        own += [info["share/effort/0"], info["share/effort/1"]]
    furthest = 8 * 0.2 * 1.5
    assert own == pytest.approx(env.state.shepherd_path / furthest, rel=1e-12)
    assert paid == pytest.approx(-2.0 * info["path_length"] / furthest, rel=1e-12)
    assert 0.2 < own[1] < 0.3 < 0.9 < own[0] <= 1.0
    start = WorldState.of({**vars(env.state), "shepherd_path": np.zeros(2)})
    for team, price in ((1, 1.0), (2, 1.0), (3, 2 / 3), (8, 0.25)):  # two of them are a small team for the last two
        assert Effort(team=team).shares(start, env.state, None, scenario) == pytest.approx(price * own, rel=1e-12)
    nobody = WorldState.of({**vars(env.state), "shepherd_path": np.zeros(0), "shepherd_max_speed": np.zeros(0)})
    assert effort(nobody, nobody, None, scenario) == 0.0


def line_up(distance_to_sheep, goal_distance=8.0, **term):
    """Beams that count for one shepherd looking along +x at one sheep and then the goal."""
    scenario = Scenario(n_sheep=1, n_flocks=1, shepherds=1, goal_pos=(0.0, 0.0), n_steps=10)
    me = np.array([-2.5 - goal_distance, 0.0])
    world, state = arranged(scenario, [me + [distance_to_sheep + 0.15, 0]], [me])
    term = Occlusion(**term)
    names = tuple(name for name in term.scans if name in ("wild", "outside"))
    shares = term.shares(state, state, world.scan(Lidar(), names), scenario)
    assert term(state, state, world.scan(Lidar(), names), scenario) == shares.mean()
    return round(float(shares[0]) * 10)


def test_occlusion_counts_beams_at_a_useful_distance():
    # a disc of 0.15 m whose near side is 5 m away covers beams k with |sin(2 pi k / 512)| * 5.15 <= 0.15
    expected = 1 + 2 * math.floor(512 / (2 * math.pi) * math.asin(0.15 / 5.15))
    assert line_up(5.0) == expected == 5
    assert line_up(1.5) == 0  # nearer than alpha: in the flock
    assert line_up(1.5, alpha=1.0) > 0
    assert line_up(7.6) > 0  # any nearer to the goal and the sheep has arrived: no longer wild
    assert line_up(7.9) == 0 < line_up(7.9, sheep="any")
    assert line_up(11.0, goal_distance=20.0) == 0  # beyond the radius of influence
    assert line_up(11.0, goal_distance=20.0, influence=12.0) > 0
    assert line_up(9.0) == 0  # behind the near side of the goal


def test_occlusion_needs_goal_and_sheep_on_one_beam():
    scenario = Scenario(n_sheep=1, n_flocks=1, shepherds=1, goal_pos=(0.0, 0.0), n_steps=10)
    world, state = arranged(scenario, [[-10.0, 5.0]], [[-10.0, 0.0]])
    assert Occlusion(sheep="any")(state, state, world.scan(Lidar()), scenario) == 0


def test_wild_any_and_current_differ_as_they_should():
    """A delivered sheep must not hide a wild one; a sheep that left the goal is wild only in mode "current"."""
    scenario = Scenario(n_sheep=2, n_flocks=1, shepherds=1, goal_pos=(0.0, 0.0), n_steps=10)
    me = [-9.0, 0.0]
    # sheep 0 has been in the goal and stands outside now; sheep 1 is wild, on the same beams further away
    world, state = arranged(scenario, [[-6.0, 0.0], [-4.0, 0.0]], [me], arrived=[True, False])
    scan = world.scan(Lidar(), ("wild", "outside"))
    by = {
        "any": Occlusion(sheep="any"),
        "wild": Occlusion(sheep="wild"),
        "current": Occlusion(sheep="wild", wild_mode="current"),
    }
    count = {name: round(float(term.shares(state, state, scan, scenario)[0]) * 10) for name, term in by.items()}
    half_near = math.floor(512 / (2 * math.pi) * math.asin(0.15 / 3.0))
    half_far = math.floor(512 / (2 * math.pi) * math.asin(0.15 / 5.0))
    assert count == {"any": 1 + 2 * half_near, "wild": 1 + 2 * half_far, "current": 1 + 2 * half_near}
    # alone, and too near: the delivered one is no reward for "wild"
    world, state = arranged(scenario, [[-6.0, 0.0], [30.0, 0.0]], [me], arrived=[True, False])
    scan = world.scan(Lidar(), ("wild", "outside"))
    assert by["wild"](state, state, scan, scenario) == 0 < by["any"](state, state, scan, scenario)


def naive(scheme, state, scan, scenario):
    """The rewards written out with loops."""
    n, t = scenario.n_sheep, scenario.n_steps
    total = 0.0
    for i in range(n):
        away = math.dist(state.sheep_pos[i], state.goal_pos)
        if away <= scenario.goal_radius:
            total += 10.0 / (n * t)
        else:
            total -= 0.1 * (1 + away - scenario.goal_radius) / (n * t)
    if scheme == "original":
        return total
    sheep = scan["sheep" if scheme == "any" else "wild"]
    beams = 0
    for p in range(scenario.n_shepherds):
        for b in range(512):
            d, g = sheep[p, b], scan["goal"][p, b]
            if g < math.inf and d < math.inf and 2.0 <= d <= min(g, 10.0):
                beams += 1
    return total + 0.1 * beams / (scenario.n_shepherds * t)


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32), st.sampled_from(["original", "any", "wild"]), st.integers(1, 4))
def test_env_rewards_against_naive_reference(seed, scheme, n_shepherds):
    rng = np.random.default_rng(seed)
    scenario = Scenario(n_sheep=30, n_flocks=1, shepherds=n_shepherds, n_steps=50)
    env = ShepherdingEnv(scenario, rewards=scheme)
    env.reset(seed=seed)
    place = env.state.goal_pos + rng.normal(0, 4, (30, 2))
    state = env.state.but(sheep_pos=place, sheep_arrived=rng.random(30) < 0.4)
    env.world.reset_to(state.but(shepherd_pos=state.goal_pos + rng.normal(0, 8, (n_shepherds, 2))), seed)
    _, reward, _, _, info = env.step(rng.uniform(-1, 1, (n_shepherds, 2)))
    scan = env.world.scan(Lidar(), ("wild",))
    assert reward == pytest.approx(naive(scheme, env.state, scan, scenario), rel=1e-12, abs=1e-15)
    named = {name: value for name, value in info.items() if name.startswith("reward/")}
    assert set(named) == {f"reward/{name}" for name in SCHEMES[scheme]}
    assert sum(named.values()) == pytest.approx(reward, rel=1e-12, abs=1e-15)
    shares = [value for name, value in info.items() if name.startswith("share/occlude/")]
    if scheme != "original":
        assert len(shares) == n_shepherds
        assert 0.1 * np.mean(shares) == pytest.approx(info["reward/occlude"], rel=1e-12, abs=1e-15)


def test_the_extra_scan_is_made_only_where_a_term_asks_for_it():
    for rewards, sets in [(ORIGINAL, ()), (ANY, ()), (WILD, ("wild",))]:
        env = ShepherdingEnv("small", rewards=rewards)
        env.reset(seed=0)
        env.step(np.zeros((2, 2)))
        assert set(env.scan.names) == {"sheep", "shepherds", "goal", *sets}


def test_users_add_terms():
    def calm(before, after, scan, scenario):
        return float(np.linalg.norm(after.sheep_vel, axis=1).mean())

    class Near:
        scans = ("sheep",)

        def shares(self, before, after, scan, scenario):
            return np.isfinite(scan["sheep"]).mean(axis=1)

        def __call__(self, before, after, scan, scenario):
            return float(self.shares(before, after, scan, scenario).mean())

    env = ShepherdingEnv("small", rewards={**WILD, "calm": (-0.05, calm), "near": (2.0, Near())}, lidar=None)
    _, first = env.reset(seed=1)
    _, reward, _, _, info = env.step(np.ones((2, 2)))
    assert set(first) == set(info)
    assert info["reward/calm"] == pytest.approx(-0.05 * np.linalg.norm(env.state.sheep_vel, axis=1).mean())
    assert info["reward/near"] == pytest.approx(2.0 * (info["share/near/0"] + info["share/near/1"]) / 2)
    assert reward == pytest.approx(sum(v for k, v in info.items() if k.startswith("reward/")))


@pytest.mark.parametrize(
    ("rewards", "message"),
    [
        ("wool", "rewards: 'wool' is not one of original, any, wild"),
        ({"a": 3}, r"rewards\['a'\]: needs a number and a term, \(weight, term\) \(given: 3\)"),
        ({"a": ("x", Occupancy())}, r"rewards\['a'\]: needs a number and a term"),
        ({"a": (10**400, Occupancy())}, r"rewards\['a'\]: needs a number and a term"),
        ({"a": (1.0, Occupancy)}, r"rewards\['a'\]: a class was given; make one of it: Occupancy\(\)"),
        (
            {"a": (1.0, lambda before, after: 0.0)},
            r"rewards\['a'\]: is called with \(before, after, scan, scenario\); this one takes \(before, after\)",
        ),
        ({"a": (math.nan, Occupancy())}, r"rewards\['a'\]: needs a finite weight"),
        ({"a": (1.0, 7)}, r"rewards\['a'\]: needs a finite weight and a callable term"),
        (5, "needs a scheme's name or a mapping"),
    ],
)
def test_bad_schemes(rewards, message):
    with pytest.raises(SettingsError, match=message):
        ShepherdingEnv("small", rewards=rewards)


def test_a_term_under_a_wrapper_takes_what_the_wrapper_takes():
    def inner(before, after, scan, scenario, weight):
        return weight

    @functools.wraps(inner)
    def wrapped(*given):
        return inner(*given, 0.5)

    env = ShepherdingEnv("small", rewards={"a": (2.0, wrapped)}, lidar=None)
    env.reset(seed=1)
    assert env.step(np.zeros((2, 2)))[1] == 1.0
    with pytest.raises(SettingsError, match=r"is called with \(before, after, scan, scenario\)"):
        ShepherdingEnv("small", rewards={"a": (2.0, inner)})


def test_a_term_that_wants_an_unknown_scan_is_named():
    class Odd:
        scans = ("wolves",)

        def __call__(self, before, after, scan, scenario):
            return 0.0

    with pytest.raises(SettingsError, match="rewards: there is no scan 'wolves'"):
        ShepherdingEnv("small", rewards={"odd": (1.0, Odd())})
