"""The world: servo, contacts, determinism, guards, counting; the contract of pymunk's batch API."""

import dataclasses
import gc
import hashlib
import math
import multiprocessing

import numpy as np
import pymunk
import pytest
from pymunk import batch

from shepherd_phys.bodies import SHEEP, DifferentialDrive, Disc, Flyer
from shepherd_phys.flock import Strombom
from shepherd_phys.obstacles import Pillar, Polygon, Wall
from shepherd_phys.scenario import SCENARIOS, Scenario
from shepherd_phys.settings import SettingsError
from shepherd_phys.state import WorldState
from shepherd_phys.world import NonFiniteError, World

SMALL = SCENARIOS["small"]


@dataclasses.dataclass
class Fixed:
    """A flock model that wants what it is told."""

    wanted: np.ndarray

    def velocities(self, state, rng):
        return self.wanted


def lone(shepherds=1, sheep=1, obstacles=(), wanted=None, **changes):
    """A world of a few bodies far apart; the goal is out of the way."""
    wanted = np.zeros((sheep, 2)) if wanted is None else np.array(wanted, dtype=float)
    return World(
        Scenario(
            n_sheep=sheep,
            n_flocks=1,
            shepherds=shepherds,
            goal_pos=(500.0, 0.0),
            flock=Fixed(wanted),
            obstacles=obstacles,
            **changes,
        )
    )


def put(world, sheep, shepherds, **more):
    return world.reset_to(world.reset(0).but(sheep_pos=sheep, shepherd_pos=shepherds, **more), 0)


# ----------------------------------------------------------- pymunk's batch API


def _mixed_space():
    space = pymunk.Space()
    bodies = []
    for k in range(4):
        body = pymunk.Body(1.0 + k, 2.0)
        body.position, body.velocity = (k + 0.25, -k), (k / 4, k / 8)
        body.angle, body.angular_velocity = k / 16, k / 32
        space.add(body, pymunk.Circle(body, 0.1))
        bodies.append(body)
    space.add(pymunk.Segment(space.static_body, (50, 0), (51, 0), 0.1))
    return space, bodies


def test_batch_read_gives_dynamic_bodies_in_order_of_insertion_then_the_static_one():
    space, bodies = _mixed_space()
    buffer = batch.Buffer()
    for _ in range(2):
        buffer.clear()
        fields = batch.BodyFields
        batch.get_space_bodies(
            space, fields.POSITION | fields.ANGLE | fields.VELOCITY | fields.ANGULAR_VELOCITY, buffer
        )
        rows = np.frombuffer(buffer.float_buf()).reshape(-1, 6)
        assert rows.shape == (5, 6)
        for row, body in zip(rows, bodies, strict=False):
            assert row.tolist() == [*body.position, body.angle, *body.velocity, body.angular_velocity]


def test_batch_reads_of_as_many_bodies_stay_in_the_same_memory():
    space, bodies = _mixed_space()
    buffer = batch.Buffer()
    batch.get_space_bodies(space, batch.BodyFields.POSITION, buffer)
    rows = np.frombuffer(buffer.float_buf()).reshape(-1, 2)
    for k in range(50):
        bodies[k % 4].position = (k, -k)
        buffer.clear()
        batch.get_space_bodies(space, batch.BodyFields.POSITION, buffer)
        assert rows[k % 4].tolist() == [k, -k]
        assert np.frombuffer(buffer.float_buf()).ctypes.data == rows.ctypes.data


def test_batch_write_sets_forces_and_torques_in_the_same_order():
    space, bodies = _mixed_space()
    values = np.arange(15, dtype=float).reshape(5, 3)
    values[4] = 0.0
    buffer = batch.Buffer()
    buffer.set_float_buf(values)
    batch.set_space_bodies(space, batch.BodyFields.FORCE | batch.BodyFields.TORQUE, buffer)
    assert [(*b.force, b.torque) for b in bodies] == [tuple(v) for v in values[:4]]
    space.step(0.1)
    assert all(tuple(b.force) == (0, 0) and b.torque == 0 for b in bodies)  # zeroed by each step


# ------------------------------------------------------------------------ servo


