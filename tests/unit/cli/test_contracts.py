"""schemas/ is generated: it must not drift from the tables, the recipe, the documents and the answers."""

from pathlib import Path

from tcpipe.cli import cli
from tcpipe.cli.answers import answers, every_contract

SCHEMAS = Path(__file__).parents[3] / "schemas"


def test_committed_schemas_are_what_the_code_says() -> None:
    committed = {path.name: path.read_text() for path in SCHEMAS.glob("*.json")}
    assert committed == every_contract(), "run 'make schemas' and commit the result"


def test_every_command_that_prints_json_has_a_contract_of_it() -> None:
    told = {name.removesuffix(".answer") for name in answers() if name.endswith(".answer")}
    printing = {
        name
        for name, command in cli.commands.items()
        if not command.hidden and any("--json" in option.opts for option in command.params)
    }
    assert {"status", "prune", "migrate"} <= printing
    assert not {name for name in printing if not any(f"{of}-".startswith(f"{name}-") for of in told)}
