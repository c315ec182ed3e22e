"""``shepherd-phys watch``: controllers at work, or replays, in a window, on film or as a page."""

from __future__ import annotations

import contextlib
import signal
import sys
import threading
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from shepherd_phys.camera import MAX_SIZE, checked_size
from shepherd_phys.canvas import pygame_ce
from shepherd_phys.controllers.evaluation import ControllerError
from shepherd_phys.envs.rewards import checked
from shepherd_phys.files import checked_place
from shepherd_phys.film import Picture, checked_film, write_film
from shepherd_phys.render import save_png
from shepherd_phys.replay import Replay
from shepherd_phys.replay_file import load_replay
from shepherd_phys.settings import SettingsError
from shepherd_phys.window import DisplayError, Window

from .command import at_least, fail, flag, parsed
from .player import SPEEDS, Player
from .points import LEAST as WORLD_LEAST
from .points import WorldFlags, strangers
from .sources import Live, Recorded, Source

PROG = "shepherd-phys watch"
WINDOW_FPS = 30
MAX_VIEWS = 2


@dataclass(frozen=True)
class Watch(WorldFlags):
    """Watch controllers at work, live in a window, or write a film of them; H in the window shows the keys.

    Episodes are those of evaluate: trial 0 of --seed first. In the window, arrow keys, W A S D or the mouse take a
    shepherd over; G gives it back. --replay plays files that evaluate --save-replay left, and makes pages of them.
    """

    controllers: Annotated[tuple[str, ...], flag("A [B]")] = ("collie",)
    """A name, a policy's .json file, or module:Name of your own; two of them play the same episode side by side."""
    seed: Annotated[int, flag("S")] = 20_000
    """Root seed, as evaluate's."""
    trial: Annotated[int, flag("I")] = 0
    """The first episode: trial I of the root seed."""
    rewards: Annotated[str, flag("NAME")] = "wild"
    """The scheme whose terms the panel tells, and whose beams are drawn strongest: original, any or wild."""
    replay: Annotated[tuple[Path, ...], flag("FILE [FILE]", "")] = ()
    """Play an episode from a file instead, or two side by side; what is of playing one anew does not go with it."""
    out: Annotated[Path | None, flag("FILE.mp4|.gif|.png|.html", "a window")] = None
    """Write a film, or its last picture, instead of opening a window; it needs no display. A replay can become a page,
    FILE.html, too."""
    steps: Annotated[int | None, flag("N", "the whole episode")] = None
    """Control steps of a film."""
    speed: Annotated[float | None, flag("X", "1; 8 in a film")] = None
    """Seconds of the world in a second."""
    fps: Annotated[int, flag("F")] = 25
    """Pictures a second of a film."""
    size: Annotated[tuple[int, int], flag("W H")] = (640, 640)
    """Of the picture of one controller in pixels."""
    camera: Literal["fit", "follow", "fixed"] = "fit"
    """Keep everything in sight; stay with the sheep; or stand still."""
    beams: tyro.conf.FlagCreatePairsOff[bool] = False
    """Draw the lidar's beams from the start."""
    dark: tyro.conf.FlagCreatePairsOff[bool] = False
    """Dark colours."""


OF_LIVE = ("controllers", "scenario", "flocks", "cohesion", "shepherds", "sheep", "body", "flock", "seed", "trial",
           "rewards", "beams")  # fmt: skip
"""What a replay has settled."""
PAGE, PICTURE = ".html", ".png"
OF_PICTURES = ("steps", "speed", "fps", "size", "camera", "dark")
"""What a page has not."""
LEAST = {**WORLD_LEAST, "seed": 0, "trial": 0, "steps": 1, "fps": 1}


def main(argv: Sequence[str]) -> int:
    """Run the command; the exit status: 0, 1 if something failed, 2 for a mistake of the user, 130 for Ctrl-C."""
    try:
        options = read_options(argv)
        ending = "" if options.out is None else options.out.suffix.lower()
        if options.out is not None and ending in (PICTURE, PAGE):
            checked_place(options.out, "page" if ending == PAGE else "picture")
        replays = [load_replay(path) for path in options.replay]
        if options.out is not None and ending == PAGE:
            return write_pages(replays, options.out)
        pygame_ce()
        if options.out is not None and ending != PICTURE:
            checked_film(options.out, options.fps)
    except (ValueError, OSError, ImportError) as error:
        return fail(PROG, error, 2)
    with contextlib.redirect_stdout(sys.stderr):  # a user's classes may print wherever they are touched
        try:
            sources: list[Source] = [Recorded(replay) for replay in replays] or live(options)
            player = make_player(sources, options)
        except (SettingsError, ControllerError) as error:
            return fail(PROG, error, 2)
        try:
            if options.out is None:
                run(player, Window(player.size, " and ".join(source.name for source in sources)))
            elif ending == PICTURE:
                (last,) = deque(film(player, options), maxlen=1)
                save_png(last, options.out)
                count = 1
            else:
                count = write_film(until_told(film(player, options)), options.out, options.fps)
        except DisplayError as error:
            return fail(PROG, error, 2)
        except (ControllerError, SettingsError, OSError) as error:
            return fail(PROG, error, 1)
    if options.out is not None:
        print(f"{options.out}  ({count} picture{'s' * (count != 1)})")
    return 0


