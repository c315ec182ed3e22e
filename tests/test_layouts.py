"""Layouts: presets in numbers, keep-outs, no pockets, streams of their own, a user's own, and impossible ones."""

import itertools
import math
from functools import partial

import numpy as np
import pymunk
import pytest
from scipy import ndimage

from shepherd_phys.avoidance import Avoidance
from shepherd_phys.controllers import CONTROLLERS, load_policy
from shepherd_phys.controllers.evaluation import evaluate, trial_seed
from shepherd_phys.controllers.network import SectorNetwork
from shepherd_phys.controllers.policy_files import Acting, PolicySpec, write_policy
from shepherd_phys.envs import ShepherdingEnv
from shepherd_phys.envs.mixture import Mixture
from shepherd_phys.geometry import surfaces
from shepherd_phys.layouts import Fenced, Lattice, Scattered, Site, _gap
from shepherd_phys.lidar import CHANNELS, Lidar
from shepherd_phys.obstacles import Box, Fence, Pillar, Polygon, Wall
from shepherd_phys.placement import PlacementError
from shepherd_phys.scenario import SCENARIOS, Scenario
from shepherd_phys.scripts.points import episode, find_scenario, points
from shepherd_phys.settings import SettingsError
from shepherd_phys.world import World

TUNED = ("strombom", "pierson", "elfiqi", "occlusion")
ALL = ("Pillar", "Wall", "Box", "Polygon")
LAID_OUT = {name: SCENARIOS[name] for name in ("fence", "corridor", "lattice", "scattered")} | {
    "mixed": Scenario(layout=Scattered(density=0.03, kinds=ALL)),
    "dense": Scenario(n_sheep=20, layout=Scattered(density=0.15)),
}
every = pytest.mark.parametrize("scenario", LAID_OUT.values(), ids=LAID_OUT)


@every
def test_goal_and_bodies_start_clear(scenario):
    world = World(scenario)
    for seed in range(5):
        state = world.reset(seed)
        gaps = state.surroundings.static_distances(state.goal_pos[None])[0]
        assert gaps.min() >= state.goal_radius + 2.0 - 1e-3
        pos = np.concatenate([state.sheep_pos, state.shepherd_pos])
        radius = np.concatenate([state.sheep_radius, state.shepherd_radius])
        assert (state.surroundings.static_distances(pos)[0].min(axis=1) >= radius + 0.5 - 1e-9).all()
        apart = np.linalg.norm(pos[:, None] - pos[None], axis=2) - radius[:, None] - radius[None]
        np.fill_diagonal(apart, 1.0)
        assert apart.min() >= -1e-12


@every
@pytest.mark.parametrize("radius", [0.15, 0.25])
def test_every_free_place_can_be_reached(scenario, radius):
    """By a flood on a grid of 0.1 m; specks of it in a neck that is narrower than a cell are no pockets."""
    state = World(scenario).reset(1)
    line = np.arange(-30, 30, 0.1)
    points = np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)
    free = (state.surroundings.static_distances(points)[0].min(axis=1) > radius).reshape(len(line), len(line))
    label, _ = ndimage.label(free, structure=np.ones((3, 3)))
    sizes = np.bincount(label[free])
    assert (sizes > 5).sum() == 1
    assert sizes.max() > 0.99 * free.sum()


@every
def test_an_episode_is_drawn_again_from_its_seed_and_each_is_another(scenario):
    world = World(scenario)
    first, other, again = (world.reset(seed) for seed in (3, 4, 3))
    assert first.obstacles == again.obstacles
    assert np.array_equal(first.sheep_pos, again.sheep_pos)
    assert first.obstacles != other.obstacles


def test_obstacles_have_a_stream_of_their_own():
    """Where obstacles yield, bodies start where they start without any; noise and users' numbers are the same, too."""
    bare, strewn = World(Scenario()), World(SCENARIOS["scattered"])
    for seed in range(3):
        a, b = bare.reset(seed), strewn.reset(seed)
        for name in ("goal_pos", "sheep_pos", "shepherd_pos", "sheep_heading"):
            assert np.array_equal(getattr(a, name), getattr(b, name))
        assert bare.user_rng.random() == strewn.user_rng.random()


