"""Bodies: what each does with a wanted velocity, worked by hand; limits, contacts, lidar, teams and flocks of many."""

import math

import numpy as np
import pymunk
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from shepherd_phys.bodies import (
    BODIES,
    SHEEP,
    Body,
    DifferentialDrive,
    Disc,
    Flyer,
    PolygonRobot,
    Unicycle,
    built,
    flies,
)
from shepherd_phys.lidar import CHANNELS, Lidar
from shepherd_phys.obstacles import Pillar, Polygon, Wall
from shepherd_phys.scenario import Scenario, load_scenario
from shepherd_phys.scripts.impacts import impacts
from shepherd_phys.settings import SettingsError
from shepherd_phys.world import World

TEAM = (Disc(), DifferentialDrive(), Unicycle(), PolygonRobot(), Flyer())
DRIVEN = (DifferentialDrive(), Unicycle())
ALL = Lidar(channels=CHANNELS)
NO_GOAL = {"goal_pos": (500.0, 0.0)}


class Still:
    """Sheep that stay where they are."""

    def velocities(self, state, rng):
        return np.zeros((state.n_sheep, 2))


def follow(body, wanted, *, angle=0.0, velocity=(0.0, 0.0), spin=0.0, dt=0.1):
    (x, y), turn = body.follow(np.array([3.0, 4.0, angle, *velocity, spin]), np.array(wanted, float), dt)
    return [x, y, turn]


def placed(shepherds, at, sheep=((400.0, 0.0),), angle=None, obstacles=(), bodies=SHEEP):
    """A world with shepherds, sheep and obstacles in given places, and its state."""
    scenario = Scenario(
        n_sheep=len(sheep), n_flocks=1, shepherds=shepherds, flock=Still(), obstacles=obstacles, sheep=bodies, **NO_GOAL
    )
    world = World(scenario)
    turned = {} if angle is None else {"shepherd_angle": angle}
    return world, world.reset_to(world.reset(0).but(shepherd_pos=at, sheep_pos=sheep, **turned), 0)


# ------------------------------------------------------------- differential drive


def test_a_differential_drive_straight_ahead_does_what_is_wanted():
    assert follow(DifferentialDrive(), (1.2, 0.0)) == pytest.approx([1.2, 0.0, 0.0])


def test_it_turns_first_and_drives_with_what_is_left_of_its_wheels():
    # e = 0.5, k e = 2 rad/s, which is below omega_max; v = min(1.5 cos 0.5 = 1.316, 1.5 - 2 * 0.4 / 2 = 1.1)
    assert follow(DifferentialDrive(), (1.5 * math.cos(0.5), 1.5 * math.sin(0.5))) == pytest.approx([1.1, 0.0, 2.0])
    # to the side: cos e = 0, it turns on the spot at omega_max
    assert follow(DifferentialDrive(), (0.0, -1.0)) == pytest.approx([0.0, 0.0, -3.0])
    # behind it: it turns about and does not drive backwards
    assert follow(DifferentialDrive(), (-1.0, 1e-9)) == pytest.approx([0.0, 0.0, 3.0])


def test_wheels_bound_the_turn_on_the_spot():
    slow = DifferentialDrive(max_speed=0.3, track=0.6, max_turn=10.0)
    assert follow(slow, (0.0, 0.3)) == pytest.approx([0.0, 0.0, 1.0])  # 2 v_max / b


def test_a_small_turn_is_made_within_a_substep_and_not_overshot():
    assert follow(DifferentialDrive(turn_gain=100.0), (1.0, 0.1))[2] == pytest.approx(math.atan(0.1) / 0.1)


def test_nothing_wanted_is_no_turn():
    for body in (*DRIVEN, PolygonRobot()):
        assert follow(body, (0.0, 0.0), angle=2.0) == pytest.approx([0.0, 0.0, 0.0])


def test_an_answer_is_for_the_end_of_the_substep():
    # the engine turns it by 2 * 0.1 first: then its nose is at 0.3
    x, y, _ = follow(DifferentialDrive(), (math.cos(0.3), math.sin(0.3)), angle=0.1, spin=2.0)
    assert (x, y) == pytest.approx((math.cos(0.3), math.sin(0.3)))


# ------------------------------------------------------------------------ unicycle