def test_a_free_body_has_the_wanted_velocity_after_one_substep():
    world = lone(wanted=[[0.3, -0.4]])
    put(world, [[0, 0]], [[20, 0]])
    state = world.step([[1.0, 0.0]])
    assert state.sheep_vel[0] == pytest.approx([0.3, -0.4])
    assert state.shepherd_vel[0] == pytest.approx([1.5, 0.0])
    # the engine moves with the old velocity, then takes up the new one: half a control step is lost at the start
    assert state.shepherd_pos[0] == pytest.approx([20 + 1.5 * 0.1, 0.0])
    state = world.step([[1.0, 0.0]])
    assert state.shepherd_pos[0] == pytest.approx([20 + 1.5 * 0.3, 0.0])


def test_forces_are_clipped_to_mass_times_max_acceleration():
    world = lone(max_acceleration=2.0)
    put(world, [[0, 0]], [[20, 0]])
    state = world.step([[0.0, 1.0]])
    assert state.shepherd_vel[0] == pytest.approx([0.0, 2.0 * 0.2])  # two substeps of 0.1 s at 2 m/s2


def test_actions_longer_than_one_are_clipped_to_the_disc():
    world = lone(shepherds=3)
    put(world, [[0, 0]], [[20, 0], [30, 0], [40, 0]])
    for _ in range(2):
        state = world.step([[3.0, 4.0], [1e200, 1e200], [0.6, 0.0]])
    assert state.shepherd_vel[0] == pytest.approx([1.5 * 0.6, 1.5 * 0.8])
    assert state.shepherd_vel[1] == pytest.approx([1.5 * math.sqrt(0.5)] * 2)
    assert state.shepherd_vel[2] == pytest.approx([0.9, 0.0])


def test_walls_win_against_the_servo():
    world = lone(obstacles=(Wall((2, -5), (2, 5)),), wanted=[[1.0, 0.2]])
    put(world, [[0, 0]], [[0, 2]])
    for _ in range(30):
        state = world.step([[1.0, 0.0]])
    slop = world.scenario.collision_slop
    assert state.shepherd_pos[0, 0] == pytest.approx(2 - 0.05 - 0.25, abs=slop + 1e-3)
    assert state.sheep_pos[0, 0] == pytest.approx(2 - 0.05 - 0.15, abs=slop + 1e-3)
    assert state.sheep_pos[0, 1] == pytest.approx(30 * 0.2 * 0.2, abs=0.05)  # it slides along: no friction


@pytest.mark.parametrize(
    "obstacle", [Wall((2, -5), (2, 5)), Pillar((2.5, 0), 0.5), Polygon(((2, -3), (4, -3), (4, 3), (2, 3)))]
)
def test_every_obstacle_kind_stops_bodies_and_beams(obstacle):
    from shepherd_phys.lidar import Lidar

    world = lone(obstacles=(obstacle,), sheep=2, wanted=[[1.0, 0.0], [0.0, 0.0]])
    put(world, [[0, 0], [8, 0]], [[-2, 0]])
    for _ in range(20):
        state = world.step([[0.0, 0.0]])
        scan = world.scan(Lidar(channels=("sheep", "shepherds", "goal", "obstacles")))
        assert scan["obstacles"][0, 0] == pytest.approx(4.0, abs=0.06)
        assert scan["sheep"][0, 0] < 4.0  # the near sheep; the far one, behind the obstacle, is never seen
    assert state.sheep_pos[0, 0] < 2.0


def test_contacts_of_shepherds_are_counted_once_each():
    world = lone(shepherds=2, obstacles=(Wall((2, -5), (2, 5)),))
    put(world, [[0, 40]], [[1.0, 0.0], [0.0, 0.0]])
    counts = [world.step([[1.0, 0.0], [0.0, 0.0]]).collisions for _ in range(15)]
    assert (counts[0], counts[-1]) == (0, 1)  # at the wall, and resting on it is no new contact
    for _ in range(15):
        state = world.step([[1.0, 0.0], [1.0, 0.0]])
    assert state.collisions == 2  # the other shepherd ran into the first
    put(world, [[0.5, 0.0]], [[1.5, 10.0], [-0.5, 0.0]])
    for _ in range(10):
        state = world.step([[0.0, 0.0], [1.0, 0.0]])
    assert state.collisions == 0  # pushing a sheep is no collision


