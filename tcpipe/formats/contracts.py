"""The contracts of tables and recipe as JSON Schema texts: what ``tcpipe schemas`` writes and schemas/ holds."""

from __future__ import annotations

from typing import Any

import pyarrow as pa

from tcpipe.formats.dataset_card import DatasetCard
from tcpipe.formats.json_files import DIALECT, schema_of, to_json
from tcpipe.formats.run_documents import Manifest, RunJson
from tcpipe.recipe import Recipe
from tcpipe.recipe.checking import describe
from tcpipe.tables.bits import name_of
from tcpipe.tables.columns import Column, TableSchema
from tcpipe.tables.levels import DATA_MODEL_VERSION, GATED_TRACK, LABELLED_SEGMENTS, REJECTIONS, SAMPLES, STREAMS

DOCUMENTS = {"run": RunJson, "manifest": Manifest, "dataset": DatasetCard}
"""The JSON documents that others read, by the name of their schema."""


def contracts() -> dict[str, str]:
    """Return file name → JSON Schema text, for every table (one row as an object), the recipe and every document."""
    tables = (*STREAMS.values(), GATED_TRACK, REJECTIONS, LABELLED_SEGMENTS, SAMPLES)
    found = {f"{table.name}.schema.json": to_json(_table_schema(table)) for table in tables}
    found["recipe.schema.json"] = to_json({"$schema": DIALECT, **describe(Recipe, closed=True)})
    return found | {f"{name}.schema.json": schema_of(cls) for name, cls in DOCUMENTS.items()}


def _table_schema(table: TableSchema) -> dict[str, Any]:
    return {
        "$schema": DIALECT,
        "title": table.name,
        "description": f"{table.doc} One row.",
        "x-level": table.level,
        "x-data-model-version": DATA_MODEL_VERSION,
        "type": "object",
        "additionalProperties": False,
        "required": table.names(),
        "properties": {column.name: _column_schema(column) for column in table.columns},
    }


def _column_schema(column: Column) -> dict[str, Any]:
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
        schema["x-flags"] = {str(int(bit)): name_of(bit) for bit in column.flags}
    return schema