def test_a_unicycle_gains_speed_by_its_acceleration_and_no_faster():
    body = Unicycle(max_acceleration=2.0)
    assert follow(body, (1.5, 0.0)) == pytest.approx([0.2, 0.0, 0.0])
    assert follow(body, (1.5, 0.0), velocity=(1.4, 0.0)) == pytest.approx([1.5, 0.0, 0.0])
    assert follow(body, (0.0, 0.0), velocity=(1.0, 0.0)) == pytest.approx([0.8, 0.0, 0.0])
    assert follow(body, (-1.0, 0.0), velocity=(0.1, 0.0))[:2] == pytest.approx([0.0, 0.0])  # brakes, does not reverse


def test_a_unicycle_gains_spin_by_its_angular_acceleration_and_no_faster():
    body = Unicycle(max_turn_acceleration=12.0, max_turn=3.0)
    assert follow(body, (0.0, 1.0))[2] == pytest.approx(1.2)
    assert follow(body, (0.0, 1.0), angle=-0.6, spin=2.5)[2] == pytest.approx(3.0)
    # e = -0.3 at the end of the substep: k e = -0.9, from a spin of 1 down by 1.2 at most
    assert follow(body, (1.0, 0.0), angle=0.2, spin=1.0)[2] == pytest.approx(-0.2)


def test_what_pushes_a_unicycle_aside_is_lost():
    assert follow(Unicycle(), (1.0, 0.0), velocity=(1.0, 0.7)) == pytest.approx([1.0, 0.0, 0.0])


@pytest.mark.parametrize("off", [0.3, 1.0, 2.0, 3.0, -2.5])
def test_a_unicycle_comes_to_its_heading_and_stays(off):
    world, _ = placed((Unicycle(),), [[0.0, 0.0]])
    angles = [world.step([[math.cos(off), math.sin(off)]]).shepherd_angle[0] for _ in range(25)]
    assert max(np.abs(angles)) <= abs(off) + 0.05  # hardly overshoots
    assert angles[-5:] == pytest.approx([off] * 5, abs=0.02)


# ---------------------------------------------------------------- polygon, flyer


def test_a_polygon_robot_moves_as_wanted_and_turns_its_nose():
    assert follow(PolygonRobot(), (0.3, 0.4)) == pytest.approx([0.3, 0.4, 3.0])
    assert follow(PolygonRobot(), (1.0, 0.0), angle=0.1) == pytest.approx([1.0, 0.0, -0.4])


def test_a_polygon_is_moved_to_its_centroid():
    body, (shape,), reach = built(PolygonRobot(vertices=((10, 10), (13, 10), (10, 13))), "it")
    assert np.array(sorted(shape.get_vertices())) == pytest.approx(np.array([(-1, -1), (-1, 2), (2, -1)]))
    assert reach == pytest.approx(math.sqrt(5))
    assert body.moment == pytest.approx(pymunk.moment_for_poly(5.0, [(-1, -1), (2, -1), (-1, 2)]))
    assert body.center_of_gravity == (0, 0)


@pytest.mark.parametrize(
    ("vertices", "message"),
    [
        (((0, 0), (1, 0)), "at least 3"),
        (((0, 0), (1, 0), (2, 0)), "convex"),
        (((0, 0), (4, 0), (1, 1), (0, 4)), "convex"),
        (((0, 0), (4, 0), (4, 0.05), (0, 0.05)), "0.05 m thick"),
        (((0, 0), (math.inf, 0), (0, 1)), "finite"),
    ],
)
def test_impossible_polygons_are_refused(vertices, message):
    with pytest.raises(SettingsError, match=rf"PolygonRobot.*vertices.*{message}"):
        PolygonRobot(vertices=vertices)


def test_a_flyer_changes_its_velocity_by_its_acceleration_in_any_direction():
    body = Flyer(max_acceleration=4.0)
    assert follow(body, (0.0, 1.5)) == pytest.approx([0.0, 0.4, 0.0])
    assert follow(body, (0.0, 0.0), velocity=(0.6, 0.8)) == pytest.approx([0.36, 0.48, 0.0])
    assert follow(body, (0.1, 0.2), velocity=(0.0, 0.0)) == pytest.approx([0.1, 0.2, 0.0])


def test_a_flyer_goes_over_everything_and_is_no_collision():
    things = (Wall((2, -5), (2, 5)), Pillar((4, 0), 0.5))
    world, _ = placed((Flyer(), Disc(), Flyer()), [[0, 0], [6, 0], [8, 0]], sheep=[[1.0, 0.0]], obstacles=things)
    for _ in range(25):
        state = world.step([[1, 0], [0, 0], [-1, 0]])
    assert state.shepherd_pos[0] == pytest.approx([0.0 + 25 * 0.3, 0.0], abs=0.4)
    assert state.shepherd_pos[2, 0] < 1.0
    assert state.shepherd_pos[1] == pytest.approx([6, 0], abs=1e-9)
    assert state.sheep_pos[0] == pytest.approx([1, 0], abs=1e-9)
    assert state.collisions == 0