def test_path_is_summed_displacement_not_command():
    world = lone(obstacles=(Wall((1, -5), (1, 5)),))
    put(world, [[0, 40]], [[0.0, 0.0]])
    for _ in range(50):
        state = world.step([[1.0, 0.0]])
    # 0.7 m to the wall, a little into it and back; the command was 15 m
    assert 0.69 < state.shepherd_path[0] < 0.9


def test_arrival_is_remembered_and_heading_kept_while_standing():
    flock = Fixed(np.array([[-1.0, 0.0]]))
    world = World(Scenario(n_sheep=1, n_flocks=1, shepherds=0, goal_pos=(0.0, 0.0), flock=flock))
    state = world.reset_to(world.reset(3).but(sheep_pos=[[2.9, 0.0]], sheep_vel=[[-1.0, 0.0]]), 3)
    assert (state.sheep_in_goal[0], state.sheep_arrived[0]) == (False, False)
    assert state.sheep_goal_distance[0] == pytest.approx(0.4)
    for _ in range(3):
        state = world.step(np.zeros((0, 2)))
    assert (state.sheep_in_goal[0], state.sheep_arrived[0], state.sheep_goal_distance[0]) == (True, True, 0.0)
    assert state.sheep_heading[0].tolist() == [-1.0, 0.0]
    flock.wanted = np.zeros((1, 2))
    assert world.step(np.zeros((0, 2))).sheep_heading[0].tolist() == [-1.0, 0.0]
    flock.wanted = np.array([[1.0, 0.0]])
    for _ in range(10):
        state = world.step(np.zeros((0, 2)))
    assert (state.sheep_in_goal[0], state.sheep_arrived[0]) == (False, True)


# ------------------------------------------------------------------ determinism


def episode_hash(seed, steps=40, scenario=SMALL):
    world = World(scenario)
    world.reset(seed)
    digest = hashlib.sha256()
    actions = np.random.default_rng(seed)
    for _ in range(steps):
        state = world.step(actions.uniform(-1, 1, (scenario.n_shepherds, 2)))
        for array in (state.sheep_pos, state.sheep_vel, state.shepherd_pos, state.sheep_heading):
            digest.update(array.tobytes())
    return digest.hexdigest()


def test_a_seed_replays_exactly_here_and_in_other_processes():
    seeds = range(8)
    here = [episode_hash(s) for s in seeds]
    assert here == [episode_hash(s) for s in seeds]
    assert len(set(here)) == len(here)
    with multiprocessing.get_context("spawn").Pool(2) as pool:
        assert pool.map(episode_hash, seeds) == here


@pytest.mark.slow
def test_hashes_of_1000_short_episodes_do_not_depend_on_the_workers():
    seeds = range(1_000)
    context = multiprocessing.get_context("spawn")
    with context.Pool(1) as one, context.Pool(2) as two:
        assert one.map(episode_hash, seeds, chunksize=50) == two.map(episode_hash, seeds, chunksize=7)


def test_a_used_world_gives_the_same_episode_as_a_new_one():
    world = World(SMALL)
    world.reset(5)
    for _ in range(30):
        world.step(np.ones((2, 2)))
    again, fresh = world.reset(7), World(SMALL).reset(7)
    assert again.sheep_pos.tobytes() == fresh.sheep_pos.tobytes()
    for _ in range(30):
        assert world.step(np.ones((2, 2))).sheep_pos.shape == (20, 2)
    other = World(SMALL)
    other.reset(7)
    for _ in range(30):
        state = other.step(np.ones((2, 2)))
    assert world.state.sheep_pos.tobytes() == state.sheep_pos.tobytes()


def test_streams_are_apart():
    """What a user draws changes nothing in the world, and noise is not the placement's stream."""
    plain, busy = World(SMALL), World(SMALL)
    plain.reset(1)
    busy.reset(1)
    for _ in range(10):
        busy.user_rng.random(100)
        a, b = plain.step(np.zeros((2, 2))), busy.step(np.zeros((2, 2)))
    assert a.sheep_pos.tobytes() == b.sheep_pos.tobytes()