@pytest.mark.parametrize("name", ["fence", "corridor"])
def test_flocks_are_behind_the_fence_and_before_the_corridor(name):
    world = World(SCENARIOS[name].but(n_flocks=4, flock_sd=0.4))
    for seed in range(8):
        state = world.reset(seed)
        middle = np.mean([(np.array(o.start) + o.end) / 2 for o in state.obstacles], axis=0) - state.goal_pos
        ahead = middle / np.linalg.norm(middle)
        for flock in np.split(state.sheep_pos, 4):
            centre = flock.mean(axis=0) - state.goal_pos
            away = np.linalg.norm(centre)
            assert 13.0 < away < 21.0
            assert np.arccos(centre @ ahead / away) < math.pi / 6 + 0.1


def test_the_fence_in_numbers():
    world, middles = World(SCENARIOS["fence"].but(n_sheep=4)), []
    for seed in range(40):
        state = world.reset(seed)
        (fence,) = state.obstacles
        start, end = np.array(fence.start), np.array(fence.end)
        assert np.linalg.norm(end - start) == pytest.approx(30.0)
        assert np.linalg.norm((start + end) / 2 - state.goal_pos) == pytest.approx(8.0)
        assert abs((end - start) @ ((start + end) / 2 - state.goal_pos)) < 1e-6
        assert (fence.gap, fence.thickness) == (8.0, 0.1)
        middles.append(fence.at - 15.0)
    assert -6.0 <= min(middles) < -4.0 < 4.0 < max(middles) <= 6.0  # the gap's edges stay within +-10 m


def test_the_corridor_in_numbers():
    state = World(SCENARIOS["corridor"].but(n_sheep=4)).reset(0)
    walls = state.obstacles
    assert [np.linalg.norm(np.subtract(w.end, w.start)) for w in walls] == pytest.approx([20.0, 20.0])
    assert np.linalg.norm(np.subtract(walls[0].start, walls[1].start)) == pytest.approx(10.0)
    for wall in walls:
        assert np.linalg.norm(np.array(wall.start) - state.goal_pos) == pytest.approx(math.hypot(4.0, 5.0))
        assert wall.thickness == 0.1


def test_the_lattice_in_numbers():
    state = World(SCENARIOS["lattice"]).reset(0)
    centers = np.array([pillar.center for pillar in state.obstacles])
    assert {pillar.radius for pillar in state.obstacles} == {0.5}
    apart = np.linalg.norm(centers[:, None] - centers[None], axis=2) + 99 * np.eye(len(centers))
    assert apart.min(axis=1) == pytest.approx(np.full(len(centers), 5.0))
    assert 80 <= len(centers) <= 100


@pytest.mark.parametrize("density", [0.0, 0.01, 0.05, 0.1])
def test_so_much_of_the_box_is_covered(density):
    state = World(Scenario(layout=Scattered(density=density))).reset(0)
    assert {pillar.radius for pillar in state.obstacles} <= {1.0}
    assert len(state.obstacles) == round(density * 2500 / math.pi)
    assert np.abs([pillar.center for pillar in state.obstacles] or [[0.0]]).max() <= 24.0


def test_so_many_of_every_kind():
    state = World(Scenario(layout=Scattered(count=30, kinds=ALL, radius=0.8))).reset(0)
    assert len(state.obstacles) == 30
    assert {type(o) for o in state.obstacles} == {Pillar, Wall, Box, Polygon}
    mixed = World(LAID_OUT["mixed"]).reset(0)
    assert 0.025 < sum(s.area for s in mixed_shapes(mixed)) / 2500 < 0.035


def mixed_shapes(state):
    body = pymunk.Body(body_type=pymunk.Body.STATIC)
    return [shape for obstacle in state.obstacles for shape in obstacle.shapes(body)]


def empty_site(**more):
    return Site(
        **{
            "box": 50.0, "goal_pos": np.array([20.0, 20.0]), "goal_radius": 2.5, "direction": None,
            "body_pos": np.array([[-20.0, -20.0]]), "body_radius": np.array([0.25]),
            "goal_keep_out": 2.0, "body_keep_out": 0.5, **more,
        }
    )  # fmt: skip


