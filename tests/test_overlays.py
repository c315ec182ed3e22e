"""What the pictures show besides: beams, true shapes, reward terms; cameras that move."""

import numpy as np
import pytest
from test_render import CAMERA, LIGHT, SIZE, color_at, make, rgb, show

from shepherd_phys.bodies import DifferentialDrive, Disc, Flyer, PolygonRobot
from shepherd_phys.camera import Camera, Smooth
from shepherd_phys.canvas import Canvas
from shepherd_phys.controllers import StrombomTeam
from shepherd_phys.envs import ShepherdingEnv
from shepherd_phys.envs.rewards import ANY, ORIGINAL, WILD, Occlusion, earning_beams
from shepherd_phys.lidar import Lidar, Scan
from shepherd_phys.obstacles import Pillar
from shepherd_phys.overlays import Corner, Panel, Seen, extents, hidden
from shepherd_phys.render import draw
from shepherd_phys.scenario import Scenario
from shepherd_phys.settings import Foreign
from shepherd_phys.state import frozen
from shepherd_phys.world import World

EIGHT = Lidar(channels=("sheep", "shepherds", "goal", "obstacles"), beams=8)


def near(picture, point, color, camera=CAMERA):
    """Whether a pixel within 2 px of the point has more of the colour than of the ground."""
    x, y = np.floor(camera.to_pixels(point, SIZE)).astype(int)
    part = picture[y - 2 : y + 3, x - 2 : x + 3].reshape(-1, 3).astype(float)
    ground, wanted = np.array(rgb(LIGHT.ground), float), np.array(rgb(color), float)
    along = (part - ground) @ (wanted - ground) / ((wanted - ground) @ (wanted - ground))
    across = np.abs(part - ground - along[:, None] * (wanted - ground)).max(axis=1)
    return bool(((along > 0.15) & (across < 25)).any())


def test_beams_end_where_the_scan_says():
    """One shepherd in the middle of a cross: a sheep at 4 m, another shepherd at 5 m, a pillar at 6 m, a goal below."""
    scenario = Scenario(n_sheep=1, n_flocks=1, shepherds=2, obstacles=(Pillar((-7.0, 0.0), 1.0),), goal_pos=(0, -7))
    world = World(scenario)
    drawn = world.reset(0)
    state = world.reset_to(drawn.but(sheep_pos=[(4, 0)], shepherd_pos=[(0, 0), (0, 5)]), 0)
    scan = world.scan(EIGHT)
    ends = {
        "sheep": (0, 3.85, (1, 0)),
        "shepherds": (2, 4.75, (0, 1)),
        "obstacles": (4, 6.0, (-1, 0)),
        "goal": (6, 4.5, (0, -1)),
    }
    bare = show(state)
    picture = show(state, scan=scan)
    for channel, (beam, length, way) in ends.items():
        assert scan[channel][0, beam] == pytest.approx(length, abs=1e-6)
        for share in (0.3, 0.5, 0.8, 0.97):
            assert near(picture, np.array(way) * length * share, LIGHT.beams[channel]), (channel, share)
            assert not near(bare, np.array(way) * length * share, LIGHT.beams[channel]), (channel, share)
        beyond = np.array(way) * (length + 2.6)
        assert color_at(picture, beyond) == color_at(bare, beyond), channel
    for way in [(1, 1), (-1, 1)]:  # nothing is hit there: nothing is drawn
        np.testing.assert_array_equal(color_at(picture, np.array(way) * 2), color_at(bare, np.array(way) * 2))


def test_beams_that_earn_are_drawn_stronger():
    """A sheep 4 m in front of the goal: one beam of eight counts, that of the shepherd who looks past it."""
    scenario = Scenario(n_sheep=1, n_flocks=1, shepherds=2, goal_pos=(8, 0))
    world = World(scenario)
    state = world.reset_to(world.reset(0).but(sheep_pos=[(4, 0)], shepherd_pos=[(0, 0), (0, 5)]), 0)
    scan = world.scan(EIGHT.but(channels=("sheep", "goal")), ("wild",))
    earning = earning_beams(WILD, scan)
    assert np.argwhere(np.isfinite(earning)).tolist() == [[0, 0]]
    assert earning[0, 0] == pytest.approx(3.85)
    picture = show(state, scan=scan, earning=earning)
    assert near(picture, (2, 0), LIGHT.earning) and not near(picture, (4.6, 0), LIGHT.earning)
    assert not near(show(state, scan=scan), (2, 0), LIGHT.earning)