def test_reset_to_continues_from_a_state():
    world = World(SMALL)
    world.reset(2)
    for _ in range(25):
        state = world.step(np.ones((2, 2)) * 0.4)
    twin = World(SMALL)
    start = twin.reset_to(state, 9)
    for name in ("sheep_pos", "sheep_vel", "sheep_heading", "sheep_arrived", "shepherd_pos", "goal_pos"):
        assert getattr(start, name).tobytes() == getattr(state, name).tobytes()
    assert (start.step, start.collisions, start.shepherd_path.tolist()) == (0, 0, [0.0, 0.0])


# -------------------------------------------------------------------- placement


@pytest.mark.parametrize("n_flocks", [1, 2, 3, 5])
def test_placement_follows_the_scenario(n_flocks):
    scenario = SCENARIOS["paper"].but(n_flocks=n_flocks)
    for seed in range(5):
        state = World(scenario).reset(seed)
        gap = np.linalg.norm(state.sheep_pos[:, None] - state.sheep_pos[None], axis=2) + 9 * np.eye(100)
        assert gap.min() >= 0.3
        assert np.abs(state.goal_pos).max() <= 25
        assert np.abs(state.shepherd_pos).max() <= 26
        assert np.linalg.norm(state.sheep_heading, axis=1) == pytest.approx(np.ones(100))
        first = len(np.array_split(np.arange(100), n_flocks)[0])
        away = np.linalg.norm(state.sheep_pos[:first].mean(axis=0) - state.goal_pos)
        assert 9 < away < 21


def test_bodies_are_placed_clear_of_obstacles():
    scenario = Scenario(
        n_sheep=60,
        n_flocks=1,
        shepherds=2,
        goal_pos=(0.0, 0.0),
        flock_distance=(10.0, 10.0),
        obstacles=tuple(Pillar((10 * math.cos(a), 10 * math.sin(a)), 0.8) for a in np.arange(16) * math.pi / 8),
    )
    for seed in range(10):
        state = World(scenario).reset(seed)
        centers = np.array([p.center for p in scenario.obstacles])
        gap = np.linalg.norm(state.sheep_pos[:, None] - centers[None], axis=2).min()
        assert gap >= 0.8 + 0.15


def test_a_drawn_goal_is_clear_of_obstacles_and_a_given_one_may_only_touch_them():
    wall = Wall((-30, 0), (30, 0))
    drawn = World(Scenario(n_sheep=4, n_flocks=1, obstacles=(wall,)))
    assert min(abs(drawn.reset(seed).goal_pos[1]) for seed in range(40)) > 2.5 + 0.05
    World(Scenario(n_sheep=4, n_flocks=1, goal_pos=(0.0, 1.0), obstacles=(wall,))).reset(0)
    with pytest.raises(SettingsError, match="obstacles: .*another goal_pos"):
        World(Scenario(n_sheep=4, n_flocks=1, goal_pos=(0.0, 0.0), obstacles=(wall,))).reset(0)


def test_obstacles_that_cover_the_box_are_one_clear_error():
    gaps = tuple(Pillar((x, y), 2.0) for x in range(-12, 13, 3) for y in range(-12, 13, 3))  # they leave no room at all
    block = Polygon(((-12, -12), (12, -12), (12, 12), (-12, 12)))
    for obstacles in (gaps, (block, *gaps)):
        scenario = Scenario(
            n_sheep=20, n_flocks=1, shepherds=2, box=4.0, flock_distance=(1.0, 2.0), obstacles=obstacles
        )
        with pytest.raises(SettingsError, match="obstacles: in 200 draws they left no room"):
            World(scenario).reset(0)