def test_a_site_refuses_what_would_close_a_pocket():
    site = empty_site()
    assert site.take(Wall((-3, -3), (3, -3)))
    assert site.take(Wall((-3, -2.2), (-3, 3)))  # nearer than 1 m: as good as joined
    assert site.take(Wall((3, -2.2), (3, 3)))
    assert not site.take(Wall((-2.2, 3), (2.2, 3)))  # the lid
    assert site.take(Wall((-1, 3), (1, 3)))  # with 2 m to either side nobody is locked in
    assert not site.take(Pillar((0.0, 3.0), 0.5))  # overlaps
    assert len(site.taken) == 4


@pytest.mark.parametrize("kinds", list(itertools.product(ALL, ALL)), ids="-".join)
def test_gaps_between_shapes_are_what_a_fine_search_finds(kinds):
    rng, body = np.random.default_rng(0), pymunk.Body(body_type=pymunk.Body.STATIC)
    around = np.column_stack([np.cos(np.arange(720) * math.pi / 360), np.sin(np.arange(720) * math.pi / 360)])
    for _ in range(12):
        a, b = (Scattered(count=1, kinds=(kind,))._made(kind, rng, 6.0) for kind in kinds)
        (one,), (other,) = a.shapes(body), b.shapes(body)
        one.cache_bb(), other.cache_bb()
        found = _gap(one, other)
        surface = np.array([one.point_query(tuple(p)).point for p in np.array(one.bb.center()) + 30 * around])
        line = np.concatenate([surface[:-1] + (surface[1:] - surface[:-1]) * s for s in (0.0, 0.25, 0.5, 0.75)])
        expected = min(other.point_query(tuple(p)).distance for p in line)
        assert (found < 0) == (expected < 0) or abs(found - expected) < 0.02
        if expected > 0:
            assert found == pytest.approx(expected, abs=0.02)


def test_fixed_obstacles_count_and_may_do_what_they_like():
    square = [(-3, -3), (3, -3), (3, 3), (-3, 3)]
    cage = tuple(Wall(a, b) for a, b in zip(square, square[1:] + square[:1], strict=True))
    site = empty_site(fixed=cage)
    assert not site.take(Pillar((3.0, 1.0), 0.5))
    assert site.take(Wall((3.5, 0), (9, 0)))  # near to one wall of the cage only
    assert not site.take(Wall((3.5, -3.2), (9, -1.0)))  # near to two that hang together
    assert site.take(Pillar((12.0, 0.0), 0.5))


def test_a_site_keeps_goal_and_bodies_clear_unless_bodies_yield():
    site = empty_site()
    assert not site.take(Pillar((20.0, 14.6), 1.0))
    assert site.take(Pillar((20.0, 14.4), 1.0))
    assert not site.take(Pillar((-20.0, -18.3), 1.0))
    assert site.take(Pillar((-20.0, -18.3), 1.0), bodies_yield=True)
    site.clear()
    assert site.taken == []


