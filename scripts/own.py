"""A user's own classes on the command line: ``module:Name`` becomes a class, and a scenario has things of it."""

from __future__ import annotations

import hashlib
import importlib
import inspect
import os
import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from shepherd_phys.bodies import BODIES, Body, Disc
from shepherd_phys.envs.rewards import Scheme, checked, earned, scans_for
from shepherd_phys.flock import FLOCKS, FlockModel
from shepherd_phys.lidar import Lidar
from shepherd_phys.scenario import Scenario, load_scenario
from shepherd_phys.settings import SettingsError, check_call, kind_of, meant
from shepherd_phys.workers import explain
from shepherd_phys.world import World


def find_kinds(body: str | None, flock: str | None) -> dict[str, Any]:
    """The classes that ``--body`` and ``--flock`` name, where they are given; a flock model may be a function.

    Raises:
        SettingsError: there is none of a name.
    """
    kinds = {}
    if body is not None:
        kinds["body"] = find_class(body, BODIES, "body")
    if flock is not None:
        kinds["flock"] = find_class(flock, FLOCKS, "flock", or_function=True)
    return kinds


def find_scenario(name: str, classes: Iterable[type[Any]] = ()) -> Scenario:
    """A preset by its name, from a TOML file, or ``module:Name`` of a user's own or of a function that makes one.

    Raises:
        SettingsError: there is none.
    """
    if ":" not in name or name.endswith(".toml"):
        return load_scenario(name, classes)
    own = imported(name, "scenario")
    if inspect.isroutine(own):
        check_call(own, (), f"scenario: {name}")
        try:
            own = own()
        except SettingsError:
            raise
        except Exception as error:
            raise SettingsError(f"scenario: {name}: cannot be made: {explain(error)}") from None
    if not isinstance(own, Scenario):
        raise SettingsError(f"scenario: {name}: needs a Scenario (given: {own!r})")
    return own


def of_kinds(base: Scenario, kinds: Mapping[str, Any]) -> tuple[Scenario, Any]:
    """A scenario with all shepherds' bodies, or its flock model, of the classes of `find_kinds`, or that function.

    What is of the class already stays; everything else becomes one made without arguments.

    Returns:
        the scenario, and the body of a shepherd that it does not have yet.

    Raises:
        SettingsError: an object cannot be made, or lacks something.
    """
    default: Any = Disc()
    flock, body = kinds.get("flock"), kinds.get("body")
    if inspect.isroutine(flock):
        base = base.but(flock=flock)
    elif flock is not None and type(base.flock) is not flock:
        base = base.but(flock=_made(flock, FlockModel, f"flock: {kind_of(flock)}"))
    if body is not None and (not base.shepherds or any(type(own) is not body for own in base.shepherds)):
        default = _made(body, Body, f"body: {kind_of(body)}")
        base = base.but(shepherds=tuple(own if type(own) is body else default for own in base.shepherds))
    return base, default


def find_reward(name: str) -> Scheme | str:
    """A scheme's name, or the scheme ``module:Name`` of a user's own.

    Raises:
        SettingsError: it is no scheme.
    """
    if ":" not in name:
        return name
    own = imported(name, "reward")
    if not isinstance(own, Mapping):
        raise SettingsError(
            f"reward: {name}: needs a scheme, a dict of name -> (weight, term) (its type: {type(own).__name__})"
        )
    try:
        return checked(own)
    except SettingsError as error:
        raise SettingsError(f"reward: {name}: {error}") from None


def own_classes(scenario: Scenario | None, reward: Scheme | str | None) -> list[Any]:
    """The classes and functions, not of the library, of a scenario and a reward: what reads them back is given them."""
    things: list[Any] = []
    if scenario is not None:
        things += [*scenario.shepherds, *scenario.sheep_kinds, scenario.flock, *scenario.obstacles, scenario.layout]
    if isinstance(reward, Mapping):
        things += [term for _, term in reward.values()]
    made_by = [thing if inspect.isroutine(thing) else type(thing) for thing in things if thing is not None]
    return [maker for maker in dict.fromkeys(made_by) if ":" in kind_of(maker)]


