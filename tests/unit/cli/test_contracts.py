"""schemas/ is generated: it must not drift from the tables, the recipe, the documents and the answers."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from json_contracts import json_output_types, make_contracts

from tcpipe.cli import cli

SCHEMAS = Path(__file__).parents[3] / "schemas"


def test_committed_schemas_are_what_the_code_says() -> None:
    committed = {path.name: path.read_text() for path in SCHEMAS.glob("*.json")}
    assert committed == make_contracts(), "run 'make docs' and commit the result"


def test_every_command_that_prints_json_has_a_contract_of_it() -> None:
    told = {name.removesuffix(".answer") for name in json_output_types() if name.endswith(".answer")}
    printing = {
        name
        for name, command in cli.commands.items()
        if not command.hidden and any("--json" in option.opts for option in command.params)
    }
    assert {"status", "prune"} <= printing
    assert not {name for name in printing if not any(f"{of}-".startswith(f"{name}-") for of in told)}


def references(schema: Any) -> Iterator[str]:
    """Yield what a schema refers to, at any depth."""
    if isinstance(schema, dict):
        yield from [schema["$ref"]] if "$ref" in schema else []
        schema = list(schema.values())
    for part in schema if isinstance(schema, list) else ():
        yield from references(part)


def test_every_reference_is_to_a_definition_and_every_definition_is_referred_to() -> None:
    schemas = {path.name: json.loads(path.read_text()) for path in SCHEMAS.glob("*.json")}
    used = set()
    for name, schema in schemas.items():
        for reference in references(schema):
            file, _, pointer = reference.partition("#/$defs/")
            assert pointer in schemas[file or name]["$defs"], (name, reference)
            used.add((file or name, pointer))
    assert used == {(name, of) for name, schema in schemas.items() for of in schema.get("$defs", {})}
