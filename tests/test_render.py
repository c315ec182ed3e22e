import subprocess
import sys
from dataclasses import fields

import numpy as np
import pymunk
import pytest

from shepherd_phys import canvas
from shepherd_phys.obstacles import Pillar, Polygon, Wall
from shepherd_phys.render import THEMES, Camera, draw, fit, save_png
from shepherd_phys.settings import SettingsError
from shepherd_phys.state import WorldState, frozen, unit

SIZE = (640, 640)
CAMERA = Camera(center=(0.0, 0.0), width=20.0)  # 32 px a metre
LIGHT = THEMES["light"]


def make(sheep, shepherds, obstacles=(), goal=(5.0, 5.0), **changes):
    """A state with sheep and shepherds here, all at rest and facing right."""
    sheep, shepherds, goal = (np.array(at, dtype=float) for at in (sheep, shepherds, goal))
    distance = np.hypot(*(sheep - goal).T)
    n, p = len(sheep), len(shepherds)
    values = {
        "step": 5,
        "time": 1.0,
        "goal_pos": goal,
        "goal_radius": 2.5,
        "sheep_pos": sheep,
        "sheep_vel": np.zeros((n, 2)),
        "sheep_heading": np.tile([1.0, 0.0], (n, 1)),
        "sheep_goal_distance": np.maximum(distance - 2.5, 0),
        "sheep_in_goal": distance <= 2.5,
        "sheep_arrived": distance <= 2.5,
        "sheep_radius": np.full(n, 0.15),
        "sheep_max_speed": np.ones(n),
        "shepherd_pos": shepherds,
        "shepherd_vel": np.zeros((p, 2)),
        "shepherd_angle": np.zeros(p),
        "shepherd_radius": np.full(p, 0.25),
        "shepherd_max_speed": np.full(p, 1.5),
        "shepherd_path": np.zeros(p),
        "collisions": 0,
        "obstacles": tuple(obstacles),
    }
    return WorldState(**{k: frozen(v) if isinstance(v, np.ndarray) else v for k, v in {**values, **changes}.items()})


@pytest.fixture
def state():
    rng = np.random.default_rng(3)
    return make(rng.normal(-3, 1, (40, 2)), [(-8, -8), (-8, 2), (3, -8)]).but(
        sheep_heading=unit(rng.normal(size=(40, 2))), shepherd_vel=[(1, 1), (0, 0), (-1, 0.5)], collisions=2
    )


def color_at(picture, point, camera=CAMERA, size=SIZE):
    x, y = np.floor(camera.to_pixels(point, size)).astype(int)
    return tuple(picture[y, x].tolist())


def rgb(color):
    return tuple(canvas.rgb(color).astype(int).tolist())


def show(state, **options):
    return draw(state, SIZE, **{"camera": CAMERA, "panel": False, **options})


@pytest.mark.parametrize("size", [(640, 640), (200, 200), (1280, 720), (16, 16), (33, 400)])
@pytest.mark.parametrize("theme", ["light", "dark"])
def test_shape(state, size, theme):
    picture = draw(state, size, theme=theme, influence_radius=10)
    assert picture.shape == (size[1], size[0], 3)
    assert picture.dtype == np.uint8
    assert picture.flags.owndata and picture.flags.writeable and picture.flags.c_contiguous
    assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 10


def test_same_picture_each_time(state):
    options = {"influence_radius": 8.0, "start": state.sheep_pos - 1, "trails": [state.shepherd_pos - 2]}
    first = draw(state, **options)
    twin = first.copy()
    first[:] = 0  # the caller's own: spoils nothing that is kept
    draw(state.but(sheep_pos=state.sheep_pos + 1), **options)
    np.testing.assert_array_equal(draw(state, **options), twin)


def test_state_is_left_alone(state):
    before = {f.name: np.copy(getattr(state, f.name)) for f in fields(state) if f.name != "obstacles"}
    trails = [state.shepherd_pos - 1]
    draw(state, influence_radius=5, trails=trails, start=state.sheep_pos)
    for name, value in before.items():
        np.testing.assert_array_equal(getattr(state, name), value)
    np.testing.assert_array_equal(trails[0], state.shepherd_pos - 1)