@pytest.mark.parametrize("engine", ["kernel", "pymunk"])
def test_a_flyer_is_seen_and_does_not_see_what_it_is_above(engine):
    lidar = ALL.but(engine=engine, beams=8)
    world, _ = placed(
        (Flyer(), Disc()),
        [[0, 0], [5, 0]],
        sheep=[[0.1, 0.0], [0.0, 3.0]],
        obstacles=(Polygon(((-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5))), Wall((-4, -2), (-4, 2))),
    )
    scan = world.scan(lidar, ("wild",))
    assert scan["shepherds"][1, 4] == pytest.approx(math.inf)  # the box below the flyer hides it from the ground
    assert scan["shepherds"][0, 0] == pytest.approx(4.75)
    for name in ("sheep", "wild"):
        assert scan[name][0] == pytest.approx([math.inf] * 2 + [2.85] + [math.inf] * 5)
    assert scan["obstacles"][0, [0, 4]] == pytest.approx([math.inf, 3.95])
    world, _ = placed((Flyer(), Disc()), [[0, 0], [5, 0]])
    assert world.scan(lidar)["shepherds"][:, [0, 4]] == pytest.approx(np.array([[4.75, np.inf], [np.inf, 4.75]]))
    world, _ = placed((Flyer(), Disc(), Flyer()), [[0, 0], [0.1, 0], [0.2, 0]])
    assert np.isinf(world.scan(lidar)["shepherds"][[0, 2]]).all()  # above another, of either kind
    assert (world.scan(lidar)["shepherds"][1] == 0.0).all()  # below one: inside a solid


def test_sheep_fear_a_flyer():
    scenario = Scenario(n_sheep=1, n_flocks=1, shepherds=(Flyer(),), **NO_GOAL)
    world = World(scenario.but(flock=scenario.flock.but(noise=0.0, inertia=0.0)))
    world.reset_to(world.reset(0).but(shepherd_pos=[[0, 0]], sheep_pos=[[3, 0]]), 0)
    assert world.step([[0, 0]]).sheep_vel[0] == pytest.approx([1.0, 0.0])


# ---------------------------------------------------------------------- every body


def test_the_bodies_have_names_and_are_bodies():
    assert list(BODIES) == ["Disc", "DifferentialDrive", "Unicycle", "PolygonRobot", "Flyer"]
    for kind in BODIES.values():
        assert isinstance(kind(), Body)
    assert [flies(body) for body in TEAM] == [False] * 4 + [True]


@settings(max_examples=150, deadline=None)
@given(
    kind=st.sampled_from([b for b in TEAM if not isinstance(b, Disc)]),
    wanted=st.tuples(st.floats(-1.06, 1.06), st.floats(-1.06, 1.06)),
    angle=st.floats(-50, 50),
    velocity=st.tuples(st.floats(-3, 3), st.floats(-3, 3)),
    spin=st.floats(-20, 20),
    dt=st.floats(0.001, 0.5),
)
def test_answers_are_finite_and_within_the_limits(kind, wanted, angle, velocity, spin, dt):
    x, y, turn = follow(kind, wanted, angle=angle, velocity=velocity, spin=spin, dt=dt)
    assert all(map(math.isfinite, (x, y, turn)))
    if isinstance(kind, DifferentialDrive):
        assert math.hypot(x, y) + abs(turn) * kind.track / 2 <= kind.max_speed + 1e-9
    if kind in DRIVEN:
        nose = angle + spin * dt
        assert x * math.sin(nose) - y * math.cos(nose) == pytest.approx(0.0, abs=1e-9)  # no sideways motion
    if isinstance(kind, Unicycle):
        along = velocity[0] * math.cos(nose) + velocity[1] * math.sin(nose)
        assert abs(x * math.cos(nose) + y * math.sin(nose) - along) <= kind.max_acceleration * dt + 1e-9
        assert abs(turn - spin) <= max(kind.max_turn_acceleration * dt, abs(spin) - kind.max_turn) + 1e-9
    if isinstance(kind, Flyer):
        assert math.dist((x, y), velocity) <= kind.max_acceleration * dt + 1e-9
    else:
        assert abs(turn) <= kind.max_turn + 1e-9


