"""Scenario, bodies and obstacles as values: validation, copies, TOML both ways, a user's own classes."""

import dataclasses
import math
import pickle
import re

import numpy as np
import pymunk
import pytest
from hypothesis import given
from hypothesis import strategies as st

from shepherd_phys.bodies import Disc, built
from shepherd_phys.flock import Strombom
from shepherd_phys.obstacles import Pillar, Polygon, Wall
from shepherd_phys.scenario import SCENARIOS, Scenario, load_scenario
from shepherd_phys.settings import Foreign, SettingsError, write_toml
from shepherd_phys.world import World


@dataclasses.dataclass(frozen=True)
class Hexagon:
    """A user's body: a hexagon that turns as it is told."""

    size: float = 0.3
    max_speed: float = 1.2

    def build(self):
        corners = [(self.size * math.cos(a), self.size * math.sin(a)) for a in np.arange(6) * math.pi / 3]
        body = pymunk.Body(4.0, pymunk.moment_for_poly(4.0, corners))
        return body, [pymunk.Poly(body, corners)]

    def follow(self, pose, wanted, dt):
        return wanted, 0.5


def test_defaults_are_the_papers_world():
    s = Scenario()
    assert (s.n_sheep, s.n_flocks, s.n_shepherds, s.n_steps) == (100, 2, 3, 1000)
    assert (s.control_dt, s.goal_radius, s.box, s.flock_distance, s.flock_sd) == (0.2, 2.5, 50.0, (10.0, 20.0), 1.0)
    assert (s.sheep.radius, s.sheep.mass, s.sheep.max_speed) == (0.15, 1.0, 1.0)
    assert [(b.radius, b.mass, b.max_speed) for b in s.shepherds] == [(0.25, 5.0, 1.5)] * 3
    assert s.collision_slop == 0.005
    assert s.max_acceleration == 30.0
    assert not s.terminate_on_success


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"n_sheep": 0}, "Scenario.n_sheep: .*greater than or equal to 1.*given: 0"),
        ({"n_sheeps": 5}, "Scenario.n_sheeps: there is no such field .*given: 5.*n_sheep"),
        ({"n_flocks": 101}, "n_flocks is 101, more than there are sheep"),
        ({"flock_sizes": (50, 51)}, r"flock_sizes: needs 2 sizes, .* add up to the 100 sheep \(given: \(50, 51\)\)"),
        ({"flock_sizes": (40, 30, 30)}, r"flock_sizes: needs 2 sizes, one a flock"),
        ({"flock_sizes": (100, 0)}, r"Scenario.flock_sizes\[1\]: .*greater than or equal to 1"),
        ({"flock_distance": (20, 10)}, r"Scenario.flock_distance: the smaller number comes first \(given: \(20, 10\)"),
        ({"goal_radius": float("nan")}, "Scenario.goal_radius: .*finite"),
        ({"box": math.inf}, "Scenario.box: .*finite"),
        ({"goal_pos": (0.0, math.nan)}, r"Scenario.goal_pos\[1\]: .*finite"),
        ({"shepherds": -1}, "Scenario.shepherds: a number of shepherds lies in"),
        ({"shepherds": "three"}, "Scenario.shepherds: give bodies, or how many"),
        ({"control_dt": 0}, "Scenario.control_dt: .*greater than 0"),
        ({"substeps": 1.5}, "Scenario.substeps: .*integer"),
    ],
)
def test_impossible_settings_name_field_value_and_what_is_allowed(changes, message):
    with pytest.raises(SettingsError, match=message):
        Scenario().but(**changes)


def test_constructor_errors_read_the_same():
    with pytest.raises(SettingsError, match="Scenario.n_sheeps: there is no such field"):
        Scenario(n_sheeps=3)
    with pytest.raises(SettingsError, match=r"Disc.radius: .*greater than 0.*given: -1"):
        Disc(-1)
    with pytest.raises(SettingsError, match="Wall.end: Field required"):
        Wall(start=(0, 0))


def test_but_leaves_the_original_alone_and_values_are_frozen():
    s = SCENARIOS["paper"]
    t = s.but(n_flocks=3, shepherds=(Disc(), Hexagon()))
    assert (s.n_flocks, s.n_shepherds, t.n_flocks, t.n_shepherds) == (2, 3, 3, 2)
    with pytest.raises(dataclasses.FrozenInstanceError):
        s.n_sheep = 5
    assert s == Scenario() and s != t
    assert pickle.loads(pickle.dumps(t)) == t


RICH = Scenario(
    n_sheep=7,
    n_flocks=1,
    goal_pos=(1.0, -2.0),
    shepherds=(Disc(radius=0.3), Hexagon(size=0.4)),
    flock=Strombom(n_neighbours=5),
    obstacles=(Wall((0, 0), (1, 1)), Pillar((5, 5), 0.4), Polygon(((8, 8), (9, 8), (8, 9)))),
    terminate_on_success=True,
)


def test_toml_round_trip(tmp_path):
    path = tmp_path / "scenario.toml"
    RICH.to_toml(path)
    assert Scenario.from_toml(path, classes=[Hexagon]) == RICH
    for scenario in SCENARIOS.values():
        scenario.to_toml(path)
        assert Scenario.from_toml(path) == scenario
        assert load_scenario(path) == scenario


