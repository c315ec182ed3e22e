"""The lidar: what each shepherd sees. What of it a policy observes is in `shepherd_phys.observation`.

Two engines give one answer. ``pymunk`` casts every beam with a segment query: it works for any shape that anyone
adds, and is the reference. ``kernel`` computes the same numbers analytically for discs, segments and polygons.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Annotated, Literal

import numpy as np
import pymunk
from numpy.typing import NDArray
from pydantic import AfterValidator, Field

from shepherd_phys import _raycast
from shepherd_phys.geometry import (
    HIDDEN_CATEGORY,
    OBSTACLE_CATEGORY,
    SHEEP_CATEGORY,
    SHEPHERD_CATEGORY,
    Geometry,
)
from shepherd_phys.settings import Settings, SettingsError, settings
from shepherd_phys.state import frozen

Floats = NDArray[np.float64]
Channel = Literal["sheep", "shepherds", "goal", "obstacles"]

CHANNELS: tuple[Channel, ...] = ("sheep", "shepherds", "goal", "obstacles")
"""All channels, in the order in which they are observed."""
_CATEGORIES = {"sheep": SHEEP_CATEGORY, "shepherds": SHEPHERD_CATEGORY, "obstacles": OBSTACLE_CATEGORY}


def _in_order(channels: tuple[Channel, ...]) -> tuple[Channel, ...]:
    if list(channels) != [name for name in CHANNELS if name in channels]:
        raise ValueError(f"each channel once, in the order {', '.join(CHANNELS)}")
    return channels


@settings
class Lidar(Settings):
    """The sensor of a shepherd and the form of its observation. Beam k points at 2 pi k / beams from the x axis."""

    channels: Annotated[tuple[Channel, ...], Field(min_length=1), AfterValidator(_in_order)] = (
        "sheep",
        "shepherds",
        "goal",
    )
    """What is observed; add "obstacles" where the scenario can have them. Channels do not hide one another."""
    beams: int = Field(default=512, ge=8, le=65_536)
    """Beams over the full turn."""
    range: float = Field(default=50.0, gt=0)
    """Greatest reading [m]."""
    goal_range: float = Field(default=75.0, gt=0)
    """Greatest reading of the goal [m]: seen from everywhere in the 50 m box."""
    sectors: int | None = Field(default=None, ge=1)
    """Observe the nearest return of each group of neighbouring beams, so many groups; none: every beam. Divides
    ``beams``; group 0 is centred on beam 0."""
    stack: int = Field(default=3, ge=1, le=1000)
    """Frames in an observation, newest last."""
    stack_stride: int = Field(default=1, ge=1, le=1000)
    """Control steps between two of those frames."""
    frame: Literal["world", "goal"] = "world"
    """"world": beam 0 points along the x axis. "goal": all frames are rolled by whole beams so that beam 0 points
    at the circular mean of the lit goal beams; actions are meant in the same frame."""
    layout: Literal["rows", "paper"] = "rows"
    """"rows": (stack x channels, beams), row = frame x n_channels + channel. "paper": (channels x beams, 1, stack)."""
    goal_inside: Literal["exit", "none"] = "exit"
    """What a shepherd inside the goal reads of it: the way out to the circle, or nothing."""
    obstacles_cut: bool = True
    """Obstacles cut off every channel behind them, observed or not."""
    engine: Literal["auto", "pymunk", "kernel"] = "auto"
    """"auto": the kernel where it knows every shape, else segment queries. Among 1,000 bodies and more the engine keeps
    a grid, and queries may lose a beam that runs exactly through its corners: along an axis from a round number."""

    def __post_init__(self) -> None:
        if self.sectors is not None and self.beams % self.sectors:
            raise ValueError(f"sectors must divide beams (given: sectors {self.sectors}, beams {self.beams})")
        if self.frame == "goal" and "goal" not in self.channels:
            raise ValueError(f"frame 'goal' needs the channel 'goal' (given: channels {self.channels})")

    @property
    def look_back(self) -> int:
        """Frames that an observation looks back over, this one included."""
        return (self.stack - 1) * self.stack_stride + 1

    @property
    def remembered(self) -> int:
        """Numbers in the frames that are kept for one shepherd."""
        return self.look_back * len(self.channels) * self.beams

    def observation_shape(self, n_shepherds: int) -> tuple[int, ...]:
        """Shape of the observation of a team: (P, stack x channels, columns), or (P, channels x columns, 1, stack)."""
        columns = self.sectors or self.beams
        if self.layout == "paper":
            return n_shepherds, len(self.channels) * columns, 1, self.stack
        return n_shepherds, self.stack * len(self.channels), columns


@dataclass(frozen=True, slots=True, eq=False)
class Scan:
    """One reading of all lidars: ``scan["sheep"]`` is (P, beams), the distance to the first hit [m], inf for none."""

    names: tuple[str, ...]
    """The channels of the lidar, then the further sets of sheep that were asked for, such as "wild"."""
    ranges: Floats
    """(len(names), P, beams) [m], read-only."""

    def __getitem__(self, name: str) -> Floats:
        try:
            return self.ranges[self.names.index(name)]  # type: ignore[no-any-return]
        except ValueError:
            raise KeyError(f"the scan has no {name!r}; it has {', '.join(self.names)}") from None


@lru_cache(maxsize=16)
def beam_directions(beams: int) -> Floats:
    """Return the unit vectors of the beams, twice round: (2, 2 beams), cosines and sines, read-only."""
    angles = 2.0 * np.pi * np.arange(beams) / beams
    once = np.array([np.cos(angles), np.sin(angles)])
    # exactly along the axes where a beam is meant to be: walls often are
    for k in range(0, beams, beams // math.gcd(beams, 4)):
        once[:, k] = np.rint(once[:, k])
    return frozen(np.ascontiguousarray(np.concatenate((once, once), axis=1)))


class Sensor:
    """All lidars of one world, bound to its shapes; make one at each reset.

    The world gives the shapes their categories (`shepherd_phys.geometry`), and shepherd k's shapes the group k + 1.
    """

    def __init__(
        self,
        lidar: Lidar,
        geometry: Geometry,
        space: pymunk.Space,
        sheep_shapes: Sequence[Sequence[pymunk.Shape]],
        n_sheep: int,
        n_shepherds: int,
        flies: Sequence[bool] = (),
    ) -> None:
        """Bind.

        Args:
            lidar: the settings.
            geometry: every shape of the world, compiled.
            space: where they stand; only the pymunk engine looks at it. With pymunk's default index: its spatial
                hash loses hits of beams that pass exactly through a corner of cells.
            sheep_shapes: the shapes of each sheep.
            n_sheep: N.
            n_shepherds: P.
            flies: (P,) whether the shepherd flies: it does not see what it is above. Empty: none does.

        Raises:
            SettingsError: the kernel was demanded and does not know a shape.
        """
        if lidar.engine == "kernel" and not geometry.known:
            kinds = ", ".join(sorted({type(shape).__name__ for shape, _, _ in geometry.unknown}))
            raise SettingsError(f"Lidar.engine: the kernel does not know {kinds} (given: 'kernel'); use 'auto'")
        self.lidar = lidar
        self.engine = "pymunk" if lidar.engine == "pymunk" or not geometry.known else "kernel"
        """The engine in use: "kernel" or "pymunk"."""
        self._geometry = geometry
        self._space = space
        self._sheep_shapes = sheep_shapes
        self._n_sheep = n_sheep
        self._n_shepherds = n_shepherds
        self._flies = np.zeros(n_shepherds, np.bool_)
        self._flies[: len(flies)] = flies
        self._directions = beam_directions(lidar.beams)
        self._cuts = lidar.obstacles_cut and geometry.has_obstacles
        self._poses = np.zeros((n_sheep + n_shepherds, 3))
        self._goal = np.zeros(3)
        self._no_masks = np.zeros((0, n_sheep), np.bool_)
        self._names: dict[tuple[str, ...], tuple[str, ...]] = {}
        # obstacles that cut but are not observed take a row behind the named ones
        self._hidden_row = self._cuts and "obstacles" not in lidar.channels
        self._rows = np.array(
            [_row(lidar, "sheep"), _row(lidar, "shepherds"), _row(lidar, "obstacles"), _row(lidar, "goal")], np.int64
        )

    def scan(
        self,
        poses: Floats,
        goal_pos: Floats,
        goal_radius: float,
        masks: Mapping[str, NDArray[np.bool_]] | None = None,
    ) -> Scan:
        """Read all beams of all channels for all shepherds.

        Args:
            poses: (N + P, 3) x, y [m], angle [rad] of the bodies, sheep first.
            goal_pos: (2,) [m].
            goal_radius: [m].
            masks: further sets of sheep by name, (N,) each; each is scanned as if the other sheep were not there.
        """
        self._poses = poses
        self._goal[:2], self._goal[2] = goal_pos, goal_radius
        sets = tuple(masks) if masks else ()
        names = self._names.get(sets)
        if names is None:
            names = self._names[sets] = (*self.lidar.channels, *sets)
        chosen = np.array([masks[name] for name in sets], np.bool_) if masks else self._no_masks
        n_rows = len(names)
        out = np.empty((n_rows + self._hidden_row, self._n_shepherds, self.lidar.beams))
        if self._hidden_row:
            self._rows[2] = n_rows
        if self.engine == "kernel":
            self._scan_by_kernel(out, chosen)
        else:
            self._scan_by_queries(out, chosen)
        ranges = out[:n_rows] if self._hidden_row else out
        return Scan(names, frozen(ranges))

    def _scan_by_kernel(self, out: Floats, masks: NDArray[np.bool_]) -> None:
        lidar = self.lidar
        _raycast.scan_shapes(
            out,
            self._geometry.shapes,
            self._poses,
            self._n_sheep,
            self._goal,
            lidar.goal_inside == "exit",
            self._directions,
            lidar.range,
            lidar.goal_range,
            self._rows,
            masks,
            len(lidar.channels),
            self._flies,
            self._cuts,
        )

    def _scan_by_queries(self, out: Floats, masks: NDArray[np.bool_]) -> None:
        lidar = self.lidar
        out[:] = np.inf
        sheep, shepherds, obstacles, goal = (int(row) for row in self._rows)
        for row, name in ((sheep, "sheep"), (shepherds, "shepherds"), (obstacles, "obstacles")):
            if row >= 0:
                self._query(out[row], _CATEGORIES[name], lidar.range)
        for row, mask in enumerate(masks, start=len(lidar.channels)):
            hidden = [s for shapes, shown in zip(self._sheep_shapes, mask, strict=True) if not shown for s in shapes]
            filters = [shape.filter for shape in hidden]
            try:
                for shape, old in zip(hidden, filters, strict=True):
                    shape.filter = pymunk.ShapeFilter(old.group, HIDDEN_CATEGORY, old.mask)
                self._query(out[row], SHEEP_CATEGORY, lidar.range)
            finally:
                for shape, old in zip(hidden, filters, strict=True):
                    shape.filter = old
        way_out = lidar.goal_inside == "exit"
        for p, (x, y, _) in enumerate(self._poses[self._n_sheep :]):
            if goal >= 0:
                _raycast.cast_goal(out[goal, p], x, y, self._goal, self._directions, lidar.goal_range, way_out)
        if not self._cuts:
            return
        if goal >= 0 and any(_raycast.beyond(row, lidar.range) for row in out[goal]):
            far = np.full_like(out[goal], np.inf)
            self._query(far, OBSTACLE_CATEGORY, lidar.goal_range)
            for p in range(self._n_shepherds):
                _raycast.cut_behind(out[goal, p], far[p], lidar.range)
        for row in range(len(out)):
            if row != obstacles:
                out[row][out[obstacles] < out[row]] = np.inf

    def _query(self, readings: Floats, category: int, reach: float) -> None:
        """Segment queries on shapes of one category into (P, beams) readings [m] full of infinities."""
        ways = (reach * self._directions[:, : self.lidar.beams]).T.tolist()
        for p, (x, y, _) in enumerate(self._poses[self._n_sheep :].tolist()):
            seen = pymunk.ShapeFilter(group=p + 1, mask=category)
            for k, (dx, dy) in enumerate(ways):
                end = (x + dx, y + dy)
                if self._flies[p]:
                    hits = self._space.segment_query((x, y), end, 0.0, seen)
                    alpha = min((hit.alpha for hit in hits if hit.alpha > 0.0), default=1.0)
                else:
                    hit = self._space.segment_query_first((x, y), end, 0.0, seen)
                    alpha = 1.0 if hit is None else hit.alpha
                if alpha < 1.0:
                    readings[p, k] = alpha * reach


def _row(lidar: Lidar, channel: Channel) -> int:
    return lidar.channels.index(channel) if channel in lidar.channels else -1
