"""docs/reference is generated: it must not drift from the code."""

import json
import subprocess
import sys
from pathlib import Path

DOCS = Path(__file__).parents[2] / "docs"
PAGES = "import json, generate; print(json.dumps(generate.pages()))"


def test_committed_reference_is_what_the_code_says() -> None:
    # In a process of its own: click keeps the help option of the first context that asks a command for it.
    told = subprocess.run([sys.executable, "-c", PAGES], cwd=DOCS, capture_output=True, text=True, check=True).stdout
    pages = json.loads(told)
    committed = {name: (DOCS / "reference" / name).read_text(encoding="utf-8") for name in pages}
    assert committed == pages, "run 'make docs' and commit the result"
