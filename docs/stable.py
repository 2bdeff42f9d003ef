"""docs/reference/stable.json: every name that a version 2.x keeps. `docs/generate.py` adds to it and never takes away."""

from __future__ import annotations

import inspect
import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import click
from contracts import DOCUMENTS, json_output_types, make_contracts

import tcpipe
from tcpipe.cli import cli
from tcpipe.dataset import Dataset, Split
from tcpipe.learning.evaluation_files import EvaluationResult
from tcpipe.learning.training import TrainResult
from tcpipe.pipeline.dataset.build import BuildResult
from tcpipe.pipeline.ingest import IngestSummary
from tcpipe.pipeline.maps import AddedMap
from tcpipe.planning.drives import DrivesResult
from tcpipe.planning.path_cost import PATH_SEGMENTS
from tcpipe.planning.path_files import PathResult, PlanResult
from tcpipe.tables.columns import Column
from tcpipe.tables.levels import LABELLED_SEGMENTS, MASKED_TRACK, REJECTIONS, SAMPLES, STREAMS

FILE = Path(__file__).parent / "reference" / "stable.json"
_RESULTS = (
    AddedMap, BuildResult, Dataset, DrivesResult, EvaluationResult, IngestSummary, PathResult, PlanResult, Split, TrainResult,
)  # fmt: skip
_OF_LOGS = ("close", "damage", "table", "tables", "topics")
"""Names of what `read_log` returns; its other names are private."""
_TABLES = (*STREAMS.values(), MASKED_TRACK, REJECTIONS, LABELLED_SEGMENTS, SAMPLES, PATH_SEGMENTS)
_LOST = (
    "version 2.x keeps every name in docs/reference/stable.json, and these are gone:\n{names}\nKeep each of them. A removal belongs "
    "into the next major version: delete the file, run 'make docs' and state it in the changelog."
)


def describe_stable() -> dict[str, list[str]]:
    """Return what is stable, a line for each name."""
    schemas = {name: json.loads(text) for name, text in make_contracts().items()}
    keys = {
        name: sorted({*_iterate_keys(schemas[f"{name}.schema.json"], f"{name}.schema.json", schemas)})
        for name in ("recipe", *DOCUMENTS, *json_output_types())
    }
    keys |= {
        name: [key for key in found if "." not in key] for name, found in keys.items() if name in json_output_types()
    }
    recipe = keys.pop("recipe")
    return {
        "python": [*_iterate_python()],
        "commands": [line for name, command in cli.commands.items() for line in _iterate_options(name, command)],
        "recipe": recipe,
        "columns": [
            line for table in _TABLES for column in table.columns for line in _iterate_column(table.name, column)
        ],
        "documents": [f"{name}: {key}" for name, found in sorted(keys.items()) for key in found],
    }  # fmt: skip


def find_lost_names(before: Mapping[str, list[str]], now: Mapping[str, list[str]]) -> str:
    """Return the message on names that were stable and are gone; empty where none is."""
    lost = [f"  {section}: {name}" for section, names in before.items() for name in names if name not in now[section]]
    return _LOST.format(names="\n".join(lost)) if lost else ""


def _iterate_python() -> Iterator[str]:
    for name in tcpipe.__all__:
        yield name
        if inspect.isroutine(function := getattr(tcpipe, name)):
            parameters = inspect.signature(function).parameters.values()
            yield from (f"{name}({each.name}{'' if each.default is each.empty else '='})" for each in parameters)
    for cls in _RESULTS:
        fields = getattr(cls, "__dataclass_fields__", {})
        yield from (f"{cls.__name__}.{name}" for name in sorted({*dir(cls), *fields}) if not name.startswith("_"))
    yield from (f"Log.{name}" for name in _OF_LOGS)
    for name, cls in sorted(vars(tcpipe.errors).items()):
        if inspect.isclass(cls) and issubclass(cls, tcpipe.errors.TcpipeError):
            yield f"errors.{name}({cls.__base__.__name__}): exit code {cls.exit_code}"


def _iterate_options(name: str, command: click.Command) -> Iterator[str]:
    yield name
    for parameter in command.params:
        flags = [*parameter.opts, *parameter.secondary_opts]
        choices = [*parameter.type.choices] if isinstance(parameter.type, click.Choice) else []
        if not isinstance(parameter, click.Option):
            flags = [name for name in [str(parameter.make_metavar(click.Context(command)))] if name]
        for flag in flags:
            yield f"{name} {flag}"
            yield from (f"{name} {flag} {choice}" for choice in choices)


def _iterate_column(table: str, column: Column) -> Iterator[str]:
    unit = f" [{column.unit}]" if column.unit else ""
    yield f"{table}.{column.name}: {column.dtype}{unit}"
    for bit in column.flags or ():
        yield f"{table}.{column.name}: bit {int(bit)} {str(bit.name).lower()}"


def _iterate_keys(
    schema: Any, file: str, schemas: Mapping[str, Any], path: str = "", above: tuple[str, ...] = ()
) -> Iterator[str]:
    """Yield the path of each key of a document; ``*`` is any name, ``[]`` any item."""
    if reference := schema.get("$ref"):
        other, _, pointer = reference.partition("#/$defs/")
        file = other or file
        if pointer in above:
            return
        yield from _iterate_keys(schemas[file]["$defs"][pointer], file, schemas, path, (*above, pointer))
    for key, value in schema.get("properties", {}).items():
        yield f"{path}{key}"
        yield from _iterate_keys(value, file, schemas, f"{path}{key}.", above)
    for word, below in (("items", f"{path.rstrip('.')}[]."), ("additionalProperties", f"{path}*.")):
        if isinstance(value := schema.get(word), dict):
            yield from _iterate_keys(value, file, schemas, below, above)
    for choice in schema.get("anyOf", ()):
        yield from _iterate_keys(choice, file, schemas, path, above)
