"""The modules of tcpipe/ by their path in it, as text and as syntax; read once, and only where a test asks."""

import ast
from functools import cache
from pathlib import Path

PACKAGE = Path(__file__).parents[1] / "tcpipe"


@cache
def read_sources() -> dict[str, str]:
    return {path.relative_to(PACKAGE).as_posix(): path.read_text() for path in sorted(PACKAGE.rglob("*.py"))}


@cache
def read_trees() -> dict[str, ast.Module]:
    return {path: ast.parse(source) for path, source in read_sources().items()}


@cache
def read_nodes() -> dict[str, list[ast.AST]]:
    return {path: list(ast.walk(tree)) for path, tree in read_trees().items()}
