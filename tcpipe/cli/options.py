"""Options that several commands share."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterable
from contextlib import nullcontext, suppress
from dataclasses import MISSING, fields, replace
from functools import partial, wraps
from importlib import import_module
from math import isfinite, nan
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import click
from click.core import ParameterSource
from click.shell_completion import CompletionItem

from tcpipe.cli.output import print_result, show_progress
from tcpipe.errors import TcpipeError, UsageError
from tcpipe.formats import atomic
from tcpipe.tables import options

if TYPE_CHECKING:
    from tcpipe.store import Store


class Place(click.ParamType[str]):
    """A path on the command line, checked before the command begins; a wrong one is a usage error (exit code 2)."""

    name = "path"

    def __init__(self, check: Callable[[str], object], *, written: bool = False, urls: bool = False) -> None:
        self._check = check
        self.written = written
        """Whether the command writes there."""
        self.urls = urls
        """Whether it may be a URL."""

    def convert(
        self,
        value: Any,
        param: click.Parameter | None,  # noqa: ARG002  click's signature
        ctx: click.Context | None,  # noqa: ARG002  click's signature
    ) -> Any:
        """Return the text as it was given."""
        if not (self.urls and "://" in value):
            self._check(value)
        return value

    def shell_complete(
        self,
        ctx: click.Context,  # noqa: ARG002  click's signature
        param: click.Parameter,  # noqa: ARG002  click's signature
        incomplete: str,
    ) -> list[CompletionItem]:
        """Ask the shell to complete it as a path."""
        return [CompletionItem(incomplete, type="file")]


class FloatRange(click.FloatRange):
    """A number within bounds; NaN is in none."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Return the number."""
        found = super().convert(value, param, ctx)
        return found if isfinite(found) else self.fail(f"{value!r} is not a finite number.", param, ctx)


class LonLat(click.ParamType[tuple[float, float]]):
    """A place: longitude and latitude in degrees (WGS84), with a comma between."""

    name = "LON,LAT"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[float, float]:
        """Return both numbers."""
        try:
            lon, lat = (float(part) for part in value.split(","))
        except ValueError:
            lon = lat = nan
        if not (isfinite(lon) and isfinite(lat)):
            self.fail(f"{value!r}: expected LON,LAT in degrees, as 15.45,47.07", param, ctx)
        return lon, lat


Command: TypeAlias = Callable[..., Any]
Option: TypeAlias = Callable[[Any], Any]
Complete: TypeAlias = Callable[[click.Context, click.Parameter, str], list[str]]


def _complete_names(names: Callable[[click.Context], Iterable[str]]) -> Complete:
    """Return a function that lists the names with a given beginning; none if they cannot be read."""

    def complete(context: click.Context, _: click.Parameter, typed: str) -> list[str]:
        with suppress(TcpipeError, OSError):
            return [name for name in names(context) if name.startswith(typed)]
        return []

    return complete


def _list_robots(context: click.Context) -> Iterable[str]:
    from tcpipe.formats.recipe_toml import load_profiles, resolve_recipe

    return sorted(load_profiles(resolve_recipe(context.params.get("recipe"))).robots)


def _store(context: click.Context) -> Store | None:
    """Return the store of a command line that is being typed; None where asking it could take long."""
    from tcpipe.store import Store

    place = context.params.get("store") or os.environ.get("TCPIPE_STORE") or "tcpipe-store"
    return None if "://" in place else Store(Path(place))


complete_robots = _complete_names(_list_robots)
"""Type of an option that offers the robots of the recipe."""
complete_scenarios = _complete_names(lambda _: import_module("tcpipe.simulation.scenarios").SCENARIOS)
"""Offers the sites that can be simulated."""
complete_runs = _complete_names(
    lambda context: sorted({run.run_id for run in store.scan().runs.values()}) if (store := _store(context)) else ()
)
"""Offers the store's runs."""
complete_maps = _complete_names(lambda context: store.scan().maps if (store := _store(context)) else ())
"""Offers the store's maps."""

OUTPUT_DIRECTORY = Place(atomic.check_output, written=True)
OUTPUT_FILE = Place(partial(atomic.check_output, wanted="file"), written=True)
INPUT_FILE = Place(partial(atomic.check_input, wanted="file"))
_check_directory = partial(atomic.check_input, wanted="directory")
INPUT_DIRECTORY = Place(_check_directory)
SEALED = Place(_check_directory, urls=True)
"""A dataset, a model or a store, here or in a bucket."""
PUBLISHED = Place(atomic.check_output, written=True, urls=True)
"""Where a dataset, a model or a store is written, here or in a bucket."""
LOG = Place(atomic.check_input, urls=True)
"""A log, here or in object storage."""
ONE_OF_SEVERAL = Place(str)
"""A log or raster, by pattern or address; the command checks each one and reports all problems at once."""
PATH_OR_RUN = Place(str)
"""A path or URL, or the name of a run; the command finds out which."""