@pytest.mark.parametrize("body", TEAM, ids=lambda body: type(body).__name__)
def test_every_body_gets_where_it_is_sent(body):
    world, state = placed((body,), [[0.0, 0.0]])
    target = np.array([-3.0, 4.0])
    for _ in range(60):
        way = target - state.shepherd_pos[0]
        state = world.step([way / max(1.0, float(np.linalg.norm(way)))])
    assert state.shepherd_pos[0] == pytest.approx(target, abs=0.1)


@pytest.mark.parametrize("body", DRIVEN, ids=lambda body: type(body).__name__)
def test_a_driven_body_in_the_world_moves_along_its_nose_and_turns_no_faster_than_it_can(body):
    world, state = placed((body,), [[0.0, 0.0]], angle=[1.0])
    rng = np.random.default_rng(1)
    for _ in range(60):
        before, state = state, world.step(rng.uniform(-1, 1, (1, 2)))
        angle, (x, y) = state.shepherd_angle[0], state.shepherd_vel[0]
        assert x * math.sin(angle) - y * math.cos(angle) == pytest.approx(0.0, abs=1e-9)
        assert abs(angle - before.shepherd_angle[0]) <= body.max_turn * 0.2 + 1e-9
        assert math.hypot(x, y) <= body.max_speed + 1e-9


@pytest.mark.parametrize("body", TEAM[:-1], ids=lambda body: type(body).__name__)
def test_walls_stop_every_body_that_walks_and_it_rests_within_a_centimetre(body):
    pillars = Pillar((-2.5, 0.4), 0.4), Pillar((-2.5, -0.4), 0.4)
    world, _ = placed((body,), [[0.0, 0.0]], obstacles=(Wall((2, -5), (2, 5)), *pillars))
    for target in ([9.0, 0.0], [-2.5, 0.0]):  # the wall, then where the pillars touch
        for _ in range(40):
            way = target - world.state.shepherd_pos
            world.step(way / np.linalg.norm(way))
        (own,) = (b for b in world.space.bodies if b.mass == body.mass)
        met = [hit.contact_point_set.points for shape in own.shapes for hit in world.space.shape_query(shape)]
        assert 0.0 < max(abs(point.distance) for points in met for point in points) < 0.01
        assert 1.4 < abs(world.state.shepherd_pos[0, 0]) < 2.4
    assert world.state.collisions >= 3


# ------------------------------------------------------------------------- lidar


@pytest.mark.parametrize("seed", range(6))
def test_both_engines_see_a_mixed_team_of_turning_bodies_alike(seed):
    world = World(
        Scenario(
            n_sheep=25, n_flocks=1, shepherds=(*TEAM, PolygonRobot(vertices=((0.9, 0), (-0.5, 0.6), (-0.5, -0.6)))),
            flock_distance=(3.0, 3.0), box=8.0, sheep=(SHEEP, PolygonRobot(mass=2.0), Flyer()),
            obstacles=(Wall((-30, 6), (30, 6)),) if seed % 2 else (),
        )
    )  # fmt: skip
    state = world.reset(seed)
    rng = np.random.default_rng(seed)
    for _ in range(12):
        state = world.step(rng.uniform(-1, 1, (6, 2)))
        kernel, queries = (world.scan(ALL.but(engine=e), ("wild",)).ranges for e in ("kernel", "pymunk"))
        assert (np.isfinite(kernel) == np.isfinite(queries)).all()
        seen = np.isfinite(kernel)
        assert np.abs(kernel[seen] - queries[seen]).max() <= 1e-9
    assert (state.shepherd_angle[[1, 2, 3, 5]] != 0.0).all()
    assert world.scan(ALL).ranges[1].min() < 2.0
    assert world.scan(ALL).ranges.tobytes() == world.scan(ALL.but(engine="kernel")).ranges.tobytes()


# ------------------------------------------------------------------------ sheep


RAM, LAMB = Disc(radius=0.2, mass=3.0, max_speed=0.9), Disc(radius=0.12, mass=0.6, max_speed=0.6)


def test_sheep_have_their_bodies_in_turn():
    world = World(Scenario(n_sheep=5, n_flocks=1, sheep=(RAM, SHEEP, LAMB)))
    state = world.reset(0)
    assert state.sheep_radius.tolist() == [0.2, 0.15, 0.12, 0.2, 0.15]
    assert state.sheep_max_speed.tolist() == [0.9, 1.0, 0.6, 0.9, 1.0]
    assert [body.mass for body in world.space.bodies][:5] == [3.0, 1.0, 0.6, 3.0, 1.0]
    assert not world._followers  # discs of whatever size stay in the compiled path
    gaps = np.linalg.norm(state.sheep_pos[:, None] - state.sheep_pos[None], axis=2) + 9 * np.eye(5)
    assert (gaps >= state.sheep_radius[:, None] + state.sheep_radius[None]).all()


