"""The installed ``tcpipe`` command, run as a user runs it."""

import json
import os
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

COMMAND = Path(sys.executable).parent / "tcpipe"
HANGS_S = 3600.0
"""After this long a command hangs; a machine that others use takes its time."""


def tcpipe(
    *arguments: str | Path, cwd: Path, env: Mapping[str, str] | None = None, timeout_s: float = HANGS_S
) -> subprocess.CompletedProcess[str]:
    """Run the command; nothing of the caller's TCPIPE_ environment reaches it."""
    clean = {key: value for key, value in os.environ.items() if not key.startswith("TCPIPE_")}
    return subprocess.run(
        [COMMAND, *map(str, arguments)],
        cwd=cwd,
        env={**clean, **(env or {})},
        capture_output=True,
        text=True,
        timeout=timeout_s,
        check=False,
    )


def told(done: subprocess.CompletedProcess[str]) -> dict[str, Any]:
    """Return the last JSON object of ``ingest --json``, that of all logs; those before are of the same logs, one each."""
    *each, of_all = [json.loads(line) for line in done.stdout.splitlines()]
    assert {line["kind"] for line in each} <= {"log"}
    assert of_all["kind"] == "summary"
    assert sorted(line["log"] for line in each) == sorted(result["log"] for result in of_all["results"])
    return of_all


def plain_lines(done: subprocess.CompletedProcess[str], code: int, most: int = 3) -> str:
    """Assert that the command ended with ``code`` and at most ``most`` plain lines, no traceback; return stderr."""
    assert done.returncode == code, done.stderr
    assert "Traceback" not in done.stderr
    lines = [line for line in done.stderr.splitlines() if line.startswith("tcpipe:") or "FAILED" in line]
    assert 1 <= len(lines) <= most, done.stderr
    return done.stderr
