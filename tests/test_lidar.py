import math

import numpy as np
import pymunk
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from shepherd_phys.geometry import (
    HIDDEN_CATEGORY,
    OBSTACLE_CATEGORY,
    OBSTACLES,
    SHEEP,
    SHEEP_CATEGORY,
    SHEPHERD_CATEGORY,
    SHEPHERDS,
    compile_shapes,
)
from shepherd_phys.lidar import CHANNELS, Lidar, Sensor
from shepherd_phys.settings import SettingsError

ALL = Lidar(channels=CHANNELS, beams=8)
GOAL = (np.array([0.0, 30.0]), 2.5)
ENGINES = pytest.mark.parametrize("engine", ["kernel", "pymunk"])


class Scene:
    """A small world made by hand: sheep and shepherds at poses, obstacles on the static body."""

    def __init__(self, sheep=(), shepherds=((0.0, 0.0),), obstacles=(), make_sheep=None, make_shepherd=None):
        self.space = pymunk.Space()
        self.owned, self.poses, self.sheep_shapes = [], [], []
        self.n_sheep, self.n_shepherds = len(sheep), len(shepherds)
        disc = {SHEEP: lambda body: [pymunk.Circle(body, 0.5)], SHEPHERDS: lambda body: [pymunk.Circle(body, 0.25)]}
        for channel, poses, make in ((SHEEP, sheep, make_sheep), (SHEPHERDS, shepherds, make_shepherd)):
            for k, pose in enumerate(poses):
                body = pymunk.Body(1.0, 1.0)
                x, y, angle = (*pose, 0.0)[:3]
                body.position, body.angle = (x, y), angle
                shapes = (make or disc[channel])(body)
                for shape in shapes:
                    is_sheep = channel == SHEEP
                    shape.filter = pymunk.ShapeFilter(
                        group=0 if is_sheep else k + 1, categories=SHEEP_CATEGORY if is_sheep else SHEPHERD_CATEGORY
                    )
                    self.owned.append((shape, len(self.poses), channel))
                if channel == SHEEP:
                    self.sheep_shapes.append(shapes)
                self.space.add(body, *shapes)
                self.poses.append((x, y, angle))
        for make_obstacle in obstacles:
            shape = make_obstacle(self.space.static_body)
            shape.filter = pymunk.ShapeFilter(categories=OBSTACLE_CATEGORY)
            self.space.add(shape)
            self.owned.append((shape, -1, OBSTACLES))

    def sensor(self, lidar, **more):
        sizes = (self.sheep_shapes, self.n_sheep, self.n_shepherds)
        return Sensor(lidar, compile_shapes(self.owned), self.space, *sizes, **more)

    def scan(self, lidar, goal=GOAL, masks=None, **more):
        return self.sensor(lidar, **more).scan(np.array(self.poses).reshape(-1, 3), *goal, masks or {})

    def by_both(self, lidar, goal=GOAL, masks=None, **more):
        scans = [self.scan(lidar.but(engine=engine), goal, masks, **more) for engine in ("kernel", "pymunk")]
        assert_same(*scans)
        return scans[0]


def assert_same(a, b):
    assert a.names == b.names
    assert np.array_equal(np.isinf(a.ranges), np.isinf(b.ranges))
    seen = np.isfinite(a.ranges)
    assert np.all(np.abs(a.ranges[seen] - b.ranges[seen]) <= 1e-9)


def circle(x, y, r):
    return lambda body: pymunk.Circle(body, r, (x, y))


def wall(a, b, r):
    return lambda body: pymunk.Segment(body, a, b, r)


def box(x, y, width, height, radius=0.0):
    corners = [(x, y), (x + width, y), (x + width, y + height), (x, y + height)]
    return lambda body: pymunk.Poly(body, corners, radius=radius)


# -- two engines, one answer ----------------------------------------------------------------------------------------


def random_shape(rng, size, spread, grid):
    """A maker of a random disc, segment or polygon; on a grid its edges often lie along a beam."""

    def number(low, high):
        value = rng.uniform(low, high)
        return float(round(value / 0.1) * 0.1) if grid else float(value)

    kind = rng.integers(4)
    x, y = (number(-spread, spread), number(-spread, spread)) if spread else (0.0, 0.0)
    if kind <= 1:
        offset = (x, y) if kind or spread else (0.0, 0.0)
        if kind == 1 and not spread:
            offset = (number(-size, size), number(-size, size))
        r = max(number(0.1, size), 0.1)
        return lambda body: pymunk.Circle(body, r, offset)
    if kind == 2:
        end = (x + number(0.2, 4 * size), y + (0.0 if grid else number(-3 * size, 3 * size)))
        r = number(0.0, size)
        return lambda body: pymunk.Segment(body, (x, y), end, r)
    r = number(0.0, size / 2) if rng.random() < 0.5 else 0.0
    if grid:
        return box(x, y, max(number(0.1, 3 * size), 0.1), max(number(0.1, 3 * size), 0.1), r)
    n, phase = int(rng.integers(3, 8)), rng.uniform(0, 6)
    corners = [
        (x + size * math.cos(phase + math.tau * i / n), y + 0.6 * size * math.sin(phase + math.tau * i / n))
        for i in range(n)
    ]
    return lambda body: pymunk.Poly(body, corners, radius=r)


