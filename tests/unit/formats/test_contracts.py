"""schemas/ is generated: it must not drift from the tables and the recipe."""

from pathlib import Path

from tcpipe.formats.contracts import contracts

SCHEMAS = Path(__file__).parents[3] / "schemas"


def test_committed_schemas_are_what_the_code_says() -> None:
    committed = {path.name: path.read_text() for path in SCHEMAS.glob("*.json")}
    assert committed == contracts(), "run 'make schemas' and commit the result"