def test_a_users_class_in_a_file_stays_text_until_it_is_handed_over(tmp_path):
    path = tmp_path / "scenario.toml"
    RICH.to_toml(path)
    read = Scenario.from_toml(path)
    assert isinstance(read.shepherds[1], Foreign)
    assert read.shepherds[1].kind.endswith(":Hexagon")
    assert read.to_dict() == RICH.to_dict()
    with pytest.raises(SettingsError, match="Hexagon' is a class of somebody's own and was not handed over"):
        World(read)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("n_sheep = ", "is not a TOML file"),
        ("n_sheep = 0", "Scenario.n_sheep"),
        ("colour = 1", "Scenario.colour: there is no such field"),
        ("[flock]\nkind = 'Birds'", "Scenario.flock.kind: unknown kind 'Birds'; known: Reynolds, Strombom"),
        ("[flock]\nn_neighbours = 3", "Scenario.flock: needs a table with a kind"),
        ("flock = 3", "Scenario.flock: needs a table with a kind"),
        ("[[shepherds]]\nkind = 'Disc'\nwheels = 3", "Disc.wheels: there is no such field"),
        ("obstacles = 3", "Scenario.obstacles: must be a list of tables"),
        ("[[obstacles]]\nkind = 'Wall'\nstart = [0, 0]\nend = [1, 0]\nthickness = 0.05", "Wall.thickness.*0.1.*0.05"),
    ],
)
def test_bad_files_give_one_clear_error(tmp_path, text, message):
    path = tmp_path / "bad.toml"
    path.write_text(text)
    with pytest.raises(SettingsError, match=message):
        load_scenario(path)


def test_missing_file_and_unknown_preset():
    with pytest.raises(SettingsError, match=re.escape("nowhere.toml: cannot be read (No such file or directory)")):
        load_scenario("nowhere.toml")
    with pytest.raises(SettingsError, match="'desert' is neither a .toml file nor one of paper"):
        load_scenario("desert")


@given(st.integers(1, 300), st.floats(0.1, 5), st.floats(0.5, 20), st.integers(0, 6))
def test_any_valid_scenario_survives_plain_data(n_sheep, sd, radius, n_shepherds):
    s = Scenario(n_sheep=n_sheep, n_flocks=1, flock_sd=sd, goal_radius=radius, shepherds=n_shepherds)
    assert Scenario.from_dict(s.to_dict()) == s


# ---------------------------------------------------------------- obstacles


def test_polygon_is_kept_counter_clockwise():
    assert Polygon(((0, 0), (0, 1), (1, 0))).vertices == ((1, 0), (0, 1), (0, 0))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Wall((0, 0), (0, 0)), "start and end are the same point"),
        (lambda: Wall((0, 0), (1, 0), 0.09), "Wall.thickness.*0.1"),
        (lambda: Pillar((0, 0), 0.01), "Pillar.radius"),
        (lambda: Polygon(((0, 0), (1, 0))), "Polygon.vertices.*at least 3"),
        (lambda: Polygon(((0, 0), (1, 0), (2, 0))), "convex"),
        (lambda: Polygon(((0, 0), (4, 0), (1, 1), (0, 4))), "convex"),
        (lambda: Polygon(((0, 0), (4, 0), (4, 0.05), (0, 0.05))), "0.05 m thick"),
        (
            lambda: Polygon(tuple((math.cos(4 * math.pi * k / 5), math.sin(4 * math.pi * k / 5)) for k in range(5))),
            "once round",
        ),
        (lambda: Pillar((0, math.inf), 1.0), r"Pillar.center\[1\]"),
    ],
)
def test_impossible_obstacles_are_refused(make, message):
    with pytest.raises(SettingsError, match=message):
        make()


# ------------------------------------------------------------------- bodies


def _body(build, max_speed=1.0):
    class Mine:
        def follow(self, pose, wanted, dt):
            return wanted, 0.0

    Mine.build = build
    Mine.max_speed = max_speed
    return Mine()


def _with_circle(mass=1.0, moment=math.inf, radius=0.3, kind=pymunk.Body.DYNAMIC):
    def build(self):
        body = pymunk.Body(mass, moment, kind)
        return body, [pymunk.Circle(body, radius)]

    return build


@pytest.mark.parametrize(
    ("body", "message"),
    [
        (_body(_with_circle(mass=0)), r"shepherd 0 \(.*Mine\).build: mass must be finite and above 0"),
        (_body(_with_circle(moment=0)), "moment above 0"),
        (_body(_with_circle(radius=math.nan)), "shapes must be finite"),
        (_body(_with_circle(kind=pymunk.Body.STATIC)), "must be dynamic"),
        (_body(lambda self: (pymunk.Body(1, 1), [])), "at least one shape"),
        (_body(lambda self: (pymunk.Body(1, 1), [pymunk.Circle(pymunk.Body(1, 1), 1)])), "another body"),
        (_body(_with_circle(), max_speed=math.nan), "max_speed: must be a finite number above 0"),
        (object(), "a body needs 'build'"),
    ],
)
def test_broken_bodies_are_named(body, message):
    with pytest.raises(SettingsError, match=message):
        World(Scenario(n_sheep=3, n_flocks=1, shepherds=(body,))).reset(0)