def test_no_body_is_left_in_an_obstacle_and_no_room_is_an_error():
    wedge = (Wall((-50, -0.2), (50, -0.2)), Wall((-50, 0.2), (50, 0.2)))  # 0.3 m between them, a shepherd needs 0.5
    scenario = Scenario(
        n_sheep=1, n_flocks=1, shepherds=1, goal_pos=(0.0, 30.0), box=0.1, obstacles=wedge, body_keep_out=0.0
    )
    with pytest.raises(SettingsError, match="1 of 2 bodies still overlap another or an obstacle|left no room"):
        World(scenario).reset(0)
    corners = tuple(
        wall
        for x in range(-24, 25, 4)
        for y in range(-24, 25, 4)
        for wall in (Wall((x, y), (x + 0.8, y)), Wall((x, y), (x, y + 0.8)))
    )
    crowded = Scenario(n_sheep=60, n_flocks=2, goal_radius=1.0, obstacles=corners, goal_keep_out=0.0, body_keep_out=0.0)
    world = World(crowded)
    for seed in range(6):
        state = world.reset(seed)
        place = np.concatenate([state.sheep_pos, state.shepherd_pos])
        radius = np.concatenate([state.sheep_radius, state.shepherd_radius])
        body = world.space.static_body
        gaps = [
            min(shape.point_query(tuple(p)).distance for shape in body.shapes) - r
            for p, r in zip(place, radius, strict=True)
        ]
        assert min(gaps) >= 0.0


def test_bodies_and_a_drawn_goal_keep_out_of_the_way_of_fixed_obstacles():
    pillars = tuple(Pillar((x, y), 0.6) for x in range(-24, 25, 8) for y in range(-24, 25, 8))
    for keep_out in (0.5, 0.2):
        world = World(
            Scenario(n_sheep=30, obstacles=pillars, goal_radius=1.5, goal_keep_out=1.0, body_keep_out=keep_out)
        )
        for seed in range(5):
            state = world.reset(seed)
            gaps = state.surroundings.static_distances(np.concatenate([state.sheep_pos, state.shepherd_pos]))[0].min(
                axis=1
            )
            assert (gaps >= np.concatenate([state.sheep_radius, state.shepherd_radius]) + keep_out).all()
            assert state.surroundings.static_distances(state.goal_pos[None])[0].min() >= 1.5 + 1.0
    near = Scenario(n_sheep=5, n_flocks=1, obstacles=(Pillar((3.0, 0.0), 1.0),), goal_pos=(0.0, 0.0), goal_radius=2.0)
    assert World(near).reset(0).goal_pos.tolist() == [0.0, 0.0]  # who places the goal knows best


@pytest.mark.parametrize(
    ("shepherds", "sheep", "substeps"),
    [
        ((Disc(mass=5.0),), SHEEP, 3),
        ((Disc(mass=5.0), Disc(mass=5.1)), SHEEP, 5),
        ((DifferentialDrive(max_speed=1.6),), SHEEP, 5),
        ((Disc(mass=5.0),), (SHEEP, Disc(radius=0.12, mass=0.6, max_speed=0.8)), 5),
        ((Flyer(mass=50.0, max_speed=9.0),), SHEEP, 3),
    ],
)
def test_shepherds_that_press_hard_take_more_engine_steps_among_obstacles(shepherds, sheep, substeps):
    walled = Scenario(shepherds=shepherds, sheep=sheep, obstacles=(Wall((0.0, 0.0), (1.0, 0.0)),))
    assert walled.n_substeps == substeps and walled.physics_dt == pytest.approx(0.2 / substeps)
    assert walled.but(obstacles=()).n_substeps == 2 and walled.but(substeps=4).n_substeps == 4


def drift(state, rng):
    """A flock model as a function: everybody goes east."""
    return np.tile([0.7, 0.0], (state.n_sheep, 1))


def test_a_flock_model_may_be_a_function():
    scenario = Scenario(n_sheep=3, n_flocks=1, shepherds=1, flock=drift)
    world = World(scenario)
    world.reset(0)
    assert world.step(np.zeros((1, 2))).sheep_vel == pytest.approx(np.tile([0.7, 0.0], (3, 1)), abs=1e-6)
    assert Scenario.from_dict(scenario.to_dict(), [drift]) == scenario
    with pytest.raises(SettingsError, match="needs 'velocities', or to be a function like it"):
        World(scenario.but(flock=3))


# ----------------------------------------------------------------------- guards


def test_a_refused_action_changes_nothing_of_the_episode():
    states = []
    for refused in (False, True):
        world = World(SMALL)
        world.reset(4)
        if refused:
            for bad in (np.full((2, 2), np.nan), np.zeros(3), "left"):
                with pytest.raises(ValueError, match="action"):
                    world.step(bad)
        for _ in range(20):
            states.append(world.step(np.ones((2, 2)) * 0.3))
    assert states[19].sheep_pos.tobytes() == states[39].sheep_pos.tobytes()