def test_camera_there_and_back():
    camera = Camera(center=np.array([3.0, -2.0]), width=30.0)
    points = np.random.default_rng(0).normal(0, 20, (5, 4, 2))
    for size in [(640, 640), (1280, 720), (200, 300)]:
        np.testing.assert_allclose(camera.to_world(camera.to_pixels(points, size), size), points, atol=1e-9)
        np.testing.assert_allclose(camera.to_pixels((3, -2), size), (size[0] / 2, size[1] / 2))
        assert camera.to_pixels((3, 0), size)[1] < size[1] / 2  # y up
        assert camera.to_pixels((18, 0), size)[0] == pytest.approx(size[0])


@pytest.mark.parametrize("theme", ["light", "dark"])
def test_things_are_where_they_should_be(theme):
    look = THEMES[theme]
    state = make([(-4.03, 2.51), (5.0, 6.9)], [(-7.0, -6.0), (1.3, -4.2)])
    picture = show(state, theme=theme)
    assert color_at(picture, (5, 5)) == rgb(look.goal)
    assert color_at(picture, (-4.03, 2.51)) == rgb(look.sheep[0])
    assert color_at(picture, (5, 6.9)) == rgb(look.sheep[2])
    for p, at in enumerate(state.shepherd_pos):
        x, y = np.floor(CAMERA.to_pixels(at, SIZE)).astype(int)
        near = {tuple(c) for c in picture[y - 6 : y + 7, x - 6 : x + 7].reshape(-1, 3).tolist()}
        assert rgb(look.shepherds[p]) in near and rgb(look.shepherds[1 - p]) not in near


def test_threatened_sheep_are_told_apart():
    state = make([(-4, 0), (8, -8), (5, 5)], [(-6, 0), (5, 8)])
    picture = show(state, influence_radius=4.0)
    found = [color_at(picture, at) for at in state.sheep_pos]
    assert found == [rgb(LIGHT.sheep[k]) for k in (1, 0, 3)]


def test_sheep_face_ahead():
    state = make([(0, 0)], [(-8, -8)])
    for heading in [(1, 0), (0, 1), (-1, 0), (0, -1)]:
        zoomed = Camera(center=(0, 0), width=2)
        picture = show(state.but(sheep_heading=[heading]), camera=zoomed)
        assert color_at(picture, 0.72 * 0.15 * np.array(heading), zoomed) == rgb(LIGHT.sheep_face)
        assert color_at(picture, -0.06 * np.array(heading), zoomed) == rgb(LIGHT.sheep[0])


def test_shepherd_points_where_it_goes():
    state = make([(8, -8)], [(0, 0)])
    picture = show(state.but(shepherd_vel=[(0, 1.5)]))
    assert color_at(picture, (0.02, 0.7)) == rgb(LIGHT.shepherds[0])
    assert color_at(picture, (0.02, -0.7)) == color_at(show(state), (0.02, -0.7))
    turned = show(state.but(shepherd_angle=[np.pi / 2]))
    assert (turned != show(state)).any()


class Cross:
    """A user's own obstacle, not hashable."""

    __hash__ = None

    def shapes(self, body):
        box = pymunk.Poly(body, [(-8, -8), (-6, -8), (-6, -6), (-8, -6)], radius=0.5)
        return [box, pymunk.Segment(body, (-5, -7), (-2, -7), 0.3), pymunk.Circle(body, 0.4, (0, -7))]


def test_obstacles_are_where_they_are():
    triangle = Polygon(((-7, 2), (-3, 2), (-5, 6)))
    state = make([(8, -8)], [(9, 0)], [Wall((0, 0), (4, 0), thickness=0.4), Pillar((2, -3), 1.0), triangle, Cross()])
    picture = show(state)
    solid = [(2, 0.1), (4.1, 0), (2, -3), (2.9, -3), (-5, 3), (-5, 5.7), (-7, -7), (-8.4, -7), (-3, -7.2), (0.3, -7)]
    free = [(2, 0.4), (4.4, 0), (3.2, -3), (-6.8, 3), (-5, 6.3), (-5, 1.8), (-8.7, -7), (-8.45, -8.45), (-3, -6.5)]
    for point in solid:
        assert color_at(picture, point) == rgb(LIGHT.obstacle), point
    bare = show(state.but(obstacles=()))
    for point in free:
        assert color_at(picture, point) == color_at(bare, point), point
    with pytest.raises(SettingsError, match=r"obstacles\[0\]"):
        show(state.but(obstacles=(object(),)))


