"""The options of a command, declared once: fields of a frozen dataclass that click's options and the public function are made of.

The modules that declare options import neither numpy nor pyarrow, so that ``--help`` starts fast.

Names of tcpipe 0.8 and data model 2.x, with their names since 0.9 and 3.0: tcpipe still reads the earlier ones.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from inspect import cleandoc, signature
from math import isfinite
from typing import Any, NamedTuple, ParamSpec, TypeVar

from tcpipe.errors import UsageError

P = ParamSpec("P")
O = TypeVar("O")
R = TypeVar("R")


class Range(NamedTuple):
    """The bounds of a number; msgspec, which knows bounds too, would make ``--help`` slower."""

    least: float
    most: float
    is_open: bool = False
    """Whether the least is excluded."""


@dataclass(frozen=True, slots=True)
class Option:
    """How the command line shows a field."""

    about: str = ""
    flags: tuple[str, ...] = ()
    """In place of ``--`` and the field's name."""
    kind: Range | tuple[str, ...] | str = ""
    """Bounds of a number, the choices, or the name of one of `tcpipe.cli.options.KINDS`."""
    metavar: str | None = None
    shown: str | float | None = None
    """The default as the command line shows it, where the field's own is None or another type."""
    envvar: str | None = None
    repeatable: bool = False
    is_argument: bool = False
    earlier: str = ""
    """The flag of versions before 0.9: still read, and shown nowhere."""


STORE = Option("Where runs and maps are kept (or TCPIPE_STORE).", (), "published", "DIR|URL", envvar="TCPIPE_STORE")
RECIPE = Option(
    "Recipe (or TCPIPE_RECIPE, or the nearest tcpipe.toml upward; else defaults).", (), "input_file", "FILE"
)
CLUSTER = Option(
    "Dask scheduler whose workers compute it, tcp://host:port (or TCPIPE_CLUSTER); instead of --jobs.",
    metavar="ADDRESS",
    envvar="TCPIPE_CLUSTER",
)
MESSAGE_DEFINITIONS = Option(
    "Directory of package/msg/Name.msg (or .idl) files for types the log does not define.", ("--msgdef",), "input_directory", "DIR"
)  # fmt: skip
MAP = Option("Map to look at (default: the only one in the store).", ("--map",), "map", "NAME")
MODEL = Option(kind="sealed", metavar="MODEL", is_argument=True)
PHYSICS = Option(
    "Dataset whose card has the power of turning of the robot (default: the one that MODEL was trained on).",
    ("--physics-from",),
    "sealed",
    "DATASET",
    earlier="--physics",
)
SPEED = Option(
    "Commanded speed, for a model trained with --extra-features (default: the mean of its training).",
    ("--speed",),
    Range(0.0, 100.0, is_open=True),
    "MPS",
)
PREDICTOR = Option("Run your own model: FILE.py[:NAME] or entry point.", metavar="CODE")
DRY_RUN = Option("Say what would be done, and what it would take; do nothing.")
SEED = Range(0, 2**32 - 1)
"""What every generator of random numbers takes."""


def required(shown: Option) -> Any:
    """Return a field that has to be given."""
    return field(metadata={"option": shown})


def option(default: object, shown: Option) -> Any:
    """Return a field with its default."""
    return field(default=default, metadata={"option": shown})


def jobs(what: str) -> Any:
    """Return the field of ``--jobs``."""
    return option(1, Option(f"{what} side by side.", ("--jobs", "-j"), Range(1, 1024)))


def tags(about: str) -> Any:
    """Return the field of ``--tag``."""
    return option(None, Option(about, ("--tag",), "tags", "K=V"))


def as_function(options: Callable[P, O], run: Callable[[O], R]) -> Callable[P, R]:
    """Return the public function of a command: its keywords are the fields of the options, and ``run`` does the work."""

    def call(*args: P.args, **kwargs: P.kwargs) -> R:
        asked = options(*args, **kwargs)
        _check_bounds(asked, run.__name__.removeprefix("run_"))
        return run(asked)

    shown = {entry.name: entry.metadata.get("option", Option()).about for entry in fields(options)}  # type: ignore[arg-type]
    lines = [f"{name} : {about}" for name, about in shown.items() if about]
    more = f"`{getattr(options, '__module__', '')}` describes each of them."
    call.__name__ = call.__qualname__ = run.__name__.removeprefix("run_")
    call.__module__ = run.__module__
    call.__doc__ = "\n".join([cleandoc(run.__doc__ or ""), "", "Parameters", "----------", *lines, "", more])
    call.__signature__ = signature(options).replace(return_annotation=signature(run).return_annotation)  # type: ignore[attr-defined]
    return call