@pytest.mark.parametrize("term", [Occlusion(sheep="any"), Occlusion(), Occlusion(wild_mode="current", alpha=0.0)])
def test_beams_that_earn_are_those_that_are_paid_for(term):
    env = ShepherdingEnv("single", rewards={"occlude": (1.0, term)})
    observation, _ = env.reset(seed=1)
    team = StrombomTeam()
    team.reset(env.user_rng)
    seen = 0
    for _ in range(150):
        env.step(team.act(observation, env.state))
        shares = term.shares(env.state, env.state, env.scan, env.scenario)
        counted = np.isfinite(term.earning(env.scan)).sum(axis=1)
        np.testing.assert_allclose(counted, shares * env.scenario.n_steps, atol=1e-9)
        seen += counted.sum()
    assert seen > 0


def test_schemes_that_pay_for_no_beam():
    scan = Scan(("sheep",), frozen(np.full((1, 2, 8), np.inf)))
    assert earning_beams(ORIGINAL, scan) is None
    assert earning_beams(ANY, None) is None


@pytest.mark.parametrize(
    "ends", [((10, 10), (70, 10)), ((10, 10), (10, 70)), ((70, 20), (10, 50)), ((30, 75), (50, 5))]
)
def test_strokes_are_lines(ends):
    sheet = Canvas((80, 80), "#000000")
    start, end = np.array(ends, dtype=float)
    sheet.strokes("#FFFFFF", start[None], end[None], 2.0, np.ones(1))
    drawn = sheet.picture()[..., 0] / 255
    length = np.linalg.norm(end - start)
    assert drawn.sum() == pytest.approx(2.0 * length + np.pi, rel=0.05)
    middle = (np.indices((80, 80))[::-1] + 0.5) * drawn
    np.testing.assert_allclose(middle.sum(axis=(1, 2)) / drawn.sum(), (start + end) / 2, atol=0.2)


def test_strokes_do_not_add_up_and_may_leave_the_sheet():
    sheet = Canvas((80, 80), "#000000")
    starts, ends = np.array([[-50.0, 40], [40, -1e9], [-9, -9]]), np.array([[150.0, 40], [40, 1e9], [-5, -7]])
    sheet.strokes("#FFFFFF", starts, ends, 4.0, np.array([0.5, 0.25, 1.0]))
    drawn = sheet.picture()[..., 0]
    assert drawn[40, 40] == drawn[40, 5] == drawn[40, 75] == 128 and drawn[10, 40] == 64
    assert drawn.max() == 128


NEAR = Camera(center=(0.0, 0.0), width=4.0)  # 160 px a metre


def test_robots_with_corners_are_drawn_true():
    robot = PolygonRobot(vertices=((0.8, -0.2), (0.8, 0.2), (-0.8, 0.2), (-0.8, -0.2)))
    scenario = Scenario(n_sheep=1, n_flocks=1, shepherds=(robot,))
    state = make(
        [(8, -8)], [(0, 0)], shepherd_angle=np.array([np.pi / 2]), shepherd_radius=np.array([np.hypot(0.8, 0.2)])
    )
    shown = show(state, camera=NEAR, scenario=scenario)
    paint = rgb(LIGHT.shepherds[0])
    assert [color_at(shown, at, NEAR) == paint for at in [(0, -0.7), (0.15, -0.7), (0.4, 0), (0.7, 0)]] == [1, 1, 0, 0]
    disc = show(state, camera=NEAR)
    assert color_at(disc, (0.5, 0), NEAR) == paint  # the disc that holds it
    foreign = scenario.but(shepherds=(Foreign("mine:Robot", {}),))
    np.testing.assert_array_equal(show(state, camera=NEAR, scenario=foreign), disc)


