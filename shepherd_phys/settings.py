"""How settings are declared, varied, written to TOML and read back.

Every setting of the library is a frozen, validated value beside the code that it governs. This module
holds what they share: the decorator, ``but``, and the two directions of plain data (TOML tables).
"""

from __future__ import annotations

import dataclasses
import difflib
import inspect
import tomllib
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Self, TypeVar, cast, dataclass_transform, get_args

import pydantic
import tomli_w
from pydantic import ConfigDict

from shepherd_phys.files import whole_file

T = TypeVar("T")
MOST_TOLD = 3
"""Unknown fields that an error names."""


class SettingsError(ValueError):
    """A setting is unknown or impossible; the message names the field, the value and what is allowed."""


@dataclass_transform(frozen_default=True, field_specifiers=(dataclasses.field, pydantic.Field))
def settings(cls: type[T]) -> type[T]:
    """Make a class a settings value: frozen, each field validated, unknown fields an error.

    NaN and infinities are refused in every float field.
    """
    config = ConfigDict(extra="forbid", allow_inf_nan=False, arbitrary_types_allowed=True, validate_default=True)
    decorated = pydantic.dataclasses.dataclass(frozen=True, config=config)(cls)
    validating_init = decorated.__init__

    def __init__(self: Any, *args: Any, **values: Any) -> None:
        try:
            validating_init(self, *args, **values)
        except pydantic.ValidationError as error:
            raise SettingsError(_explain(cls, error)) from None
        except TypeError as error:
            raise SettingsError(f"{cls.__name__}: {error}") from None

    __init__.__signature__ = inspect.signature(validating_init)  # type: ignore[attr-defined]
    __init__.__doc__ = validating_init.__doc__
    decorated.__init__ = __init__  # type: ignore[method-assign]
    return cast("type[T]", decorated)


def _explain(cls: type[Any], error: pydantic.ValidationError) -> str:
    """One line for every field that is wrong: where, what was given, what is allowed."""
    names = [f.name for f in dataclasses.fields(cls)]
    problems = error.errors(include_url=False)
    unknown: dict[tuple[Any, ...], dict[str, Any]] = {}  # by where: fields of settings within settings, too
    for problem in problems:
        if problem["type"] == "unexpected_keyword_argument":
            *path, name = problem["loc"]
            unknown.setdefault(tuple(path), {})[str(name)] = problem["input"]
    lines = [
        _no_such_field(_inside(cls, path), found, ".".join([cls.__name__, *map(str, path)]))
        for path, found in unknown.items()
    ]
    for problem in problems:
        if problem["type"] == "unexpected_keyword_argument":
            continue  # all of them are told at once
        if problem["type"] == "default_factory_not_called":
            continue  # its default follows from a field that is wrong, which is told
        path = list(problem["loc"])
        if path and isinstance(path[0], int) and path[0] < len(names):
            path[0] = names[path[0]]  # a positional argument: say which field it fills
        where = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in path)
        message = problem["msg"].removeprefix("Value error, ")
        whole = not path or problem["type"] == "missing"
        lines.append(f"{cls.__name__}{where}: {message}" + ("" if whole else f" (given: {_brief(problem['input'])})"))
    return "; ".join(lines)


def _inside(cls: type[Any], path: Iterable[Any]) -> type[Any]:
    """The settings class of what is at ``path``; of what it is in, where there are several."""
    for name in path:
        field = cls.__pydantic_fields__.get(name)
        kinds = () if field is None else (field.annotation, *get_args(field.annotation))
        found = [kind for kind in kinds if hasattr(kind, "__pydantic_fields__")]
        cls = found[0] if len(found) == 1 else cls
    return cls


def _no_such_field(cls: type[Any], unknown: Mapping[str, Any], where: str) -> str:
    """The error for unknown fields: a few of them, and once what there is; one alone with what may have been meant."""
    names = [f.name for f in dataclasses.fields(cls)]
    shown = f"{where}.{', '.join(list(unknown)[:MOST_TOLD])}"
    more = f" and {len(unknown) - MOST_TOLD} more" if len(unknown) > MOST_TOLD else ""
    there = f"fields are {', '.join(names)}"
    if len(unknown) > 1:
        return f"{shown}{more}: there are no such fields; {there}"
    ((name, value),) = unknown.items()
    parts = {
        part: info.annotation for part, info in cls.__pydantic_fields__.items() if inspect.isclass(info.annotation)
    }
    inside = [f"{part}.{name}" for part, kind in parts.items() if name in getattr(kind, "__pydantic_fields__", ())]
    guess = f"; did you mean {' or '.join(inside)}?" if inside else meant(name, names)
    return f"{shown}: there is no such field (given: {_brief(value)}){guess or ';'} {there}"