def test_a_reset_that_fails_leaves_no_world_to_step():
    world = World(SMALL)
    state = world.reset(0)
    for fail in (lambda: world.reset(-1), lambda: world.reset(None)):
        with pytest.raises(ValueError, match="seed: needs a whole number"):
            fail()
        with pytest.raises(RuntimeError, match="call reset first"):
            world.step(np.zeros((2, 2)))
    world.reset(0)
    with pytest.raises(ValueError, match=r"state.sheep_heading: needs shape \(20, 2\)"):
        world.reset_to(state.but(sheep_heading=np.zeros((3, 2))), 0)
    with pytest.raises(ValueError, match=r"state.goal_pos: every number"):
        world.reset_to(state.but(goal_pos=[math.nan, 0.0]), 0)


def test_huge_wishes_are_clipped_and_never_reach_the_engine():
    world = lone(wanted=[[1e308, -1e308]])
    put(world, [[0, 0]], [[20, 0]])
    state = world.step([[0.0, 0.0]])
    assert np.hypot(*state.sheep_vel[0]) == pytest.approx(30.0 * 0.2)


@pytest.mark.parametrize("answer", [None, "fast", [[1.0, 2.0]], {"a": 1}])
def test_flock_models_that_answer_something_else_are_named(answer):
    world = lone()
    put(world, [[0, 0]], [[5, 5]])
    world.scenario.flock.wanted = answer
    if answer == [[1.0, 2.0]]:
        assert world.step([[0.0, 0.0]]).sheep_vel[0] == pytest.approx([1.0, 2.0])  # a list will do
    else:
        with pytest.raises(ValueError, match=r"flock model \(test_world:Fixed\): velocities"):
            world.step([[0.0, 0.0]])


@pytest.mark.parametrize("answer", [None, (1.0, 2.0, 3.0), ((1.0,), 0.0), ((1.0, "x"), 0.0)])
def test_bodies_that_follow_with_something_else_are_named(answer):
    @dataclasses.dataclass(frozen=True)
    class Odd:
        max_speed: float = 1.0

        def build(self):
            return Disc().build()

        def follow(self, pose, wanted, dt):
            return answer

    world = lone(shepherds=(Odd(),))
    put(world, [[0, 0]], [[5, 5]])
    with pytest.raises(ValueError, match="Odd.follow: needs a velocity"):
        world.step([[0.0, 0.0]])


@pytest.mark.parametrize("answer", [None, pymunk.Body(1, 1), (1, 2), (pymunk.Body(1, 1), ["shape"])])
def test_bodies_that_build_something_else_are_named(answer):
    @dataclasses.dataclass(frozen=True)
    class Odd:
        max_speed: float = 1.0

        def build(self):
            return answer

        def follow(self, pose, wanted, dt):
            return wanted, 0.0

    with pytest.raises(SettingsError, match="Odd.*build: needs a pymunk.Body and a list"):
        lone(shepherds=(Odd(),)).reset(0)


def test_obstacles_that_give_something_else_or_too_thin_shapes_are_named():
    class Odd:
        def __init__(self, make):
            self.shapes = make

    for make in (lambda b: None, lambda b: pymunk.Circle(b, 1.0), lambda b: ["wall"]):
        with pytest.raises(SettingsError, match=r"obstacles\[0\] .*Odd.*shapes: needs a list of pymunk shapes"):
            lone(obstacles=(Odd(make),)).reset(0)
    for make in (
        lambda b: [pymunk.Segment(b, (9, 0), (9, 1), 0.0)],
        lambda b: [pymunk.Circle(b, -1.0)],
        lambda b: [pymunk.Poly(b, [(9, 9), (12, 9), (12, 9.05), (9, 9.05)], radius=0.02)],
        lambda b: [pymunk.Poly(b, [(9, 9), (12, 9)])],
        lambda b: [pymunk.Poly(b, [(9, 9), (9, 9), (9, 9)])],
    ):
        with pytest.raises(SettingsError, match="must be at least 0.1 m thick"):
            lone(obstacles=(Odd(make),)).reset(0)
    lone(obstacles=(Odd(lambda b: [pymunk.Poly(b, [(9, 9), (12, 9), (12, 9.05), (9, 9.05)], radius=0.025)]),)).reset(0)

    def sensor(body):
        shape = pymunk.Circle(body, 1.0)
        shape.sensor = True
        return [shape]

    with pytest.raises(SettingsError, match="a Circle is a sensor, which stops nobody"):
        lone(obstacles=(Odd(sensor),)).reset(0)