def test_discs_cover_what_they_should():
    """A disc covers as much as it should, wherever it stands, drawn at once or from what is kept."""
    for at in [(20.0, 20.0), (20.25, 19.5), (20.5, 20.75)]:
        for radius in (1.0, 3.25, 9.0):
            for way in ("discs", "hull"):
                sheet = canvas.Canvas((40, 40), "#000000")
                getattr(sheet, way)("#FFFFFF", np.array([at]), radius)
                drawn = sheet.picture()[..., 0].astype(float) / 255
                assert drawn.sum() == pytest.approx(np.pi * radius**2, rel=0.02, abs=0.4)
                middle = (np.indices((40, 40))[::-1] + 0.5) * drawn
                np.testing.assert_allclose(middle.sum(axis=(1, 2)) / drawn.sum(), at, atol=0.05)


def test_large_discs_are_drawn_too():
    sheet = canvas.Canvas((200, 200), "#000000")
    sheet.discs("#FF0000", np.array([(100.0, 100.0)]), 60, edge="#00FF00", edge_width=4)
    picture = sheet.picture()
    assert picture[100, 100].tolist() == [255, 0, 0]
    assert picture[100, 158].tolist() == [0, 255, 0]
    assert picture[100, 162].tolist() == [0, 0, 0]


def test_themes_differ(state):
    light, dark = draw(state), draw(state, theme="dark")
    assert light.mean() > 200 and dark.mean() < 80


def test_trails_fade_and_end_at_the_shepherd():
    state = make([(8, -8)], [(6, 0), (-9, -9)])
    trails = [np.array([(x, 0), (-9, -9)]) for x in np.linspace(-8, 6, 30)]
    change = np.abs(show(state, trails=trails).astype(int) - show(state)).sum(axis=2)
    row = change[319:321].sum(axis=0)
    assert row[80:100].sum() > 0  # about x = -7
    assert row[400:440].sum() > 2 * row[80:120].sum()
    assert change[:300].sum() == 0
    assert (show(state, trails=[state.shepherd_pos] * 9) == show(state)).mean() > 0.99  # nobody walked
    np.testing.assert_array_equal(show(state, trails=[]), show(state))


def test_options_show(state):
    bare = show(state)
    for options in [{"influence_radius": 3.0}, {"start": [(-1.0, -9.0)]}, {"panel": True}]:
        assert (show(state, **options) != bare).any(), options
    assert (draw(state) != draw(state.but(collisions=0))).any()
    assert (draw(state) != draw(state.but(time=99.0))).any()


def test_fit_sees_everything(state):
    trails = [state.shepherd_pos + np.array([0, 30])]
    for size in [(640, 640), (1280, 300), (200, 500)]:
        pixels = fit(state, size, trails=trails).to_pixels(
            np.concatenate([state.sheep_pos, state.shepherd_pos, *trails, [state.goal_pos]]), size
        )
        assert (pixels > 0.05 * np.array(size)).all() and (pixels < 0.95 * np.array(size)).all()
    np.testing.assert_array_equal(
        draw(state, trails=trails), draw(state, trails=trails, camera=fit(state, trails=trails))
    )


@pytest.mark.parametrize(
    "state",
    [
        make([(0, 0)], [(1, 1)]),
        make([(5, 5)] * 4, [(5, 5)] * 3),
        make([(1e9, -1e9), (0, 0)], [(0, 1)]),
        make([(0, 0)], [(0, 1)], [Wall((-1e6, 0), (1e6, 3))], goal=(-1e5, 1e5)),
        make([(0, 0)], [(k, 1) for k in range(12)]),
    ],
    ids=["one each", "all at one place", "far sheep", "far goal and long wall", "more shepherds than colours"],
)
def test_odd_worlds(state):
    trails = [state.shepherd_pos + 1e7, state.shepherd_pos]
    for camera in (None, CAMERA, Camera(center=(0, 0), width=0.01), Camera(center=(1e6, 1e6), width=1e7)):
        picture = draw(state, SIZE, camera=camera, influence_radius=10, trails=trails, start=state.sheep_pos)
        assert picture.shape == (640, 640, 3)


