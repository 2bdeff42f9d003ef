"""The contracts of tables and recipe as JSON Schema texts: what schemas/ holds."""

from __future__ import annotations

from importlib import import_module
from typing import Any

import pyarrow as pa

from tcpipe.formats.dataset_card import DatasetCard
from tcpipe.formats.json_files import to_json
from tcpipe.formats.runs import Run
from tcpipe.recipe import Recipe
from tcpipe.recipe.checking import describe
from tcpipe.tables.bits import flag_name
from tcpipe.tables.columns import Column, TableSchema
from tcpipe.tables.levels import DATA_MODEL_VERSION, LABELLED_SEGMENTS, MASKED_TRACK, REJECTIONS, SAMPLES, STREAMS

DIALECT = "https://json-schema.org/draft/2020-12/schema"
"""Contract of every schema in ``schemas/``."""
DEFINITIONS = "defs"
"""The schema whose definitions all documents and answers refer to."""
DOCUMENTS = {"run": Run, "dataset": DatasetCard}
"""The JSON documents that others read, by the name of their schema."""


def make_contracts() -> dict[str, str]:
    """Return file name → JSON Schema text, for every table (one row as an object), the recipe, and every document and answer."""
    tables = (*STREAMS.values(), MASKED_TRACK, REJECTIONS, LABELLED_SEGMENTS, SAMPLES)
    schemas = {table.name: _make_table_schema(table) for table in tables} | {"recipe": _make_recipe_schema()}
    documents = {**DOCUMENTS, **json_output_types()}
    pointers, definitions = describe(*documents.values(), file=f"{DEFINITIONS}.schema.json")
    inner = to_json(definitions)
    for name, pointer in zip(documents, pointers, strict=True):
        shared = f'"{pointer["$ref"]}"' in inner
        schemas[name] = pointer if shared else definitions.pop(pointer["$ref"].rpartition("/")[2])
    schemas[DEFINITIONS] = {"$defs": definitions}
    return {f"{name}.schema.json": to_json({"$schema": DIALECT, **schema}) for name, schema in schemas.items()}


def _make_recipe_schema() -> dict[str, Any]:
    """Return the schema of a recipe in one piece, as an editor loads it: a key that is not in it is refused."""
    ((pointer,), definitions) = describe(Recipe)
    closed = {name: {**definition, "additionalProperties": False} for name, definition in definitions.items()}
    return {**pointer, "$defs": closed}


def _make_table_schema(table: TableSchema) -> dict[str, Any]:
    return {
        "title": table.name,
        "description": f"{table.doc} One row.",
        "x-level": table.level,
        "x-data-model-version": DATA_MODEL_VERSION,
        "type": "object",
        "additionalProperties": False,
        "required": table.names(),
        "properties": {column.name: _make_column_schema(column) for column in table.columns},
    }


def _make_column_schema(column: Column) -> dict[str, Any]:
    text = pa.types.is_string(column.dtype) or pa.types.is_binary(column.dtype)
    kind = "string" if text else "integer" if pa.types.is_integer(column.dtype) else "number"
    schema: dict[str, Any] = {
        "type": [kind, "null"] if column.nullable else kind,
        "description": column.doc,
        "x-arrow-type": str(column.dtype),
        "x-unit": column.unit,
    }
    if column.frame:
        schema["x-frame"] = column.frame
    if column.flags is not None:
        schema["x-flags"] = {str(int(bit)): flag_name(bit) for bit in column.flags}
    return schema


_ANSWERS = {
    "model": "learning.model_card.ModelCard",
    "cost-map": "planning.cost_map.CostMapCard",
    "evaluation": "learning.evaluation.Evaluation",
    "path-totals": "planning.path_cost.PathTotals",
    "plan": "planning.path_files.PlanFile",
    "reproduction": "experiment.reproduction.ReproductionSummary",
    "acknowledge.answer": "pipeline.problems.Acknowledged",
    "add-map.answer": "pipeline.maps.AddedMap",
    "audit.answer": "pipeline.audit.Audit",
    "benchmark.answer": "experiment.benchmark.Benchmark",
    "build-dataset.answer": "pipeline.dataset.build.BuildResult",
    "cost-map.answer": "planning.cost_map.CostMapResult",
    "diff.answer": "pipeline.diff.Difference",
    "evaluate-drives.answer": "planning.drives.Drives",
    "explain.answer": "pipeline.explain.Explained",
    "export.answer": "pipeline.export.Exported",
    "failure.answer": "cli.output.Failure",
    "ingest-log.answer": "pipeline.plan.LogLine",
    "ingest-summary.answer": "pipeline.ingest.SummaryLine",
    "inspect-dataset.answer": "formats.dataset_card.InspectedDataset",
    "inspect-log.answer": "pipeline.log_inspection.InspectedLog",
    "inspect-logs.answer": "pipeline.inspect.InspectedLogs",
    "inspect-map.answer": "formats.maps.map_facts.InspectedMap",
    "inspect-run.answer": "pipeline.inspect.InspectedRun",
    "inspect-store.answer": "pipeline.inspect.InspectedStore",
    "inspect-tables.answer": "pipeline.inspect.InspectedTables",
    "overlay.answer": "pipeline.overlay.Overlay",
    "plan-path.answer": "planning.path_files.PlanResult",
    "predict-path.answer": "planning.path_files.PathResult",
    "preflight.answer": "pipeline.preflight.Preflight",
    "prune.answer": "pipeline.prune.Pruned",
    "reproduce.answer": "experiment.reproduction.Reproduction",
    "route-graph.answer": "planning.route_graph.RouteGraphResult",
    "simulate.answer": "simulation.SimulatedSite",
    "status.answer": "pipeline.status.Status",
    "train.answer": "learning.training.TrainResult",
    "verify.answer": "pipeline.verify.Verified",
}
"""The dataclass of each document and of each answer of ``--json``, by the name of its schema."""


def json_output_types() -> dict[str, type]:
    """Return the dataclass of every document and answer of ``--json``, by the name of its schema."""
    homes = {name: f"tcpipe.{path}".rpartition(".") for name, path in _ANSWERS.items()}
    return {name: getattr(import_module(module), cls) for name, (module, _, cls) in homes.items()}
