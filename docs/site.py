"""The documentation as a site, hooks of MkDocs: the README as front page, a list of all errors, links into the code as text."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
CATALOGUE = "reference/error-catalogue.md"
_LINK = re.compile(r"(?<!!)\[([^\]]*)\]\(([^)#\s]+)(#[^)\s]*)?\)")
_HEAD = """# Every error

Messages of all errors, by error and module (`{…}` is filled in). Scripts use [exit codes and the tree of errors](errors.md). Generated with
the site.
"""


def on_files(files: Any, config: Any) -> Any:
    """Add the README as front page, and the generated page of errors."""
    from mkdocs.structure.files import File  # noqa: PLC0415  of the site's own environment

    front = (ROOT / "README.md").read_text(encoding="utf-8").replace("](docs/", "](").replace('src="docs/', 'src="')
    for name, text in (("index.md", front), (CATALOGUE, make_error_page())):
        files.append(File.generated(config, name, content=text))
    return files


def on_page_markdown(markdown: str, *, page: Any, config: Any, files: Any) -> str:  # noqa: ARG001  MkDocs' signature
    """Return a page whose links out of the documentation are text; keep decisions out of the search."""
    if page.file.src_uri.startswith("adr/"):
        page.meta["search"] = {"exclude": True}
    here = (ROOT / "docs" / page.file.src_uri).parent

    def link(match: re.Match[str]) -> str:
        target = match[2]
        if re.match(r"[a-z]+:", target) or (here / target).resolve().is_relative_to(ROOT / "docs"):
            return match[0]
        return match[1]

    return _LINK.sub(link, markdown)


def make_error_page() -> str:
    """Return the page of every error that the code raises, with its messages."""
    parts = [_HEAD]
    messages: dict[str, dict[str, list[str]]] = {}
    for path in sorted((ROOT / "tcpipe").rglob("*.py")):
        module = ".".join(path.relative_to(ROOT).with_suffix("").parts)
        for error, text in _iterate_errors(ast.parse(path.read_text(encoding="utf-8"))):
            messages.setdefault(error, {}).setdefault(module, []).append(text)
    for error, modules in sorted(messages.items()):
        parts.append(f"\n## {error}\n")
        for module, texts in modules.items():
            parts += [f"\n`{module}`\n", *(f"- `{text.replace('`', chr(39))}`" for text in dict.fromkeys(texts))]
    return "\n".join(parts) + "\n"


def _iterate_errors(tree: ast.Module) -> Iterator[tuple[str, str]]:
    """Yield each error's name and message."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id.endswith("Error"):
            for argument in node.args:
                text = _format_text(argument).strip()
                if re.search(r"[a-z]{3}", re.sub(r"\{.*?\}", "", text)):
                    yield node.func.id, text


def _format_text(node: ast.expr) -> str:
    """Return a string expression with its parts in braces; "" of anything else."""
    match node:
        case ast.Constant(value=str(value)):
            return value
        case ast.JoinedStr(values=values):
            return "".join(_format_text(value) for value in values)
        case ast.FormattedValue(value=value):
            return f"{{{re.sub(r'[^a-zA-Z0-9_. ]', '', ast.unparse(value))[:30] or '…'}}}"
        case ast.BinOp(left=left, op=ast.Add(), right=right):
            return _format_text(left) + _format_text(right)
        case _:
            return ""