@pytest.mark.parametrize("size", [(0, 10), (640,), (640, 640, 3), (64.5, 64), (10**6, 64), "big", None, (-64, 64)])
def test_bad_size(state, size):
    with pytest.raises(ValueError, match="size"):
        draw(state, size)
    with pytest.raises(ValueError, match="size"):
        fit(state, size)


def test_bad_arguments(state):
    with pytest.raises(ValueError, match="theme"):
        draw(state, theme="pink")
    with pytest.raises(ValueError, match="trails"):
        draw(state, trails=[np.zeros((2, 2))])
    with pytest.raises(ValueError, match="start"):
        draw(state, start=[1.0, 2.0])
    for radius in (0.0, -1.0, np.nan, np.inf):
        with pytest.raises(ValueError, match="influence_radius"):
            draw(state, influence_radius=radius)
    with pytest.raises(ValueError, match="margin"):
        fit(state, margin=0.5)
    with pytest.raises(ValueError, match=r"Camera\.width"):
        Camera(center=(0, 0), width=0)
    with pytest.raises(ValueError, match=r"Camera\.center"):
        Camera(center=(0, np.nan), width=1)


@pytest.mark.parametrize("module", [None, type(sys)("pygame")], ids=["missing", "the other pygame"])
def test_without_pygame(state, monkeypatch, module):
    monkeypatch.setitem(sys.modules, "pygame", module)
    canvas.pygame_ce.cache_clear()
    with pytest.raises(ImportError, match=r"shepherd-phys\[render\]"):
        draw(state)


def test_import_alone_needs_no_pygame_and_drawing_no_display():
    code = (
        "import sys, shepherd_phys.render as r; assert 'pygame' not in sys.modules; "
        "sys.path.insert(0, 'tests'); import test_render as t; t.draw(t.make([(0, 0)], [(1, 1)])); "
        "assert not sys.modules['pygame'].display.get_init()"
    )
    root = __file__.rsplit("tests", 1)[0]
    environment = {"PATH": "", "SDL_VIDEODRIVER": "no such driver"}
    done = subprocess.run([sys.executable, "-W", "error", "-c", code], cwd=root, env=environment, capture_output=True)
    assert (done.returncode, done.stdout) == (0, b""), done.stderr  # and nothing said


def test_save_png(state, tmp_path):
    pygame = canvas.pygame_ce()
    picture = draw(state, (90, 60))
    path = tmp_path / "picture.png"
    path.write_bytes(b"old")
    save_png(picture, path)
    assert [p.name for p in tmp_path.iterdir()] == ["picture.png"]
    np.testing.assert_array_equal(pygame.surfarray.array3d(pygame.image.load(str(path))).transpose(1, 0, 2), picture)
    save_png(picture[:, ::-1], str(path))  # any strides


def test_save_png_whole_or_not_at_all(state, tmp_path, monkeypatch):
    picture = draw(state, (60, 60))
    with pytest.raises(OSError, match=r"cannot be written.*nowhere"):
        save_png(picture, tmp_path / "nowhere" / "picture.png")
    (tmp_path / "folder.png").mkdir()
    with pytest.raises(OSError, match=r"cannot be written.*folder\.png"):
        save_png(picture, tmp_path / "folder.png")
    path = tmp_path / "picture.png"
    path.write_bytes(b"old")

    def full(self, target):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("pathlib.Path.replace", full)
    with pytest.raises(OSError, match=r"No space left"):
        save_png(picture, path)
    assert path.read_bytes() == b"old"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["folder.png", "picture.png"]
    for wrong in [picture[..., 0], picture.astype(float), picture[..., :2], [[[0, 0, 0]]], picture[:0]]:
        with pytest.raises(ValueError, match="picture"):
            save_png(wrong, path)
