"""docs/reference is generated: it must not drift from the code."""

import json
import subprocess
import sys
from pathlib import Path

DOCS = Path(__file__).parents[2] / "docs"
PAGES = "import json, generate; print(json.dumps(generate.pages()))"
LOST = "import json, sys, stable; print(stable.find_lost_names(*json.load(sys.stdin)))"


def run(program: str, given: object = None) -> str:
    """Run it in a process of its own: click keeps the help option of the first context that asks a command for it."""
    command = [sys.executable, "-c", program]
    done = subprocess.run(command, cwd=DOCS, input=json.dumps(given), capture_output=True, text=True, check=True)
    return done.stdout


def test_committed_reference_is_what_the_code_says() -> None:
    pages = json.loads(run(PAGES))
    committed = {name: (DOCS / "reference" / name).read_text(encoding="utf-8") for name in pages}
    before, now = (json.loads(of.pop("stable.json")) for of in (committed, pages))
    assert not run(LOST, (before, now)).strip()
    assert before == now, "an addition to what is stable: a minor version; run 'make docs' and commit the result"
    assert committed == pages, "run 'make docs' and commit the result"


def test_a_name_that_is_gone_is_an_error_and_a_new_one_is_none() -> None:
    before = {"commands": ["ingest", "ingest --store"], "recipe": ["read.topics"]}
    assert not run(LOST, (before, before | {"recipe": ["fuse.gate", "read.topics"]})).strip()
    message = run(LOST, (before, before | {"commands": ["ingest"]}))
    assert "commands: ingest --store" in message
    assert "hidden alias" in message