def test_the_space_may_be_looked_at_but_bodies_may_not_be_added():
    world = World(SMALL)
    world.reset(0)
    assert world.space.static_body.position == (0, 0)
    world.step(np.zeros((2, 2)))
    body = pymunk.Body(1.0, 1.0)
    world.space.add(body, pymunk.Circle(body, 0.1))
    with pytest.raises(RuntimeError, match="bodies were added to the world's space"):
        world.step(np.zeros((2, 2)))


def test_a_class_in_place_of_an_object_is_named():
    with pytest.raises(SettingsError, match=r"Disc: a class was given; make one of it: Disc\(\)"):
        lone(shepherds=(Disc,))


def test_sliding_along_an_obstacle_of_two_shapes_is_one_collision():
    @dataclasses.dataclass(frozen=True)
    class Pair:
        def shapes(self, body):
            return [pymunk.Segment(body, (2, -5), (2, 0), 0.05), pymunk.Segment(body, (2, 0), (2, 5), 0.05)]

    world = lone(obstacles=(Pair(),))
    put(world, [[0, 40]], [[1.6, -3.0]])
    for _ in range(25):
        state = world.step([[0.4, 0.9]])
    assert state.shepherd_pos[0, 1] > 2.0
    assert state.collisions == 1


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_actions_that_are_not_finite_move_nothing(bad):
    world = World(SMALL)
    before = world.reset(0)
    with pytest.raises(NonFiniteError, match="action: every number must be finite"):
        world.step([[0.0, 0.0], [0.0, bad]])
    assert world.state is before
    after = world.step(np.zeros((2, 2)))
    assert np.isfinite(after.sheep_pos).all()


def test_flock_models_that_want_nonsense_are_named():
    world = lone(wanted=[[math.nan, 0.0]])
    put(world, [[0, 0]], [[5, 5]])
    with pytest.raises(NonFiniteError, match=r"flock model \(test_world:Fixed\): velocities must be finite"):
        world.step([[0.0, 0.0]])
    world.scenario.flock.wanted = np.zeros((3, 2))
    with pytest.raises(ValueError, match=r"flock model \(test_world:Fixed\): velocities need shape \(1, 2\)"):
        world.step([[0.0, 0.0]])


def test_bodies_that_follow_with_nonsense_are_named():
    @dataclasses.dataclass(frozen=True)
    class Broken:
        max_speed: float = 1.0

        def build(self):
            return Disc().build()

        def follow(self, pose, wanted, dt):
            return (math.nan, 0.0), 0.0

    world = lone(shepherds=(Broken(),))
    put(world, [[0, 0]], [[5, 5]])
    with pytest.raises(NonFiniteError, match=r"Broken.follow: velocity and spin must be finite"):
        world.step([[0.0, 0.0]])


@pytest.mark.parametrize("shape", [(2,), (3, 2), (2, 3), (0, 2)])
def test_actions_of_another_shape(shape):
    world = World(SMALL)
    world.reset(0)
    with pytest.raises(ValueError, match=r"action: needs shape \(2, 2\)"):
        world.step(np.zeros(shape))


def test_step_before_reset():
    with pytest.raises(RuntimeError, match="call reset first"):
        World(SMALL).step(np.zeros((2, 2)))


def test_reset_to_refuses_states_of_other_sizes_or_with_nan():
    world = World(SMALL)
    state = world.reset(0)
    with pytest.raises(ValueError, match="needs 20 sheep and 2 shepherds"):
        world.reset_to(World(SCENARIOS["paper"]).reset(0), 0)
    with pytest.raises(NonFiniteError, match="state.sheep_pos: every number"):
        world.reset_to(state.but(sheep_pos=np.full((20, 2), np.nan)), 0)


# ------------------------------------------------------------------------ state