def random_scene(seed, aligned=True):
    """Scene, lidar, goal and masks: crowded enough that beams start inside, graze, and hide one another."""
    rng = np.random.default_rng(seed)
    grid = bool(rng.random() < 0.4) and aligned
    spread = float(rng.choice([3.0, 8.0, 20.0]))

    def poses(n):
        found = rng.uniform(-spread, spread, (n, 3))
        found[:, 2] = rng.uniform(-10, 10, n) * (rng.random() < 0.7) * (not grid)
        return (found / 0.1).round() * 0.1 if grid else found

    n_sheep, n_shepherds = int(rng.integers(0, 25)), int(rng.integers(1, 4))
    scene = Scene(
        sheep=poses(n_sheep).tolist(),
        shepherds=poses(n_shepherds).tolist(),
        obstacles=[random_shape(rng, 1.0, spread, grid) for _ in range(int(rng.integers(0, 6)))],
        make_sheep=lambda body: [random_shape(rng, 0.4, 0.0, grid)(body) for _ in range(1 + (rng.random() < 0.1))],
        make_shepherd=lambda body: [random_shape(rng, 0.5, 0.0, grid)(body)],
    )
    lidar = Lidar(
        channels=tuple(name for name in CHANNELS if rng.random() < 0.8) or ("sheep",),
        beams=int(rng.choice([8, 36, 64, 100])),
        range=float(rng.choice([2.0, 10.0, 50.0])),
        goal_range=float(rng.choice([5.0, 75.0])),
        goal_inside=str(rng.choice(["exit", "none"])),
        obstacles_cut=bool(rng.random() < 0.7),
    )
    goal = (rng.uniform(-spread, spread, 2), float(rng.uniform(0.5, 4.0)))
    masks = {name: rng.random(n_sheep) < 0.5 for name in ("wild", "black")[: int(rng.integers(0, 3))]}
    flies = (rng.random(n_shepherds) < 0.2).tolist()
    return scene, lidar, goal, masks, flies


@pytest.mark.parametrize("block", range(20))
def test_engines_agree(block):
    for seed in range(20 * block, 20 * (block + 1)):
        scene, lidar, goal, masks, flies = random_scene(seed)
        scene.by_both(lidar, goal, masks, flies=flies)


@pytest.mark.slow
@pytest.mark.parametrize("block", range(20))
def test_engines_agree_on_a_thousand_scenes(block):
    for seed in range(10_000 + 50 * block, 10_000 + 50 * (block + 1)):
        scene, lidar, goal, masks, flies = random_scene(seed)
        scene.by_both(lidar.but(beams=512), goal, masks, flies=flies)


@pytest.mark.parametrize("seed", range(40))
def test_engines_agree_on_beams_that_graze(seed):
    """Discs and walls whose edges lie on a beam, to the last bit or nearly."""
    rng = np.random.default_rng(seed)
    makers, sheep = [], []
    for _ in range(30):
        angle = math.tau * int(rng.integers(64)) / 64
        away, r = float(rng.uniform(1, 40)), float(rng.choice([0.15, 0.25, 1.0]))
        side = (
            float(rng.choice([-1, 1])) * r * (1 + float(rng.choice([0.0, 1e-15, -1e-15, 1e-12, -1e-12, 1e-9, -1e-9])))
        )
        x, y = math.cos(angle), math.sin(angle)
        centre = (away * x - side * y, away * y + side * x)
        if rng.random() < 0.5:
            sheep.append(centre)
        elif rng.random() < 0.5:
            makers.append(circle(*centre, r))
        else:
            makers.append(wall(centre, (centre[0] + x, centre[1] + y), r))
    size = float(rng.choice([0.15, 0.25, 1.0]))
    scene = Scene(sheep, obstacles=makers, make_sheep=lambda body: [pymunk.Circle(body, size)])
    scene.by_both(ALL.but(beams=64))


