"""docs/reference is generated: it must not drift from the code."""

import importlib.util
from pathlib import Path

DOCS = Path(__file__).parents[2] / "docs"


def test_committed_reference_is_what_the_code_says() -> None:
    spec = importlib.util.spec_from_file_location("generate", DOCS / "generate.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    committed = {name: (DOCS / "reference" / name).read_text(encoding="utf-8") for name in module.pages()}
    assert committed == module.pages(), "run 'make docs' and commit the result"