def read_options(argv: Sequence[str]) -> Watch:
    """The options, checked.

    Raises:
        SettingsError: one is unknown or impossible.
        SystemExit: after ``--help``.
    """
    options, given = parsed(Watch, PROG, argv)
    at_least({name: getattr(options, name) for name in LEAST}, LEAST)
    if not 1 <= len(options.controllers) <= MAX_VIEWS:
        raise SettingsError(f"controllers: one or two side by side (given: {len(options.controllers)})")
    if options.speed is not None and not SPEEDS[0] <= options.speed <= 1000:
        raise SettingsError(f"speed: {options.speed} is impossible; it must be from {SPEEDS[0]} to 1000")
    checked(options.rewards)
    checked_size(options.size)
    if options.size[0] * len(options.replay or options.controllers) > MAX_SIZE:
        raise SettingsError(f"size: two pictures side by side are at most {MAX_SIZE} wide (given: {options.size})")
    if len(options.replay) > MAX_VIEWS or ("replay" in given and not options.replay):
        raise SettingsError(f"--replay: one or two side by side (given: {len(options.replay)})")
    is_page = options.out is not None and options.out.suffix.lower() == PAGE
    if is_page and not options.replay:
        raise SettingsError(
            "--out: a page is made of a replay: evaluate --save-replay DIR leaves one of every episode, then "
            f"watch --replay DIR/FILE --out {options.out}"
        )
    if is_page and len(options.replay) != 1:
        raise SettingsError(f"--out: a page is made of one replay, given by --replay (given: {len(options.replay)})")
    for name in (*(OF_LIVE if options.replay else ()), *(OF_PICTURES if is_page else ())):
        if name in given:
            raise SettingsError(f"--{name}: does not go with {f'--out {options.out}' if is_page else '--replay'}")
    for name in ("steps", "fps"):
        if name in given and options.out is None:
            raise SettingsError(f"--{name}: is of a film; give --out FILE.mp4 or FILE.gif, too")
    return options


def write_pages(replays: Sequence[Replay], path: Path) -> int:
    """Make a page of the one replay; the exit status.

    Raises:
        ReplayError: bokeh is missing, or the file cannot be written.
    """
    from .replay_page import write_page  # only now: bokeh takes a while to load

    write_page(replays[0], path)
    print(path)
    return 0


def live(options: Watch) -> list[Source]:
    """Episodes to be played, one a controller, on the same seeds.

    Raises:
        SettingsError: a name is unknown, or a world cannot be made.
        ControllerError: an object given as controller is none.
    """
    # the same one twice is fine: one of them can be led
    points = [options.point(name) for name in options.controllers]
    for line in strangers(points) if options.scenario is None else ():
        print(f"{PROG}: {line}", file=sys.stderr)
    return [Live(point, options.seed, options.trial, options.rewards) for point in points]


def make_player(sources: Sequence[Source], options: Watch) -> Player:
    """The player of these sources.

    Raises:
        SettingsError: no world can be placed.
    """
    w, h = options.size
    return Player(
        sources,
        (w * len(sources), h),
        theme="dark" if options.dark else "light",
        speed=options.speed or (1.0 if options.out is None else 8.0),
        beams="all" if options.beams else "none",
        camera=options.camera,
        keys=options.out is None,
    )


def run(player: Player, window: Window) -> None:
    """Show a player in a window until its user has enough."""
    try:
        window.wait(WINDOW_FPS)
        while player.running:
            for event in window.events():
                player.handle(event)
            player.tick(window.wait(WINDOW_FPS))
            player.size = window.size
            window.show(player.canvas())
    finally:
        window.close()


def film(player: Player, options: Watch) -> Iterator[Picture]:
    """The pictures of a film, from the first state to the last step asked for, or the last there is."""
    yield player.canvas().picture()
    while not player.over:
        seconds = 1.0 / options.fps
        if options.steps is not None:
            left = player.seconds_to(options.steps)
            if left <= 0.0:
                break
            seconds = min(seconds, left)
        player.tick(seconds)
        yield player.canvas().picture()


def until_told(pictures: Iterable[Picture]) -> Iterator[Picture]:
    """The same pictures, until a signal asks this process to end: it does so between two of them, by `SystemExit`.

    So what is half written can be removed. A second signal ends the process at once.
    """
    told: list[int] = []

    def note(number: int, _: object) -> None:
        told.append(number)
        signal.signal(number, signal.SIG_DFL)

    here = threading.current_thread() is threading.main_thread()  # only there may Python handle signals
    names = [name for name in ("SIGTERM", "SIGHUP") if here and hasattr(signal, name)]
    before = {number: signal.signal(number, note) for number in (getattr(signal, name) for name in names)}
    try:
        for picture in pictures:
            if told:
                raise SystemExit(128 + told[0])
            yield picture
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
