"""The notebook of the documentation, run as plain Python, and the ten lines of the reference, which are its lines."""

import ast
import json
import re
from pathlib import Path

DOCS = Path(__file__).parents[2] / "docs"


def run_cell(source, names):
    """Execute a cell; return the value of its last line if that is an expression."""
    *body, last = ast.parse(source).body
    exec(compile(ast.Module(body, []), "cell", "exec"), names)  # noqa: S102  our own notebook
    if isinstance(last, ast.Expr):
        return eval(compile(ast.Expression(last.value), "cell", "eval"), names)  # noqa: S307
    exec(compile(ast.Module([last], []), "cell", "exec"), names)  # noqa: S102
    return None


def test_every_cell_runs_and_results_are_tables(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    notebook = json.loads((DOCS / "notebook.ipynb").read_text())
    cells = ["".join(cell["source"]) for cell in notebook["cells"] if cell["cell_type"] == "code"]
    names = {}
    values = {cell.splitlines()[-1]: run_cell(cell, names) for cell in cells}
    tables = [value._repr_html_() for value in values.values() if hasattr(value, "_repr_html_")]
    assert len(tables) == 3
    run, dataset, evaluation = tables
    assert re.search(r"energy per distance</td><td[^>]*>[\d.]+ Wh/km<", run)
    assert re.search(r">train</td><td[^>]*>150</td>", dataset)
    assert 'src="data:image/png;base64,' in dataset
    assert re.search(r">unseen</td><td[^>]*>E</td>", evaluation)
    assert values["str(plan)"].startswith("least energy: ")
    (block,) = re.findall(
        r"^```python\n(import tcpipe\n.*?)^```$", (DOCS / "reference/python.md").read_text(), re.MULTILINE | re.DOTALL
    )
    known = "\n".join(cells)
    assert [line for line in block.splitlines() if line.removeprefix("ingested = ") not in known] == []
