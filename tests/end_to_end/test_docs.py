"""The tutorials, the pages that go with them and the notebook: every command runs, and prints what the page says, numbers aside."""

import ast
import importlib.util
import json
import re
import shutil
from pathlib import Path

import pytest
from installed_command import run_script

DOCS = Path(__file__).resolve().parents[2] / "docs"
TUTORIALS = sorted(f"tutorials/{page.name}" for page in (DOCS / "tutorials").glob("*.md"))
PAGES = (*TUTORIALS, "how-to/damaged-logs.md", "how-to/questions.md")


def _masked(text: str) -> list[str]:
    """Return lines with runs of digits, hashes and blanks as one sign each; lists in alphabetical order, not by size."""
    text = re.sub(r"(?<![\d.])\b[0-9a-f]{8}(?:[0-9a-f]{8})?\b", "#", text)
    text = re.sub(r"[ ]+([\],])", r"\1", text)  # numpy pads its arrays to the widest number, which differs by processor
    text = re.sub(r"[-+]?\b\d[\d.,e+-]*", "#", text)
    text = re.sub(r"[ ]*([\[\],])[ ]*", r"\1 ", text)
    return [re.sub(r"[\s─═-]+", " ", ", ".join(sorted(line.split(", ")))).strip() for line in text.splitlines()]


@pytest.fixture(scope="module")
def rerun():
    spec = importlib.util.spec_from_file_location("rerun", DOCS / "rerun.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    module.run_script = run_script
    return module.rerun


@pytest.fixture(scope="module")
def readers_directory(tmp_path_factory) -> Path:
    """Where one reader follows all pages, in any order, each in a directory of its own."""
    return tmp_path_factory.mktemp("reader").resolve()


@pytest.mark.parametrize("page", PAGES)
def test_page_prints_what_it_says(page: str, rerun, readers_directory: Path) -> None:
    written = (DOCS / page).read_text(encoding="utf-8")
    today = rerun(DOCS / page, readers_directory)
    assert "Traceback" not in today
    assert _masked(today) == _masked(written), f"run 'python docs/rerun.py docs/{page}', read it, and commit the page"


def run_cell(source, names):
    """Execute a cell; return the value of its last line if that is an expression."""
    *body, last = ast.parse(source).body
    exec(compile(ast.Module(body, []), "cell", "exec"), names)  # noqa: S102  our own notebook
    if isinstance(last, ast.Expr):
        return eval(compile(ast.Expression(last.value), "cell", "eval"), names)  # noqa: S307
    exec(compile(ast.Module([last], []), "cell", "exec"), names)  # noqa: S102
    return None


def test_every_cell_of_the_notebook_runs_and_results_are_tables(tmp_path, monkeypatch, rerun, readers_directory):
    """Its site is that of the first tutorial, and its cells are the ten lines of the reference."""
    rerun(DOCS / "tutorials" / "first-dataset.md", readers_directory)
    shutil.copytree(readers_directory / "site-a" / "field", tmp_path / "site", copy_function=shutil.copy2)
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