def test_states_are_read_only_and_their_own():
    world = World(SMALL)
    first = world.reset(0)
    kept = first.sheep_pos.copy()
    second = world.step(np.ones((2, 2)))
    for field in dataclasses.fields(WorldState):
        value = getattr(second, field.name)
        if isinstance(value, np.ndarray):
            with pytest.raises(ValueError, match="read-only"):
                value[...] = 0
    for _ in range(5):
        world.step(np.ones((2, 2)))
    assert first.sheep_pos.tobytes() == kept.tobytes()
    with pytest.raises(TypeError, match="no field 'sheeps'"):
        first.but(sheeps=3)


def test_a_user_body_that_turns_is_read_and_driven():
    @dataclasses.dataclass(frozen=True)
    class Cart:
        """Drives along its nose, turns towards what is wanted."""

        max_speed: float = 1.0

        def build(self):
            corners = [(0.3, 0.0), (-0.2, 0.2), (-0.2, -0.2)]
            body = pymunk.Body(3.0, pymunk.moment_for_poly(3.0, corners))
            return body, [pymunk.Poly(body, corners)]

        def follow(self, pose, wanted, dt):
            nose = np.array([math.cos(pose[2]), math.sin(pose[2])])
            off = math.atan2(nose[0] * wanted[1] - nose[1] * wanted[0], nose @ wanted)
            return nose * max(0.0, nose @ wanted), float(np.clip(4 * off, -2.0, 2.0))

    world = lone(shepherds=(Cart(), Disc()))
    put(world, [[0, 50]], [[0.0, 0.0], [10.0, 0.0]])
    for _ in range(30):
        state = world.step([[0.0, 1.0], [0.0, 1.0]])
    assert state.shepherd_angle[0] == pytest.approx(math.pi / 2, abs=0.05)
    assert state.shepherd_angle[1] == 0.0
    assert state.shepherd_vel[0] == pytest.approx([0.0, 1.0], abs=0.05)
    assert state.shepherd_pos[0, 1] > 4.0
    assert state.shepherd_radius.tolist() == [0.3, 0.25]


def test_driven_sheep_do_not_run_through_one_another_and_resting_ones_do_not_overlap():
    """What the engine's settings were chosen for."""
    world = World(SCENARIOS["paper"].but(n_flocks=1, flock=Strombom(graze_probability=0.0)))
    state = world.reset(0)
    closest = []
    apart = 9 * np.eye(100)
    for _ in range(150):
        way = state.sheep_pos.mean(axis=0) - state.shepherd_pos
        state = world.step(way / np.maximum(1.0, np.linalg.norm(way, axis=1, keepdims=True)))
        closest.append((np.linalg.norm(state.sheep_pos[:, None] - state.sheep_pos[None], axis=2) + apart).min())
    assert min(closest) > 0.02  # driven straight into by three shepherds
    assert np.median(closest) > 0.1
    calm = world.reset_to(state.but(shepherd_pos=state.shepherd_pos + 100.0, shepherd_vel=np.zeros((3, 2))), 0)
    for _ in range(25):
        calm = world.step(np.zeros((3, 2)))
    gaps = np.linalg.norm(calm.sheep_pos[:, None] - calm.sheep_pos[None], axis=2) + apart
    assert gaps.min() > 0.3 - 2 * world.scenario.collision_slop


def test_worlds_that_are_gone_leave_their_buffers_to_new_ones(monkeypatch):
    """pymunk never frees them, and training makes a world for each episode."""
    made = []
    buffer = batch.Buffer
    monkeypatch.setattr(batch, "Buffer", lambda: made.append(buffer()) or made[-1])
    scenarios = [Scenario(n_sheep=n, n_flocks=1, shepherds=1) for n in (3, 40, 5, 7)]
    rows = []
    for scenario in (*scenarios, *scenarios):
        world = World(scenario)
        world.reset(1)
        rows.append(world.step([[1.0, 0.0]]).sheep_pos.tobytes())
        del world
        gc.collect()
    assert len(made) <= 2
    assert rows[:4] == rows[4:]
    first, second = World(scenarios[0]), World(scenarios[1])  # two at a time share nothing
    for world in (first, second):
        world.reset(1)
    second.step([[1.0, 0.0]])
    assert first.step([[1.0, 0.0]]).sheep_pos.tobytes() == rows[0]