def meant(word: str, known: Iterable[str], before: str = "") -> str:
    """``; did you mean NAME?``, the known name that a misspelled one is nearest to; nothing where none is near.

    Args:
        word: the misspelled name.
        known: the names that there are.
        before: stands before the name that is told.
    """
    near = difflib.get_close_matches(word, list(known), n=1, cutoff=0.7)
    return f"; did you mean {before}{near[0]}?" if near else ""


def _brief(value: object) -> str:
    text = repr(value)
    return text if len(text) <= 80 else text[:77] + "..."


def listed(value: Any) -> Any:
    """A list as a tuple, before a field is validated: files know lists only."""
    return tuple(value) if isinstance(value, list) else value


class Settings:
    """Mixin of every settings class: ``but`` for a validated copy, ``to_dict`` for plain data."""

    def but(self, **changes: Any) -> Self:
        """A validated copy with ``changes``.

        Raises:
            SettingsError: a field is unknown or its value impossible.
        """
        fields = {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}  # type: ignore[arg-type]
        unknown = [name for name in changes if name not in fields]
        if unknown:
            cls = type(self)
            raise SettingsError(_no_such_field(cls, {name: changes[name] for name in unknown}, cls.__name__))
        return type(self)(**{**fields, **changes})

    def to_dict(self) -> dict[str, Any]:
        """Plain data (numbers, text, lists, tables) from which ``from_dict`` makes an equal value."""
        return {
            f.name: _plain(getattr(self, f.name))
            for f in dataclasses.fields(self)  # type: ignore[arg-type]
            if getattr(self, f.name) is not None
        }


@dataclasses.dataclass(frozen=True)
class Foreign:
    """An object of a user's own class, read from a file: its name stays text, nothing is imported.

    It can be looked at and written back. Whoever needs the object itself hands the class over
    (``classes=`` of the reading function); until then, using it is an error that says so.
    """

    kind: str
    values: Mapping[str, Any]

    def __hash__(self) -> int:
        return hash(self.kind)

    def to_dict(self) -> dict[str, Any]:
        """The table that was read."""
        return {**self.values}

    def missing(self) -> SettingsError:
        """The error to raise where the object itself is needed."""
        return SettingsError(
            f"{self.kind!r} is a class of somebody's own and was not handed over: in Python, give it with classes=; "
            "on the command line, --body module:Name hands over a body and --flock module:Name a flock model; what has "
            "an obstacle or a layout of one's own, or several bodies, is itself given as --scenario module:Name, and a "
            "reward of one's own as --reward module:Name"
        )


def check_call(thing: Callable[..., Any], arguments: Sequence[str], where: str) -> None:
    """Find out whether something can be called as it is going to be.

    Args:
        thing: a function or method, a user's own perhaps; one that does not tell its parameters is trusted.
        arguments: names of those that it is given, in their order.
        where: what it is, for the error.

    Raises:
        SettingsError: it takes other arguments.
    """
    try:
        # what a wrapper of a user's own takes counts, not what it wraps; a compiled function tells only that
        own = inspect.isfunction(thing) or inspect.ismethod(thing)
        taken = inspect.signature(thing, follow_wrapped=not own)
    except (TypeError, ValueError):
        return
    try:
        taken.bind(*arguments)
    except TypeError:
        raise SettingsError(f"{where}: is called with ({', '.join(arguments)}); this one takes {taken}") from None


def kind_of(value: object) -> str:
    """The name under which an object is written: its class's name, ``module:Name`` outside the library."""
    if isinstance(value, Foreign):
        return value.kind
    cls = value if inspect.isclass(value) or inspect.isroutine(value) else type(value)
    module = cls.__module__
    if module.split(".")[0] == "shepherd_phys":
        return str(cls.__name__)
    return f"{module}:{cls.__qualname__}"