_SECONDS = {"": 1.0, "s": 1.0, "m": 60.0, "h": 3600.0, "d": 86400.0}
_MOST_SHARDS = 100_000


def parse_duration(_: click.Context, __: click.Parameter, value: str) -> float:
    """Turn ``90``, ``90s``, ``10m``, ``2h``, ``1d`` into seconds."""
    match = re.fullmatch(r"(\d{1,9}(?:\.\d{1,9})?)\s*([smhd]?)", value.strip())
    if match is None:
        raise click.BadParameter(f"{value!r}: expected a time: 90 or 90s, 10m, 2h, 1d")
    return float(match[1]) * _SECONDS[match[2]]


_JOULE = {"J": 1.0, "kJ": 1e3, "MJ": 1e6, "Wh": 3600.0, "kWh": 3.6e6}


def parse_energy(_: click.Context, __: click.Parameter, value: str | None) -> float | None:
    """Turn ``300Wh``, ``1.2kWh``, ``500kJ`` into joules."""
    if value is None:
        return None
    match = re.fullmatch(r"(\d{1,9}(?:\.\d{1,9})?)\s*(J|kJ|MJ|Wh|kWh)", value.strip())
    if match is None or not float(match[1]):
        raise click.BadParameter(f"{value!r}: expected an energy with its unit: 300Wh, 1.2kWh, 500kJ")
    return float(match[1]) * _JOULE[match[2]]


def parse_shard(_: click.Context, __: click.Parameter, value: str | None) -> tuple[int, int] | None:
    """Turn ``I/N`` into two numbers, I from 1 to N."""
    if value is None:
        return None
    match = re.fullmatch(r"(\d{1,6})/(\d{1,6})", value.strip())
    index, count = (int(match[1]), int(match[2])) if match else (0, 0)
    if not 1 <= index <= count <= _MOST_SHARDS:
        raise click.BadParameter(f"{value!r}: expected I/N, I from 1 to N, N at most {_MOST_SHARDS}, for example 1/8")
    return index, count


def tag_values(_: click.Context, __: click.Parameter, values: tuple[str, ...]) -> dict[str, str]:
    """Turn ``K=V`` pairs into a dict; a pair without key or '=' is a usage error."""
    for value in values:
        if value.find("=") < 1:
            raise click.BadParameter(f"{value!r}: expected KEY=VALUE")
    return dict(value.split("=", 1) for value in values)


def layer_values(_: click.Context, __: click.Parameter, values: tuple[str, ...]) -> dict[str, str]:
    """Turn ``NAME=FILE`` pairs into a dict."""
    files = _parse_named_files("--layer", values, "give the tiles of one layer as a pattern: NAME='tiles/*.tif'")
    if bare := [layer for layer, file in files.items() if not (layer and file)]:
        raise UsageError(f"--layer {bare[0]}: expected NAME=FILE")
    return files


def class_table_values(_: click.Context, __: click.Parameter, values: tuple[str, ...]) -> dict[str, str | None]:
    """Turn ``NAME`` and ``NAME=FILE`` into a dict, None if there is no file."""
    tables = _parse_named_files("--categorical", values, "expected one class table a layer")
    return {name: table or None for name, table in tables.items()}


def _parse_named_files(option: str, given: tuple[str, ...], hint: str) -> dict[str, str]:
    files: dict[str, str] = {}
    for name, _, file in (text.partition("=") for text in given):
        if name in files:
            raise UsageError(f"{option} {name}: is given twice; {hint}")
        files[name] = file
    return files


def parse_holdout(_: click.Context, __: click.Parameter, value: str | None) -> str | None:
    """Return a valid kind of holdout; anything else is a usage error."""
    if value is not None and re.fullmatch(r"block|sample|run|tag:.+", value) is None:
        raise click.BadParameter(f"{value!r}: expected block, sample, run, or tag:NAME")
    return value


KINDS: dict[str, dict[str, Any]] = {
    "published": {"type": PUBLISHED},
    "sealed": {"type": SEALED},
    "input_file": {"type": INPUT_FILE},
    "input_directory": {"type": INPUT_DIRECTORY},
    "input_path": {"type": INPUT_DIRECTORY, "callback": lambda _, __, value: value and Path(value)},
    "output_file": {"type": OUTPUT_FILE},
    "several": {"type": ONE_OF_SEVERAL},
    "lonlat": {"type": LonLat()},
    "robot": {"shell_complete": complete_robots},
    "map": {"shell_complete": complete_maps},
    "run": {"shell_complete": complete_runs},
    "tags": {"callback": tag_values, "multiple": True},
    "layers": {"callback": layer_values, "multiple": True, "type": ONE_OF_SEVERAL},
    "class_tables": {"callback": class_table_values, "multiple": True, "type": ONE_OF_SEVERAL},
    "duration": {"callback": parse_duration},
    "energy": {"callback": parse_energy},
    "shard": {"callback": parse_shard},
    "holdout": {"callback": parse_holdout},
}
"""Click's settings of a declared option, by its kind."""


