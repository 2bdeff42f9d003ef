"""docs/reference is generated: it must not drift from the code."""

import json
import subprocess
import sys
from pathlib import Path

from tcpipe.tables.findings import read_catalogue

DOCS = Path(__file__).parents[2] / "docs"
BEFORE = {"commands": ["ingest", "ingest --store"], "recipe": ["read.topics"]}
NOW = (BEFORE | {"recipe": ["fuse.gate", "read.topics"]}, BEFORE | {"commands": ["ingest"]})
PROGRAM = f"""
import json, generate, stable
pages, committed = generate.pages(), json.loads(stable.FILE.read_text(encoding="utf-8"))
pairs = [(committed, json.loads(pages["stable.json"])), *(({BEFORE}, now) for now in {NOW})]
print(json.dumps([pages, [stable.find_lost_names(*pair) for pair in pairs]]))
"""
"""In a process of its own: click keeps the help option of the first context that asks a command for it."""


def test_committed_reference_is_what_the_code_says_and_a_lost_name_is_an_error() -> None:
    done = subprocess.run([sys.executable, "-c", PROGRAM], cwd=DOCS, capture_output=True, text=True, check=True)
    pages, (lost, none, one) = json.loads(done.stdout)
    committed = {name: (DOCS / "reference" / name).read_text(encoding="utf-8") for name in pages}
    before, now = (json.loads(of.pop("stable.json")) for of in (committed, pages))
    assert not lost
    assert [code for code in read_catalogue() if f"`[{code}]`" not in pages["findings.md"]] == []
    assert before == now, "an addition to what is stable: a minor version; run 'make docs' and commit the result"
    assert committed == pages, "run 'make docs' and commit the result"
    assert not none, "a new name is no error"
    assert "commands: ingest --store" in one
    assert "next major version" in one