@pytest.mark.parametrize(
    ("layout", "message"),
    [
        (Scattered(density=0.45), r"Scattered.density: 0.45 is impossible: .* reached 0\.[0-3]\d*; at most about that"),
        (Scattered(count=2_000), r"Scattered.count: 2000 is impossible: .* reached \d\d?; at most about that"),
    ],
)
def test_more_than_there_is_room_for_is_one_clear_error(layout, message):
    with pytest.raises(PlacementError, match=message):
        World(SCENARIOS["small"].but(layout=layout, box=20.0)).reset(0)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Scattered(), "give count or density, one of the two"),
        (lambda: Scattered(count=3, density=0.1), "give count or density, one of the two"),
        (lambda: Scattered(density=0.7), r"Scattered.density: .*less than or equal to 0.5.*given: 0.7"),
        (lambda: Scattered(density=math.nan), "Scattered.density: .*finite"),
        (lambda: Scattered(count=-1), "Scattered.count: .*greater than or equal to 0"),
        (lambda: Scattered(count=1, kinds=("Moat",)), r"Scattered.kinds\[0\]: .*'Pillar'.*given: 'Moat'"),
        (lambda: Lattice(spacing=1.5), "spacing: 1.5 m leaves no way .* at least 2 m"),
        (lambda: Fenced(gap=25.0), "gap <= within < length"),
        (lambda: Fence((0, 0), (5, 0), gap=5.0), "something of the fence must be left on both sides"),
        (lambda: Fence((0, 0), (5, 0), gap=1.0, thickness=0.05), "Fence.thickness: .*0.1.*given: 0.05"),
        (lambda: Box((0, 0), (1.0, 0.05)), r"Box.size\[1\]: .*0.1.*given: 0.05"),
        (lambda: Scenario(layout=3), r"layout: needs a layout that can be called, or None \(given: 3\)"),
        (lambda: World(Scenario(layout=Scattered)), r"Scattered: a class was given; make one of it"),
        (
            lambda: World(Scenario(layout=lambda rng, site: 3)).reset(0),
            r"layout .*: needs to give obstacles \(given: 3",
        ),
        (lambda: World(Scenario(layout=lambda rng, site: [3])).reset(0), r"obstacles\[0\] .*int.*needs 'shapes'"),
        (
            lambda: World(Scenario(layout=on_goal)).reset(0),
            "an obstacle is -3.5 m from the goal's border; at least 2 m",
        ),
    ],
)
def test_mistakes_name_field_value_and_what_is_allowed(make, message):
    with pytest.raises(SettingsError, match=message):
        make()


def on_goal(rng, site):
    return [Pillar(tuple(site.goal_pos.tolist()), 1.0)]


def rubble(rng, site):
    """A layout of a user's own, as a function."""
    while len(site.taken) < 5:
        site.take(Box(tuple(rng.uniform(-20, 20, 2).tolist()), (2.0, 0.5), float(rng.uniform(0, 3))))
    return site.taken


def test_a_function_is_a_layout_and_survives_a_file(tmp_path):
    scenario = SCENARIOS["small"].but(layout=rubble, obstacles=(Pillar((0.0, 24.0), 0.5),))
    state = World(scenario).reset(0)
    assert [type(o) for o in state.obstacles] == [Pillar, Box, Box, Box, Box, Box]
    scenario.to_toml(tmp_path / "a.toml")
    assert Scenario.from_toml(tmp_path / "a.toml", classes=[rubble]) == scenario
    unknown = Scenario.from_toml(tmp_path / "a.toml")
    assert unknown.has_obstacles
    with pytest.raises(SettingsError, match="rubble' is a class of somebody's own and was not handed over"):
        World(unknown)


def test_layouts_survive_a_file(tmp_path):
    for scenario in LAID_OUT.values():
        scenario.to_toml(tmp_path / "a.toml")
        assert Scenario.from_toml(tmp_path / "a.toml") == scenario


def test_the_state_carries_the_episodes_obstacles_and_their_surfaces():
    world = World(SCENARIOS["scattered"])
    state = world.reset(0)
    after = world.step(np.zeros((3, 2)))
    assert after.surroundings is state.surroundings
    expected = surfaces(state.obstacles).static_distances(state.sheep_pos)[0]
    assert state.surroundings.static_distances(state.sheep_pos)[0] == pytest.approx(expected)
    bare = state.but(obstacles=())
    assert bare.surroundings.static_distances(state.sheep_pos)[0].shape == (100, 0)


def test_an_arrangement_brings_the_obstacles_that_were_drawn():
    world = World(SCENARIOS["scattered"])
    state = world.reset(0)
    world.reset(1)
    assert world.reset_to(state, 5).obstacles == state.obstacles


def test_channels_follow_the_scenario_and_not_the_draw():
    empty = Scenario(layout=Scattered(count=0))
    assert World(empty).reset(0).obstacles == ()
    assert ShepherdingEnv(empty).lidar.channels == CHANNELS
    assert ShepherdingEnv(Scenario()).lidar.channels == CHANNELS[:3]
    assert empty.n_substeps == 3
    observation, _ = ShepherdingEnv(empty).reset(seed=0)
    assert not observation[:, 3::4].any()
    assert Mixture(base=empty).channels == CHANNELS
    assert Mixture().channels == CHANNELS[:3]


