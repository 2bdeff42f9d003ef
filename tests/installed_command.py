"""The installed ``tcpipe`` command, run as a user runs it."""

import os
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path

COMMAND = Path(sys.executable).parent / "tcpipe"


def tcpipe(
    *arguments: str | Path, cwd: Path, env: Mapping[str, str] | None = None, timeout_s: float = 300.0
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


def plain_lines(done: subprocess.CompletedProcess[str], code: int, most: int = 3) -> str:
    """Assert that the command ended with ``code`` and at most ``most`` plain lines, no traceback; return stderr."""
    assert done.returncode == code, done.stderr
    assert "Traceback" not in done.stderr
    lines = [line for line in done.stderr.splitlines() if line.startswith("tcpipe:") or "FAILED" in line]
    assert 1 <= len(lines) <= most, done.stderr
    return done.stderr