def try_out(world: World, seeds: Sequence[int], scheme: Scheme | None = None, lidar: Lidar | None = None) -> None:
    """Find out before anything is made what a user's own classes get wrong.

    The world is placed on the first of the seeds on which it can be; then all shepherds ask for top speed for one
    control step, for which they are rewarded.

    Args:
        world: of the scenario.
        seeds: not none.
        scheme: of the rewards, where some are given.
        lidar: with which they are given.

    Raises:
        SettingsError: it cannot be placed on any, or a class failed.
    """
    try:
        for i, seed in enumerate(seeds, start=1):
            try:
                world.reset(seed)
                break
            except SettingsError:
                if i == len(seeds):
                    raise
        before = world.state
        after = world.step(np.tile([1.0, 0.0], (world.scenario.n_shepherds, 1)))
        if scheme is not None:
            scanned, sets = scans_for(scheme, lidar)
            scan = None if scanned is None else world.scan(scanned, sets)
            earned(scheme, before, after, scan, world.scenario)
    except SettingsError:
        raise
    except Exception as error:
        raise SettingsError(explain(error)) from None


def find_class(name: str, known: dict[str, type[Any]], where: str, or_function: bool = False) -> Any:
    """A class by its name among ``known`` or by ``module:Name``, which may be that of a function where one will do.

    Raises:
        SettingsError: there is none.
    """
    if ":" not in name:
        if name not in known:
            raise SettingsError(
                f"{where}: {name!r} is unknown; there are {', '.join(sorted(known))}, or module:Name of your own"
                f"{meant(name, known)}"
            )
        return known[name]
    own = imported(name, where)
    if not (inspect.isclass(own) or (or_function and inspect.isroutine(own))):
        wanted = "a class or a function" if or_function else "a class"
        raise SettingsError(f"{where}: {name}: needs {wanted} (its type: {type(own).__name__})")
    return own


def imported(name: str, where: str) -> Any:
    """The object ``module:Name``, its module found from the current directory too.

    Raises:
        SettingsError: it cannot be imported, or the module lacks it.
    """
    module_name, _, attribute = name.partition(":")
    if os.getcwd() not in sys.path:
        sys.path.append(os.getcwd())  # at the end: it must not hide an installed package, ours in a checkout included
    try:
        module = importlib.import_module(module_name)
    except (Exception, SystemExit) as error:
        raise SettingsError(f"{where}: {name}: module {module_name!r} cannot be imported: {explain(error)}") from None
    if not hasattr(module, attribute):
        raise SettingsError(f"{where}: {name}: module {module_name!r} has no {attribute!r}")
    return getattr(module, attribute)


def source_hash(thing: Any) -> str | None:
    """SHA-256 of the file that holds the object's class: an edited class must not find the rows of the old one."""
    try:
        path = inspect.getsourcefile(thing if inspect.isclass(thing) or inspect.isroutine(thing) else type(thing))
        return hashlib.sha256(Path(path or "").read_bytes()).hexdigest()
    except (TypeError, OSError):
        return None


def _made(cls: type[Any], protocol: type[Any], where: str) -> Any:
    """An object of the class.

    Raises:
        SettingsError: it cannot be made without arguments, or lacks something that ``protocol`` asks for.
    """
    try:
        made = cls()
    except TypeError as error:
        raise SettingsError(
            f"{where}: cannot be made without arguments ({error}); a dataclass can be given them in a scenario file"
        ) from None
    except SettingsError:
        raise
    except Exception as error:
        raise SettingsError(f"{where}: cannot be made: {explain(error)}") from None
    lacking = [member for member in vars(protocol) if not member.startswith("_") and not hasattr(made, member)]
    if lacking:
        raise SettingsError(f"{where}: lacks {', '.join(lacking)}")
    return made