def test_reach_holds_every_shape():
    body = pymunk.Body(1.0, 1.0)
    shapes = [
        pymunk.Circle(body, 0.1, (0.2, 0.0)),
        pymunk.Segment(body, (0, 0), (0, 0.5), 0.05),
        pymunk.Poly(body, [(0, 0), (-0.3, 0), (0, -0.4)], radius=0.02),
    ]

    class Odd:
        max_speed = 1.0

        def build(self):
            return body, shapes

        def follow(self, pose, wanted, dt):
            return wanted, 0.0

    assert built(Odd(), "it")[2] == pytest.approx(0.55)
    assert [shape.friction for shape in shapes] == [0.0] * 3


# ------------------------------------------------- a user's own, to a file and back


class Silent:
    """A flock model that keeps its parameter to itself."""

    def __init__(self, pace=0.5):
        self.pace = pace

    def velocities(self, state, rng):
        return np.full((state.n_sheep, 2), self.pace)


class Slotted(Silent):
    __slots__ = ("pace",)


class Told(Silent):
    def to_dict(self):
        return {"pace": self.pace, "table": None}

    def __init__(self, pace=0.5, table=None):
        super().__init__(pace)


class Stateless:
    def velocities(self, state, rng):
        return np.zeros((state.n_sheep, 2))


@dataclasses.dataclass(frozen=True)
class Rich:
    """All that a dataclass may hold."""

    count: object = np.int64(3)
    table: object = dataclasses.field(default_factory=lambda: {"a": (1, np.float32(0.5))})
    rows: object = dataclasses.field(default_factory=lambda: np.eye(2))


@pytest.mark.parametrize("thing", [Silent(), Slotted(2.0)])
def test_parameters_that_nobody_tells_are_refused_only_when_written(thing, tmp_path):
    scenario = SCENARIOS["small"].but(flock=thing)
    World(scenario).reset(0)
    name = type(thing).__name__
    with pytest.raises(SettingsError, match=rf":{name}: cannot be written.*make the class a dataclass, or give it to_"):
        scenario.to_dict()
    with pytest.raises(SettingsError, match=name):
        scenario.to_toml(tmp_path / "scenario.toml")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("thing", [None, {1, 2}, 1j])
def test_what_has_no_place_in_a_file_is_refused(thing):
    with pytest.raises(SettingsError, match=f"builtins:{type(thing).__name__}: cannot be written"):
        SCENARIOS["small"].but(obstacles=(Rich(table=(thing,)),)).to_dict()


def test_a_plain_class_that_tells_its_parameters_survives_a_file(tmp_path):
    path = tmp_path / "scenario.toml"
    SCENARIOS["small"].but(flock=Told(0.25)).to_toml(path)
    assert Scenario.from_toml(path, classes=[Told]).flock.pace == 0.25
    SCENARIOS["small"].but(flock=Stateless()).to_toml(path)
    assert isinstance(Scenario.from_toml(path, classes=[Stateless]).flock, Stateless)


def test_numpy_and_tables_in_a_users_dataclass_are_written():
    (table,) = SCENARIOS["small"].but(obstacles=(Rich(),)).to_dict()["obstacles"]
    assert table.pop("kind").endswith(":Rich")
    assert table == {"count": 3, "table": {"a": [1, 0.5]}, "rows": [[1.0, 0.0], [0.0, 1.0]]}


def test_a_parameter_cannot_be_called_kind():
    @dataclasses.dataclass(frozen=True)
    class Rock:
        kind: str = "granite"

    with pytest.raises(SettingsError, match=r"Rock\.kind: a parameter needs another name"):
        SCENARIOS["small"].but(obstacles=(Rock(),)).to_dict()


def test_a_users_class_that_refuses_its_values_is_named():
    @dataclasses.dataclass(frozen=True)
    class Rock:
        size: float

        def __post_init__(self):
            raise ValueError("too small")

    kind = f"{Rock.__module__}:{Rock.__qualname__}"
    with pytest.raises(SettingsError, match=r"^Scenario.obstacles\[0\]: .*Rock: too small$"):
        Scenario.from_dict({"obstacles": [{"kind": kind, "size": 1.0}]}, classes=[Rock])


def test_a_file_that_cannot_be_written_is_named_and_leaves_nothing(tmp_path):
    lost = tmp_path / "nowhere" / "scenario.toml"
    with pytest.raises(SettingsError, match=re.escape(f"{lost}: cannot be written (No such file or directory)")):
        SCENARIOS["small"].to_toml(lost)
    taken = tmp_path / "taken.toml"
    taken.mkdir()
    with pytest.raises(SettingsError, match="taken.toml: cannot be written"):
        SCENARIOS["small"].to_toml(taken)
    with pytest.raises(SettingsError, match="t.toml: cannot be written"):
        write_toml({"a": object()}, tmp_path / "t.toml")
    assert list(tmp_path.iterdir()) == [taken]