@every
def test_both_engines_agree_in_drawn_worlds(scenario):
    world = World(scenario)
    for seed in range(2):
        world.reset(seed)
        for cuts in (True, False):
            kernel, queries = (
                world.scan(Lidar(channels=CHANNELS, engine=engine, obstacles_cut=cuts), ("wild",)).ranges
                for engine in ("kernel", "pymunk")
            )
            assert np.array_equal(np.isinf(kernel), np.isinf(queries))
            seen = np.isfinite(kernel)
            assert np.abs(kernel[seen] - queries[seen]).max() <= 1e-9


def test_avoidance_can_be_turned_off_in_a_preset():
    walled = Scenario(n_sheep=1, n_flocks=1, shepherds=1, obstacles=(Wall((5.0, -9.0), (5.0, 9.0)),))
    ways = []
    for weight in (1.5, 0.0):
        world = World(walled.but(flock=walled.flock.but(avoidance=Avoidance(weight=weight), noise=0.0)))
        start = world.reset(0).but(sheep_pos=[(4.5, 0.0)], shepherd_pos=[(4.5, -4.0)], sheep_heading=[(0.0, 1.0)])
        world.reset_to(start, seed=0)
        ways.append(world.step(np.zeros((1, 2))).sheep_vel[0])
    assert ways[0][0] < -0.1 and ways[1].tolist() == pytest.approx([0.0, 1.0])  # who feels no wall runs along it


def test_a_policy_that_knows_three_channels_runs_among_obstacles(tmp_path):
    lidar, network = Lidar(beams=64, sectors=16, frame="goal"), SectorNetwork(features=5, hidden=7, latent=6)
    rng = np.random.default_rng(0)
    weights = {name: rng.normal(0, 0.1, shape).astype(np.float32) for name, shape in network.shapes(lidar).items()}
    spec = PolicySpec(SCENARIOS["small"], lidar, network, Acting(frame="goal"), {"scheme": "wild"}, {"seed": 1})
    write_policy(tmp_path / "tiny.json", spec, weights)
    (row,) = evaluate(
        load_policy(tmp_path / "tiny.json"), partial(ShepherdingEnv, SCENARIOS["fence"].but(n_steps=5)), [0]
    )
    assert row["steps"] == 5


def test_a_scenario_of_a_users_own_is_found_by_name(tmp_path, monkeypatch):
    (tmp_path / "my_rocks.py").write_text(
        "from shepherd_phys.obstacles import Pillar\n"
        "from shepherd_phys.scenario import SCENARIOS\n"
        "def rocks(rng, site):\n    return [Pillar((25.0, 25.0), 0.5 + rng.random())]\n"
        "ROCKY = SCENARIOS['small'].but(layout=rocks, goal_pos=(0.0, 0.0))\n"
        "def make():\n    return ROCKY.but(n_steps=7)\n"
    )
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    assert find_scenario("my_rocks:make") == find_scenario("my_rocks:ROCKY").but(n_steps=7)
    (point,) = points(controllers=["idle"], scenario="my_rocks:make")
    assert point.scenario_name == "my_rocks:make"
    before = point.settings_hash()
    assert episode(point, 0)["steps"] == 7
    with open("my_rocks.py", "a") as file:
        file.write("# edited\n")
    assert point.settings_hash() != before  # a layout whose file was edited must not find the rows of the old one


@pytest.mark.slow
@pytest.mark.parametrize("preset", ["fence", "scattered"])
@pytest.mark.parametrize("name", TUNED)
def test_every_tuned_team_brings_the_flocks_home_among_drawn_obstacles(name, preset):
    seeds = [trial_seed(0, trial) for trial in range(3)]
    rows = evaluate(CONTROLLERS[name](), partial(ShepherdingEnv, SCENARIOS[preset]), seeds)
    assert np.mean([row["in_goal_end"] for row in rows]) > 90.0