def make_click_option(name: str, default: Any, shown: options.Option) -> Option:
    """Return the decorator of click for a declared option or argument."""
    settings: dict[str, Any] = {"metavar": shown.metavar}
    match shown.kind:
        case options.Range(int() as least, int() as most):
            settings["type"] = click.IntRange(least, most)
        case options.Range(least, most, is_open):
            settings["type"] = FloatRange(least, most, min_open=is_open)
        case tuple(choices):
            settings["type"] = click.Choice(choices)
        case kind if kind:
            settings |= KINDS[kind]
    if shown.shown is not None or default not in (MISSING, None, ()):
        settings["default"] = default if shown.shown is None else shown.shown
    settings |= {"required": True} if default is MISSING else {}
    if shown.is_argument:
        return click.argument(name, nargs=-1 if shown.repeatable else 1, **settings)
    settings |= {"is_flag": True} if isinstance(default, bool) else {}
    flags = shown.flags or (f"--{name.replace('_', '-')}",)
    multiple = settings.pop("multiple", shown.repeatable)
    return click.option(*flags, name, help=shown.about or None, envvar=shown.envvar, multiple=multiple, **settings)


def add_options(cls: type[Any]) -> Option:
    """Return a decorator that adds the options of a dataclass to a command, which receives them as one object.

    Options that are not given have the default of the dataclass, which may differ from the default in the help.
    """
    declared = {
        field.name: (field.default, field.metadata["option"]) for field in fields(cls) if "option" in field.metadata
    }

    def decorate(run: Command) -> Command:
        @click.pass_context
        @wraps(run)
        def command(context: click.Context, /, **values: Any) -> Any:
            own = {name: values.pop(name) for name in declared}
            given = (name for name in own if context.get_parameter_source(name) is not ParameterSource.DEFAULT)
            return run(cls(**{name: own[name] for name in given}), **values)

        for name, (default, shown) in reversed(declared.items()):
            command = make_click_option(name, default, shown)(command)
        return command

    return decorate


store_option = make_click_option("store", "tcpipe-store", options.STORE)
"""``--store``, or TCPIPE_STORE, or ./tcpipe-store."""


def add_path_or_run(name: str, metavar: str, *, required: bool) -> Option:
    """Return the decorator of an argument (path or run of the store; default: the store) and of ``--store``."""

    def decorate(run: Command) -> Command:
        @click.pass_context
        @wraps(run)
        def command(context: click.Context, /, *, store: str, **values: Any) -> Any:
            from tcpipe.store import is_path

            given = values[name]
            if given and is_path(given) and context.get_parameter_source("store") is ParameterSource.COMMANDLINE:
                raise UsageError(f"{given}: is a path, and --store is only for names of runs; remove one of them")
            values[name] = context.params[name] = given or store
            return run(store=store, **values)

        declared: Command = click.argument(name, type=PATH_OR_RUN, required=required, metavar=metavar)(
            store_option(command)
        )
        return declared

    return decorate


recipe_option = make_click_option("recipe", None, options.RECIPE)
"""``--recipe``; without it TCPIPE_RECIPE, the nearest tcpipe.toml upward, or the defaults."""

msgdef_option = make_click_option(
    "message_definitions", None, replace(options.MESSAGE_DEFINITIONS, flags=("--msgdef",), kind="input_path")
)
"""``--msgdef``: definitions of types that a log does not define."""

json_option = click.option("--json", "as_json", is_flag=True, help="Print one JSON object instead of text.")
"""``--json``: one JSON object on stdout instead of text."""

quiet_option = click.option("--quiet", "-q", is_flag=True, help="Print no progress on stderr.")
"""``--quiet``: no progress on stderr."""


def add_output(progress: str = "", *, as_values: bool = False) -> Option:
    """Return a decorator for a command that returns its result, which is printed, and whose exit code is the command's.

    The command gets ``--json``, of the result's ``values`` with ``as_values``; with a name for its ``progress`` also
    ``--quiet``.
    """

    def decorate(run: Command) -> Command:
        @wraps(run)
        def command(*options: Any, as_json: bool, quiet: bool = False, **values: Any) -> Any:
            with show_progress(progress, quiet=quiet) if progress else nullcontext():
                result = run(*options, **values)
            print_result(result.values if as_values and as_json else result, as_json=as_json)
            return getattr(result, "exit_code", 0)

        declared: Command = json_option(quiet_option(command) if progress else command)
        return declared

    return decorate


def robot_option(about: str = "Robot profile.") -> Option:
    """Return ``--robot``."""
    return click.option("--robot", metavar="NAME", shell_complete=complete_robots, help=about)


def jobs_option(about: str) -> Option:
    """Return ``--jobs``."""
    return make_click_option("jobs", 1, options.jobs(about).metadata["option"])


seed_option = make_click_option("seed", 1, options.Option("Seed of the simulated site.", kind=options.SEED))
"""``--seed`` of a simulation."""

dry_run_option = make_click_option("dry_run", False, options.DRY_RUN)
"""``--dry-run``: change nothing."""