@pytest.mark.parametrize("y", [0.1 * k for k in range(-12, 13)])
def test_engines_agree_on_obstacles_along_the_axes(y):
    """Chipmunk's tree of boxes drops some of these exact tangents; the kernel drops the same ones."""
    makers = [circle(5.0, y, 0.3), circle(5.0, y, 0.7), box(-7.0, y, 2.0, 0.4), wall((y, 4.0), (y, 6.0), 0.2)]
    for k in range(-10, 11):
        Scene(shepherds=[(0.1 * k, 0.1 * k)], obstacles=makers).by_both(ALL)
        Scene(shepherds=[(0.1 * k, 0.1 * k)], obstacles=makers[:1]).by_both(ALL)


@pytest.mark.parametrize("seed", range(30))
def test_an_index_of_cells_gives_the_reference_the_same_answers(seed):
    """Off the grid only: Chipmunk's spatial hash loses hits of beams that pass exactly through a corner of cells."""
    scene, lidar, goal, masks, flies = random_scene(seed, aligned=False)
    lidar = lidar.but(engine="pymunk")
    expected = scene.scan(lidar, goal, masks, flies=flies)
    scene.space.use_spatial_hash(0.4, 1000)
    assert_same(scene.scan(lidar, goal, masks, flies=flies), expected)


# -- readings -------------------------------------------------------------------------------------------------------


@ENGINES
def test_hand_worked_distances(engine):
    scene = Scene(
        sheep=[(10.0, 0.0), (0.0, 3.0)],
        shepherds=[(0.0, 0.0), (-4.0, 0.0)],
        obstacles=[wall((-2.0, -5.0), (2.0, -5.0), 0.5), box(5.0, 5.0, 1.0, 1.0)],
    )
    scan = scene.scan(ALL.but(engine=engine))
    assert scan["sheep"][0] == pytest.approx([9.5, np.inf, 2.5] + 5 * [np.inf])
    assert scan["shepherds"][0] == pytest.approx(4 * [np.inf] + [3.75] + 3 * [np.inf])
    assert scan["goal"][0] == pytest.approx(2 * [np.inf] + [27.5] + 5 * [np.inf])
    assert scan["obstacles"][0, [1, 6]] == pytest.approx([5 * math.sqrt(2), 4.5])
    assert scan["shepherds"][1, 0] == pytest.approx(3.75)  # each sees the other and not itself


@ENGINES
def test_channels_do_not_hide_one_another_and_within_one_the_nearest_wins(engine):
    scene = Scene(sheep=[(9.0, 0.0), (4.0, 0.0)], shepherds=[(0.0, 0.0), (2.0, 0.0)])
    scan = scene.scan(ALL.but(engine=engine), goal=(np.array([20.0, 0.0]), 2.0))
    assert [scan[name][0, 0] for name in ("shepherds", "sheep", "goal")] == pytest.approx([1.75, 3.5, 18.0])


@ENGINES
@pytest.mark.parametrize("channels", [CHANNELS, CHANNELS[:3]])
def test_obstacles_cut_every_channel_unless_switched_off(engine, channels):
    scene = Scene(
        sheep=[(6.0, 0.0), (0.0, 2.0)],
        shepherds=[(0.0, 0.0), (7.5, 0.0)],
        obstacles=[wall((4.0, -1.0), (4.0, 1.0), 0.1)],
    )
    goal, masks = (np.array([20.0, 0.0]), 2.0), {"wild": np.array([True, True])}
    scan = scene.scan(ALL.but(engine=engine, channels=channels), goal, masks)
    assert scan.names == (*channels, "wild")
    assert np.isinf([scan[name][0, 0] for name in ("sheep", "shepherds", "goal", "wild")]).all()
    assert scan["sheep"][0, 2] == scan["wild"][0, 2] == pytest.approx(1.5)  # nothing in front of this one
    through = scene.scan(ALL.but(engine=engine, channels=channels, obstacles_cut=False), goal, masks)
    assert [through[name][0, 0] for name in ("sheep", "shepherds", "goal")] == pytest.approx([5.5, 7.25, 18.0])
    if "obstacles" in channels:
        assert scan["obstacles"][0, 0] == through["obstacles"][0, 0] == pytest.approx(3.9)


@ENGINES
def test_an_obstacle_out_of_range_still_hides_the_goal(engine):
    lidar = ALL.but(engine=engine, range=10.0)
    goal = (np.array([30.0, 0.0]), 2.0)
    assert Scene().scan(lidar, goal)["goal"][0, 0] == pytest.approx(28.0)
    hiding = Scene(obstacles=[circle(20.0, 0.0, 1.0)]).scan(lidar, goal)
    assert np.isinf(hiding["goal"][0]).all()
    assert np.isinf(hiding["obstacles"][0]).all()
    behind = Scene(obstacles=[circle(40.0, 0.0, 1.0)]).scan(lidar, goal)
    assert behind["goal"][0, 0] == pytest.approx(28.0)


