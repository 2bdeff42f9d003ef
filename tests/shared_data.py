"""Third-party files for tests: outside the project, named by TCPIPE_TEST_DATA or beside the checkout."""

import os
from pathlib import Path

import pytest

_ROOT = Path(os.environ.get("TCPIPE_TEST_DATA", Path(__file__).parents[2] / "shared" / "data"))


def shared_data(name: str) -> Path:
    """Return the path of a third-party file, or skip the test with a reason."""
    path = _ROOT / name
    if not path.exists():
        pytest.skip(f"third-party file {name} is not here (docs/internals/tests.md says where it comes from)")
    return path
