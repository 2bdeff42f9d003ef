"""schemas/ is generated: it must not drift from the tables, the recipe, the documents and the answers."""

from pathlib import Path

from tcpipe.cli.answers import every_contract

SCHEMAS = Path(__file__).parents[3] / "schemas"


def test_committed_schemas_are_what_the_code_says() -> None:
    committed = {path.name: path.read_text() for path in SCHEMAS.glob("*.json")}
    assert committed == every_contract(), "run 'make schemas' and commit the result"