def _plain(value: Any) -> Any:
    if isinstance(value, Settings):
        return value.to_dict()
    if isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, tuple | list):
        return [_plain(item) for item in value]
    if isinstance(value, Mapping):
        return {key: _plain(item) for key, item in value.items()}
    if hasattr(value, "tolist"):  # numbers and arrays of NumPy
        return _plain(value.tolist())
    return tagged(value)


def tagged(value: Any) -> dict[str, Any]:
    """An object as a table that also says of which kind it is.

    Raises:
        SettingsError: it has parameters, or what may be some, and does not tell which.
    """
    kind = kind_of(value)
    if isinstance(value, Settings | Foreign):
        return {"kind": kind, **value.to_dict()}
    if inspect.isclass(value) or inspect.isroutine(value):
        return {"kind": kind}
    if callable(getattr(value, "to_dict", None)):
        fields = dict(value.to_dict())
    elif dataclasses.is_dataclass(value):
        fields = {f.name: getattr(value, f.name) for f in dataclasses.fields(value)}
    elif kind.startswith("builtins:") or _has_state(value):
        raise SettingsError(
            f"{kind}: cannot be written, because it does not say what its parameters are: "
            "make the class a dataclass, or give it to_dict() with the arguments that make an equal object"
        )
    else:
        fields = {}
    if "kind" in fields:
        raise SettingsError(f"{kind}.kind: a parameter needs another name: in a file, kind is the class's")
    return {"kind": kind, **{name: _plain(item) for name, item in fields.items() if item is not None}}


def _has_state(value: object) -> bool:
    """Whether two objects of its class may differ, as far as Python can see."""
    try:
        return object.__getstate__(value) is not None
    except TypeError:
        return True


def untagged(table: Mapping[str, Any], known: Mapping[str, Callable[..., Any]], where: str) -> Any:
    """The object that ``tagged`` described.

    Args:
        table: the table, with its ``kind``.
        known: kind -> class, the library's and those handed over.
        where: name of the field, for the error.

    Returns:
        the object; a `Foreign` where the kind is ``module:Name`` and was not handed over.

    Raises:
        SettingsError: no kind, or an unknown one.
    """
    if not isinstance(table, Mapping) or not isinstance(table.get("kind"), str):
        raise SettingsError(f"{where}: needs a table with a kind (given: {_brief(table)})")
    values = {key: value for key, value in table.items() if key != "kind"}
    kind = table["kind"]
    if kind in known:
        made = known[kind]
        if inspect.isroutine(made):  # a plain function needs no making
            return made
        try:
            return made(**values)
        except SettingsError:
            raise
        except (TypeError, ValueError) as error:
            raise SettingsError(f"{where}: {kind}: {error}") from None
        except Exception as error:  # a user's class may raise anything
            raise SettingsError(f"{where}: {kind}: {type(error).__name__}: {error}") from None
    if ":" in kind:
        return Foreign(kind, values)
    raise SettingsError(f"{where}.kind: unknown kind {kind!r}; known: {', '.join(sorted(known))}")


def handed_over(classes: Iterable[Any]) -> dict[str, Any]:
    """A user's own classes by the names under which they are written."""
    return {kind_of(cls): cls for cls in classes}


def write_toml(table: Mapping[str, Any], path: str | Path) -> None:
    """Write plain data as TOML; the file appears whole or not at all.

    Raises:
        SettingsError: it cannot be written; the message names it.
    """
    path = Path(path)
    try:
        text = tomli_w.dumps(table)
        with whole_file(path) as part:
            part.write_bytes(text.encode())
    except OSError as error:
        raise SettingsError(f"{path}: cannot be written ({error.strerror})") from None
    except (TypeError, ValueError) as error:
        raise SettingsError(f"{path}: cannot be written ({error})") from None


def read_toml(path: str | Path) -> dict[str, Any]:
    """Read a TOML file.

    Raises:
        SettingsError: the file is missing or is not TOML; the message names it.
    """
    try:
        return tomllib.loads(Path(path).read_text(encoding="utf-8"))
    except OSError as error:
        raise SettingsError(f"{path}: cannot be read ({error.strerror})") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise SettingsError(f"{path}: is not a TOML file ({error})") from None
