"""The tutorials and the pages that go with it: every command runs, and prints what the page says, numbers aside."""

import importlib.util
import re
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
