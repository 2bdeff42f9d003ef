"""Each command and option has a test that runs it: capabilities.toml names one for each."""

import ast
import re
import tomllib
from functools import cache
from pathlib import Path

import pytest

from tcpipe.cli import cli

TESTS = Path(__file__).parents[1]
ROWS = tomllib.loads((TESTS / "capabilities.toml").read_text())
COMMANDS = {name: command for name, command in cli.commands.items() if not command.hidden}
OPTIONS = {
    (name, option.opts[0]): option
    for name, command in COMMANDS.items()
    for option in command.params
    if option.opts[0].startswith("--") and not option.hidden
}


@cache
def _read_definitions(path: Path) -> dict[str, str]:
    """Return the source of each function and value that a module defines."""
    source = path.read_text()
    return {
        name: "\n".join(source.splitlines()[_first_line(node) - 1 : node.end_lineno])
        for node in ast.parse(source).body
        for name in (
            [node.name]
            if isinstance(node, ast.FunctionDef | ast.ClassDef)
            else [of.id for of in getattr(node, "targets", []) if isinstance(of, ast.Name)]
        )
    }


def _first_line(node: ast.stmt) -> int:
    return min([node.lineno, *(of.lineno for of in getattr(node, "decorator_list", []))])


def _read_test(where: str) -> str:
    """Return the source of a test with the functions, fixtures and values of its module that it uses; empty if there is none."""
    path, _, name = where.partition("::")
    known = _read_definitions(TESTS / path) if (TESTS / path).is_file() else {}
    found, left = dict[str, str](), {name}
    while left := {of for of in left if of in known and of not in found}:
        found |= {of: known[of] for of in left}
        left = {word for of in left for word in re.findall(r"\w+", known[of])}
    return "\n".join(found.values())


def test_every_option_has_a_row_and_every_row_an_option() -> None:
    rows = {(command, option) for command, of in ROWS.items() for option in of}
    assert rows == {*OPTIONS, *((name, "command") for name in COMMANDS)}


@pytest.mark.parametrize("command", ROWS)
def test_the_test_of_a_row_exists_and_names_what_it_runs(command: str) -> None:
    wrong = []
    for option, where in ROWS[command].items():
        words, keyword = [command, command.replace("-", "_")], []
        if option != "command":
            given = OPTIONS[command, option]
            words, keyword = [*given.opts, *given.secondary_opts], [rf"\b{given.name}="]
        patterns = [*(rf"(?<![\w-]){word}(?![\w-])" for word in words), *keyword]
        if not re.search("|".join(patterns), _read_test(where)):
            wrong.append(f"{option}: {where}")
    assert not wrong