def test_each_sheep_moves_at_its_own_speed_and_a_ram_pushes_a_lamb():
    world = World(Scenario(n_sheep=3, n_flocks=1, shepherds=1, sheep=(RAM, SHEEP, LAMB), **NO_GOAL))
    state = world.reset_to(world.reset(0).but(sheep_pos=[[3, 0], [0, 3], [-3, 0]], shepherd_pos=[[0, 0]]), 0)
    state = world.step([[0, 0]])
    assert np.linalg.norm(state.sheep_vel, axis=1) == pytest.approx([0.9, 1.0, 0.6])

    class Meet:
        def velocities(self, state, rng):
            return state.sheep_max_speed[:, None] * [[1.0, 0.0], [-1.0, 0.0]]

    world = World(Scenario(n_sheep=2, n_flocks=1, shepherds=0, sheep=(RAM, LAMB), flock=Meet(), **NO_GOAL))
    state = world.reset_to(world.reset(0).but(sheep_pos=[[0, 0], [1, 0]]), 0)
    for _ in range(25):
        state = world.step(np.zeros((0, 2)))
    assert state.sheep_pos[1, 0] > 1.2


def test_one_body_and_a_tuple_of_it_are_the_same_to_the_bit():
    one = Scenario(n_sheep=30, n_flocks=2)
    states = []
    for scenario in (one, one.but(sheep=(SHEEP, SHEEP))):
        world = World(scenario)
        world.reset(3)
        for _ in range(20):
            state = world.step(np.full((3, 2), 0.4))
        states.append(state.sheep_pos.tobytes())
    assert states[0] == states[1]


def test_bodies_survive_a_file(tmp_path):
    scenario = Scenario(shepherds=TEAM, sheep=(RAM, PolygonRobot(), Flyer(radius=0.1)))
    scenario.to_toml(tmp_path / "team.toml")
    assert load_scenario(tmp_path / "team.toml") == scenario
    assert "flies" not in scenario.to_dict()["sheep"][2]


@pytest.mark.parametrize("sheep", [(), [], [{"kind": "Wolf"}]])
def test_no_sheep_bodies_or_unknown_ones_are_named(sheep):
    with pytest.raises(SettingsError, match=r"Scenario.sheep"):
        Scenario.from_dict({"sheep": sheep})


def test_a_broken_sheep_among_several_is_named():
    with pytest.raises(SettingsError, match=r"sheep \(.*object\): a body needs 'build'"):
        World(Scenario(n_sheep=3, n_flocks=1, sheep=(SHEEP, object()))).reset(0)


# ---------------------------------------------------------------------- impacts


@pytest.mark.parametrize("body", TEAM[1:-1], ids=lambda body: type(body).__name__)
def test_no_body_gets_through_a_thin_wall_or_a_small_pillar(body):
    result = impacts(120, seed=2, shepherd=body)
    assert result["touched"] >= 0.95 * result["impacts"]
    assert result["tunnelled"] == 0
    assert result["deepest_overlap_at_rest_m"] < 0.01


@pytest.mark.parametrize("hard", [Disc(mass=20.0), Disc(max_speed=3.0)], ids=("heavy", "fast"))
def test_nor_does_one_that_a_heavier_or_faster_shepherd_presses(hard):
    assert impacts(1200, seed=4, shepherd=hard)["tunnelled"] == 0
    assert impacts(1200, seed=4, shepherd=hard, substeps=3)["tunnelled"] > 0


@pytest.mark.slow
@pytest.mark.parametrize(
    "kinds",
    [*({"shepherd": body} for body in TEAM[:-1]), {"sheep": RAM}, {"sheep": LAMB}],
    ids=lambda kinds: "-".join(str(getattr(value, "mass", value)) + who for who, value in kinds.items()),
)
def test_none_of_20000_impacts_gets_through(kinds):
    result = impacts(20_000, seed=3, **kinds)
    assert result["impacts"] >= 20_000
    assert result["touched"] >= 0.95 * result["impacts"]
    assert result["tunnelled"] == 0
    assert result["deepest_overlap_at_rest_m"] < 0.01