@ENGINES
def test_range(engine):
    scene = Scene(sheep=[(10.0, 0.0), (0.0, 10.6)])
    scan = scene.scan(ALL.but(engine=engine, range=10.0, goal_range=40.0), goal=(np.array([-42.0, 0.0]), 2.5))
    assert scan["sheep"][0, 0] == pytest.approx(9.5)
    assert np.isinf(scan["sheep"][0, 2])
    assert scan["goal"][0, 4] == pytest.approx(39.5)
    nearer = scene.scan(ALL.but(engine=engine, goal_range=39.0), goal=(np.array([-42.0, 0.0]), 2.5))
    assert np.isinf(nearer["goal"]).all()


@ENGINES
def test_a_beam_that_starts_inside_reads_0_and_a_flying_shepherd_does_not_see_what_it_is_above(engine):
    scene = Scene(sheep=[(0.2, 0.0), (5.0, 0.0)], obstacles=[box(-1.0, -1.0, 2.0, 2.0), circle(0.0, 6.0, 1.0)])
    lidar = ALL.but(engine=engine)
    walking = scene.scan(lidar)
    assert (walking["sheep"][0] == 0.0).all()
    assert (walking["obstacles"][0] == 0.0).all()
    flying = scene.scan(lidar, flies=[True])
    assert flying["sheep"][0] == pytest.approx([4.5] + 7 * [np.inf])
    assert flying["obstacles"][0] == pytest.approx(2 * [np.inf] + [5.0] + 5 * [np.inf])


@ENGINES
def test_the_goal_from_inside_is_the_way_out_or_nothing(engine):
    goal = (np.array([1.0, 0.0]), 2.5)
    scan = Scene().scan(ALL.but(engine=engine), goal)
    assert scan["goal"][0, [0, 4]] == pytest.approx([3.5, 1.5])
    assert scan["goal"][0, 2] == pytest.approx(math.sqrt(2.5**2 - 1))
    assert np.isfinite(scan["goal"]).all()
    assert np.isinf(Scene().scan(ALL.but(engine=engine, goal_inside="none"), goal)["goal"]).all()
    outside = (np.array([3.0, 0.0]), 2.5)
    assert Scene().scan(ALL.but(engine=engine, goal_inside="none"), outside)["goal"][0, 0] == pytest.approx(0.5)


@settings(deadline=None)  # numba compiles on the first call
@given(st.floats(-60, 60), st.floats(-60, 60), st.floats(0.1, 10))
def test_a_goal_reading_ends_on_the_circle(x, y, radius):
    lidar = Lidar(channels=("goal",), beams=360, goal_range=1000.0)
    found = Scene().scan(lidar, (np.array([x, y]), radius))["goal"][0]
    away = math.hypot(x, y)
    angles = math.tau * np.arange(360) / 360
    aside = np.abs(x * np.sin(angles) - y * np.cos(angles))
    ahead = x * np.cos(angles) + y * np.sin(angles) > 0
    hit = np.isfinite(found)
    if away < radius - 1e-9:
        assert hit.all()
    elif away > radius + 1e-9:
        assert hit[ahead & (aside < radius - 1e-9)].all()
        assert not hit[~ahead | (aside > radius + 1e-9)].any()
        assert 2 * hit.sum() <= 360
    ends = found[hit, None] * np.column_stack((np.cos(angles), np.sin(angles)))[hit]
    assert np.hypot(*(ends - (x, y)).T) == pytest.approx(radius, abs=1e-6)


@ENGINES
@pytest.mark.parametrize("seed", range(10))
def test_a_set_of_sheep_is_scanned_as_if_the_others_were_not_there(engine, seed):
    rng = np.random.default_rng(seed)
    sheep, shepherds = rng.uniform(-6, 6, (30, 2)), rng.uniform(-6, 6, (2, 2))
    wild = rng.random(30) < 0.5
    lidar = ALL.but(engine=engine, beams=64)
    obstacle = [circle(2.0, 1.0, 0.7)]
    scene = Scene(sheep.tolist(), shepherds.tolist(), obstacle)
    before = [shape.filter for shapes in scene.sheep_shapes for shape in shapes]
    scan = scene.scan(lidar, masks={"wild": wild, "none": np.zeros(30, bool)})
    assert np.array_equal(scan["wild"], Scene(sheep[wild].tolist(), shepherds.tolist(), obstacle).scan(lidar)["sheep"])
    assert np.isinf(scan["none"]).all()
    assert np.array_equal(scan["sheep"], scene.scan(lidar)["sheep"])
    assert [shape.filter for shapes in scene.sheep_shapes for shape in shapes] == before


