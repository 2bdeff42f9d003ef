"""Options of a command: fields of a frozen dataclass from which click's options and the public function are made.

The modules that declare options import neither numpy nor pyarrow, so that ``--help`` starts fast.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields
from difflib import get_close_matches
from inspect import cleandoc, signature
from math import isfinite
from typing import Any, NamedTuple, ParamSpec, TypeAlias, TypeVar

from tcpipe.errors import UsageError

P = ParamSpec("P")
O = TypeVar("O")
R = TypeVar("R")


class Range(NamedTuple):
    """The bounds of a number; those of msgspec would make ``--help`` slower."""

    least: float
    most: float
    is_open: bool = False
    """Whether the least is excluded."""


Kind: TypeAlias = Range | tuple[str, ...] | str
"""Bounds of a number, the choices, or the name of one of `tcpipe.cli.options.KINDS`."""


@dataclass(frozen=True, slots=True)
class Option:
    """How the command line shows a field."""

    about: str = ""
    flags: tuple[str, ...] = ()
    """In place of ``--`` and the field's name."""
    kind: Kind = ""
    metavar: str | None = None
    shown: str | float | None = None
    """The default as the command line shows it, where the field's own is None or another type."""
    envvar: str | None = None
    repeatable: bool = False
    is_argument: bool = False


STORE = Option("Where runs and maps are kept (or TCPIPE_STORE).", (), "published", "DIR|URL", envvar="TCPIPE_STORE")
RECIPE = Option(
    "Recipe (or TCPIPE_RECIPE, or the nearest tcpipe.toml upward; else defaults).", (), "input_file", "FILE"
)
MESSAGE_DEFINITIONS = Option(
    "Directory of package/msg/Name.msg (or .idl) files for types the log does not define.", (), "input_directory", "DIR"
)  # fmt: skip
MAP = Option("Map to look at (default: the only one in the store).", (), "map", "NAME")
MODEL = Option(kind="sealed", metavar="MODEL", is_argument=True)
SPEED = Option(
    "Commanded speed, for a model trained with --extra-features (default: the mean of its training).",
    (),
    Range(0.0, 100.0, is_open=True),
    "MPS",
)
PREDICTOR = Option("Run your own model: FILE.py[:NAME].", metavar="CODE")
DRY_RUN = Option("Print what would be done; change nothing.")
SEED = Range(0, 2**32 - 1)
"""Seeds of all random number generators."""


def required(shown: Option) -> Any:
    """Return a field that has to be given."""
    return field(metadata={"option": shown})


def option(
    default: object,
    about: Option | str = "",
    flags: tuple[str, ...] = (),
    kind: Kind = "",
    metavar: str | None = None,
    **more: Any,
) -> Any:
    """Return a field with its default and its `Option`, or the fields of that."""
    declared = about if isinstance(about, Option) else Option(about, flags, kind, metavar, **more)
    return field(default=default, metadata={"option": declared})


def jobs(what: str) -> Any:
    """Return the field of ``--jobs``."""
    return option(1, f"{what} side by side.", ("--jobs", "-j"), Range(1, 1024))


def tags(about: str) -> Any:
    """Return the field of ``--tag``."""
    return option(None, about, (), "tags", "K=V")


def as_function(options: Callable[P, O], run: Callable[[O], R]) -> Callable[P, R]:
    """Return the public function of a command: keywords are the fields of the options, and ``run`` does the work."""
    name = run.__name__.removeprefix("run_")
    shown = {entry.name: entry.metadata.get("option", Option()) for entry in fields(options)}  # type: ignore[arg-type]
    words = {flag.strip("-"): keyword for keyword, option in shown.items() for flag in (keyword, *option.flags)}

    def call(*args: P.args, **kwargs: P.kwargs) -> R:
        for word in kwargs.keys() - shown.keys():
            close = words[get_close_matches(word, words, 1, cutoff=0.0)[0]]
            raise TypeError(f"{name}: no keyword {word!r}; did you mean {close!r}?")
        asked = options(*args, **kwargs)
        _check_bounds(asked, name)
        return run(asked)

    lines = [f"{keyword} : {option.about}" for keyword, option in shown.items() if option.about]
    more = f"`{getattr(options, '__module__', '')}` describes each of them."
    call.__name__ = call.__qualname__ = name
    call.__module__ = run.__module__
    call.__doc__ = "\n".join([cleandoc(run.__doc__ or ""), "", "Parameters", "----------", *lines, "", more])
    called = signature(options).replace(return_annotation=signature(run).return_annotation)
    call.__signature__ = called  # type: ignore[attr-defined]
    return call


def _check_bounds(options: Any, function: str) -> None:
    """Raise `UsageError` for all numbers out of their range, unknown choices, and texts that are no points."""
    problems = []
    for entry in fields(options):
        kind, value = entry.metadata.get("option", Option()).kind, getattr(options, entry.name)
        if value is None or not (expected := _describe_mismatch(kind, value)):
            continue
        problems.append(f"{function}: {entry.name} is {value!r}; expected {expected}")
    if problems:
        raise UsageError(*problems)


def _describe_mismatch(kind: Kind, value: Any) -> str:
    """Return the expected value of an option as text, "" if its value is valid."""
    if isinstance(kind, Range):
        is_inside = (
            _is_number(value) and kind.least <= value <= kind.most and not (kind.is_open and value == kind.least)
        )
        return "" if is_inside else f"a number {'above' if kind.is_open else 'from'} {kind.least:g} to {kind.most:g}"
    if kind == "lonlat":
        is_point = isinstance(value, Sequence) and len(value) == 2 and all(map(_is_number, value))
        return "" if is_point else "longitude and latitude in degrees"
    return "" if isinstance(kind, str) or value in kind else f"one of {', '.join(kind)}"


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and isfinite(value)
