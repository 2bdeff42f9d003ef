"""The contracts of tables and recipe as JSON Schema texts: what schemas/ holds."""

from __future__ import annotations

from collections.abc import Mapping
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
"""Of every schema in ``schemas/``."""
DEFINITIONS = "defs"
"""The schema whose definitions all documents and answers refer to."""
DOCUMENTS = {"run": Run, "dataset": DatasetCard}
"""The JSON documents that others read, by the name of their schema."""


def make_contracts(answers: Mapping[str, type]) -> dict[str, str]:
    """Return file name → JSON Schema text, for every table (one row as an object), the recipe, and every document and answer."""
    tables = (*STREAMS.values(), MASKED_TRACK, REJECTIONS, LABELLED_SEGMENTS, SAMPLES)
    schemas = {table.name: _make_table_schema(table) for table in tables} | {"recipe": _make_recipe_schema()}
    documents = {**DOCUMENTS, **answers}
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