def test_hidden_sheep_come_back_when_a_query_fails(monkeypatch):
    scene = Scene(sheep=[(5.0, 0.0)])
    sensor = scene.sensor(ALL.but(engine="pymunk", channels=("goal",)))
    monkeypatch.setattr(sensor, "_query", lambda *_: (_ for _ in ()).throw(RuntimeError("broken")))
    with pytest.raises(RuntimeError, match="broken"):
        sensor.scan(np.array(scene.poses), *GOAL, {"wild": np.array([False])})
    assert scene.sheep_shapes[0][0].filter.categories == SHEEP_CATEGORY != HIDDEN_CATEGORY


def test_a_set_of_sheep_can_be_scanned_without_the_channel_of_all():
    scene = Scene(sheep=[(5.0, 0.0), (3.0, 0.0)])
    scan = scene.by_both(ALL.but(channels=("goal",)), masks={"wild": np.array([True, False])})
    assert scan.names == ("goal", "wild")
    assert scan["wild"][0, 0] == pytest.approx(4.5)


@pytest.mark.parametrize("seed", range(10))
def test_turning_the_world_by_whole_beams_rolls_the_scan(seed):
    rng = np.random.default_rng(seed)
    beams, steps = 64, int(rng.integers(1, 64))
    sheep, goal = rng.uniform(-9, 9, (20, 2)), rng.uniform(-9, 9, 2)
    angle = math.tau * steps / beams
    rotation = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    lidar = ALL.but(beams=beams)
    plain = Scene(sheep.tolist()).scan(lidar, (goal, 2.0)).ranges
    turned = Scene((sheep @ rotation.T).tolist()).scan(lidar, (rotation @ goal, 2.0)).ranges
    assert np.roll(plain, steps, axis=-1) == pytest.approx(turned, abs=1e-6)


def test_a_new_class_of_shape_is_left_to_the_reference():
    class Woolly(pymunk.Circle):
        pass

    scene = Scene(sheep=[(5.0, 0.0)], make_sheep=lambda body: [Woolly(body, 0.5)])
    assert scene.sensor(ALL).engine == "pymunk"
    assert scene.scan(ALL)["sheep"][0, 0] == pytest.approx(4.5)
    with pytest.raises(SettingsError, match=r"Lidar\.engine.*Woolly"):
        scene.sensor(ALL.but(engine="kernel"))
    assert Scene().sensor(ALL).engine == "kernel"
    assert Scene().sensor(ALL.but(engine="pymunk")).engine == "pymunk"


def test_a_scan_is_a_value():
    scan = Scene(sheep=[(5.0, 0.0)]).scan(ALL)
    assert scan["sheep"].shape == (1, 8)
    with pytest.raises(ValueError, match="read-only"):
        scan["sheep"][0, 0] = 1.0
    with pytest.raises(KeyError, match="wolves.*sheep, shepherds, goal, obstacles"):
        scan["wolves"]


# -- settings -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("channels", ()),
        ("channels", ("goal", "sheep")),
        ("channels", ("sheep", "sheep")),
        ("channels", ("wolves",)),
        ("beams", 7),
        ("beams", 512.5),
        ("beams", "many"),
        ("range", 0.0),
        ("range", math.inf),
        ("range", math.nan),
        ("goal_range", -1.0),
        ("sectors", 0),
        ("sectors", 63),
        ("stack", 0),
        ("stack_stride", 0),
        ("frame", "moon"),
        ("layout", "columns"),
        ("goal_inside", "maybe"),
        ("obstacles_cut", "perhaps"),
        ("engine", "warp"),
    ],
)
def test_a_bad_setting_is_named(field, value):
    with pytest.raises(SettingsError, match=field):
        Lidar(**{field: value})
    with pytest.raises(SettingsError, match=field):
        Lidar().but(**{field: value})


def test_the_goal_frame_needs_the_goal():
    with pytest.raises(SettingsError, match=r"frame.*channels"):
        Lidar(channels=("sheep",), frame="goal")
    with pytest.raises(SettingsError, match="rays"):
        Lidar(rays=3)


def test_settings_go_to_plain_data_and_back():
    lidar = Lidar(channels=CHANNELS, sectors=64, frame="goal")
    assert Lidar(**lidar.to_dict()) == lidar
    assert Lidar(**Lidar().to_dict()) == Lidar()