def _check_bounds(options: Any, function: str) -> None:
    """Raise `UsageError` for all numbers out of their range, values that are no choice, and points that are none."""
    problems = []
    for entry in fields(options):
        kind, value = entry.metadata.get("option", Option()).kind, getattr(options, entry.name)
        if value is None or not (expected := _describe_mismatch(kind, value)):
            continue
        problems.append(f"{function}: {entry.name} is {value!r}; expected {expected}")
    if problems:
        raise UsageError(*problems)


def _describe_mismatch(kind: Range | tuple[str, ...] | str, value: Any) -> str:
    """Return what an option is to be, "" where it is that."""
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


EARLIER_COLUMNS = {
    "epoch": "clock_epoch",
    "turn_rad": "yaw_change_rad",
    "turn_std_rad": "yaw_change_std_rad",
    "turn_rate_radps": "mean_abs_yaw_rate_radps",
    "turn_rate_std_radps": "mean_abs_yaw_rate_std_radps",
    "standing_power_watt": "idle_power_watt",
    "standing_power_std_watt": "idle_power_std_watt",
    "power_above_standing_watt": "net_power_watt",
    "power_above_standing_std_watt": "net_power_std_watt",
    "energy_above_standing_joule": "net_energy_joule",
    "energy_above_standing_std_joule": "net_energy_std_joule",
}
"""Columns of tables; `tcpipe.formats.parquet` gives them their names of today."""

EARLIER_KEYS = {
    "gate": "mask",
    "gate.standing_velocity_mps": "stationary_velocity_mps",
    "gate.standing_yaw_rate_radps": "stationary_yaw_rate_radps",
    "read.time": "time_source",
    "read.placement": "extrinsics",
    "read.pose_from": "pose_sources",
    "robots.*.called": "topic_words",
    "power_sources.*.refused": "unsupported_reason",
    "power_sources.*.includes": "other_loads",
    "power_sources.*.unknown": "open_questions",
}
"""Keys of the recipe by their path; * is any name or item."""

REMOVED_KEYS = {"fuse.engine": "compiled"}
"""Keys of the recipe that have no effect any more, by their path, with the default that still counts in the recipe's id."""

EARLIER_DOCUMENT_KEYS = {
    **EARLIER_COLUMNS,
    "gate": "mask",
    "ledger_m": "distance_by_reason_m",
    "ledger_s": "duration_by_reason_s",
    "standing_watt": "idle_watt",
    "standing": "stationary",
    "below_limit": "below_full_speed",
    "not_at_limit": "below_full_speed",
    "mean_power_differs": "power_mean_mismatch",
    "reopenings": "gate_resets",
    "refused": "excluded",
    "remarks": "notes",
    "pitch_m": "pixel_size_m",
    "doubtful": "flagged_samples",
}
"""Keys of manifests and cards; `tcpipe migrate` renames them."""

_EARLIER_PHYSICS = {"standing": "idle", "usual_turn_radpm": "mean_turn_radpm"}
"""Terms and keys below a key ``physics``."""


def rename_keys(document: Any, names: dict[str, str] = EARLIER_DOCUMENT_KEYS) -> Any:
    """Return a document, or a part of one, with keys by their names of today."""
    if isinstance(document, list):
        return [rename_keys(item, names) for item in document]
    if not isinstance(document, Mapping):
        return document
    return {
        names.get(key, key): _EARLIER_PHYSICS.get(value, value)
        if key == "term"
        else rename_keys(value, names | _EARLIER_PHYSICS if key == "physics" else names)
        for key, value in document.items()
    }


EARLIER_CHOICES = {"table": "boosting", "above_standing": "net"}
"""Values of options."""