def test_sheep_with_corners_are_drawn_true():
    wedge = PolygonRobot(vertices=((0.9, 0.0), (-0.45, 0.4), (-0.45, -0.4)))
    scenario = Scenario(n_sheep=2, n_flocks=1, shepherds=0, sheep=(wedge, Disc(radius=0.3)))
    state = make([(0, 0), (1.5, 1)], np.zeros((0, 2)), sheep_radius=np.array([0.9, 0.3]))
    shown = show(state.but(sheep_heading=[(0, 1), (1, 0)]), camera=NEAR, scenario=scenario)
    white = rgb(LIGHT.sheep[0])
    assert [color_at(shown, at, NEAR) == white for at in [(0, 0), (0, 0.2), (0.6, 0.0), (0, -0.6)]] == [1, 1, 0, 0]
    assert color_at(shown, (1.5, 0.9), NEAR) == white


@pytest.mark.parametrize("body", [DifferentialDrive(radius=0.5, track=0.8), Flyer(radius=0.5)])
def test_what_moves_a_robot_is_seen(body):
    state = make([(8, -8)], [(0, 0)], shepherd_radius=np.array([0.5]))
    plain = show(state, camera=NEAR)
    shown = show(state, camera=NEAR, scenario=Scenario(n_sheep=1, n_flocks=1, shepherds=(body,)))
    assert (shown != plain).any(axis=2).sum() > 200
    assert color_at(shown, (0.2, 0), NEAR) == color_at(plain, (0.2, 0), NEAR)


def test_panel_title_and_the_chosen_one():
    state = make([(0, 0)], [(1, 1), (2, -2)])
    bare = draw(state)
    for options in [{"rewards": {"occupy": 1.25, "distance": -0.5}}, {"title": "collie\nseed 3"}, {"chosen": 1}]:
        assert (draw(state, **options) != bare).any(), options
    assert (draw(state, rewards={"a": 1.0}) != draw(state, rewards={"a": 2.0})).any()
    np.testing.assert_array_equal(draw(state, (64, 64), title="x" * 99, rewards={"a": 1.0}), draw(state, (64, 64)))


@pytest.mark.parametrize("size", [(160, 160), (240, 180), (320, 240), (640, 640), (1280, 720)])
@pytest.mark.parametrize("corner", [(-1, 1), (1, 1), (-1, -1), (1, -1)])
def test_the_panel_hides_nobody_who_can_be_spared(size, corner):
    """A flock in one corner, a shepherd in the one across it."""
    away, options = (
        np.array(corner) * 8 * (size[0] / size[1], 1),
        {"camera": Camera(center=(0, 0), width=20 * size[0] / size[1])},
    )
    state = make(away + np.random.default_rng(1).uniform(-1, 1, (30, 2)), [-away, (0, 0)], goal=(0, 5))
    bare = draw(state, size, panel=False, title="collie\nseed 3", **options)
    told = draw(state, size, title="collie\nseed 3", rewards={"occupy": 1.0, "distance": -0.2}, **options)
    assert (told != bare).any(axis=2).sum() > 1000
    x, y = np.floor(options["camera"].to_pixels([*state.sheep_pos, *state.shepherd_pos], size)).astype(int).T
    np.testing.assert_array_equal(told[y, x], bare[y, x])


def test_the_corner_is_kept_while_nothing_is_hidden():
    boxes = {"upper left": (10, 10, 100, 100), "upper right": (290, 10, 100, 100)}
    boxes |= {"lower left": (10, 290, 100, 100), "lower right": (290, 290, 100, 100)}

    def points(at, weights=1.0, obstacles=()):
        boxed = [extents(np.array(xy, dtype=float).reshape(-1, 2), np.zeros(len(xy))) for xy in (at, obstacles)]
        return Seen(boxed[0], np.broadcast_to(weights, len(at)), boxed[1])

    corner = Corner()
    walk = [(200, 200), (50, 50), (105, 50), (125, 50), (200, 50), (280, 50), (300, 50), (380, 50), (200, 50)]
    names = [corner(boxes, points([at])) for at in walk]
    assert names == ["upper left"] + 5 * ["upper right"] + 3 * ["upper left"]
    everywhere = np.array([(x + dx, y) for x in (60, 340) for y in (60, 340) for dx in (-20, 0, 20)])
    assert corner(boxes, points(everywhere)) == "upper left"  # no other is better
    assert corner(boxes, points(everywhere, np.where(everywhere[:, 0] > 300, 0.5, 1.0))) == "upper right"
    near = np.array([(50, 50), (120, 300), (280, 300)])  # beside both of the lower ones: the calm one is taken
    assert Corner()(boxes, points(near, [1.0, 1.0, 2.0])) == "upper right"

    rocks = [(50, 50), (350, 50), (60, 340)]  # better nothing than a rock, better many rocks than somebody
    corner = Corner()
    assert corner(boxes, points([(200, 200)], obstacles=rocks)) == "lower right"
    assert corner(boxes, points([(300, 300)], obstacles=[*rocks, (60, 60), (350, 60)])) == "lower left"
    assert corner(boxes, points([(200, 200)], obstacles=rocks)) == "lower left"  # nobody is hidden: it stays


def test_what_is_hidden_in_part_is_hidden():
    box, one = (10, 10, 20, 20), np.ones(1)
    beside = np.array([(35.0, 20.0)])
    assert [hidden(box, extents(beside, reach * one), one) for reach in (0, 4, 6)] == [0, 0, 1]
    assert [hidden(box, extents(beside, 0 * one), one, around) for around in (0, 4, 6)] == [0, 0, 1]


@pytest.mark.parametrize(
    ("at", "vel"),
    [((5.5, 3.7), (0, 0)), ((5.5, 3.7), (0.1, 0.1)), ((5.5, 3.0), (0, 1.5)), ((4.2, 8), (1.5, 0)), ((5.5, 8), (0, 0))],
)
@pytest.mark.parametrize("chosen", [None, 1])
def test_the_panel_leaves_before_it_covers_any_part_of_a_shepherd(at, vel, chosen):
    """One stands in the upper left, whence the panel stands upper right; the other comes under its edge."""
    corner, options = Corner(), {"camera": CAMERA, "title": "collie\nseed 3", "rewards": {"a": 1.0, "b": 2.0, "c": 3.0}}
    start = make([(0, 0)], [(-8, 8), (0, -3)], goal=(0, 0))
    draw(start, (640, 640), panel=corner, **options)
    assert corner.name == "upper right"
    state = start.but(shepherd_pos=[(-8, 8), at], shepherd_vel=[(0, 0), vel])
    told = draw(state, (640, 640), panel=corner, chosen=chosen, **options)
    bare = draw(state, (640, 640), panel=False, chosen=chosen, **options)
    assert corner.name == "lower left"
    upper = slice(0, 320)
    np.testing.assert_array_equal(told[upper], bare[upper])


def test_small_pictures_tell_less_before_they_tell_nothing():
    state = make([(0, 0)], [(1, 1), (2, -2)])
    sizes = [
        Panel(Canvas((side, side), "#FFFFFF"), state, {"a": 1.0, "b": 2.0}, LIGHT).size for side in (640, 200, 140, 40)
    ]
    widths, heights = zip(*sizes, strict=True)
    assert list(widths) == sorted(widths, reverse=True) and list(heights) == sorted(heights, reverse=True)
    assert len(set(sizes)) == 4 and sizes[-1] == (0, 0)


def test_bad_scans():
    state = make([(0, 0)], [(1, 1), (2, -2)])
    with pytest.raises(ValueError, match="scan: must be of 2 shepherds"):
        draw(state, scan=Scan(("sheep",), np.zeros((1, 3, 8))))
    with pytest.raises(ValueError, match="earning: must be"):
        draw(state, earning=np.zeros((3, 8)))


def test_smooth_camera():
    camera, far = Smooth(2.0), Camera(center=(10, -4), width=40)
    assert camera(CAMERA, 5.0) == CAMERA  # at once, at first
    after = camera(far, 7.0)  # a time constant later: 1 - 1/e of the way
    np.testing.assert_allclose(after.center, np.array(far.center) * (1 - np.exp(-1)))
    assert after.width == pytest.approx(20 * 2 ** (1 - np.exp(-1)))
    assert camera(CAMERA, 7.0) == after  # no time has passed
    twin = Smooth(2.0)
    twin(CAMERA, 5.0)
    twin(far, 6.0)
    np.testing.assert_allclose(twin(far, 7.0).center, after.center)  # in however many pictures
    assert camera(far, 1e6).width == pytest.approx(40)
    camera.reset()
    assert camera(CAMERA, 0.0) == CAMERA
    with pytest.raises(ValueError, match="seconds"):
        Smooth(0.0)
