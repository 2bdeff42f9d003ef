"""The protocol below every command that writes, broken at each of its steps: the quick part of ``benchmarks/faults.py``."""

import subprocess
import sys
from pathlib import Path

COMMAND = Path(__file__).parents[2] / "benchmarks" / "faults.py"


def test_nothing_is_wrong_after_a_fault_at_any_step():
    done = subprocess.run(
        [sys.executable, COMMAND, "faults", "--only", "a directory over another", "--times", "0"],
        capture_output=True, text=True, timeout=600, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    together = next(line.split() for line in done.stdout.splitlines() if line.startswith("together"))
    assert all(int(count) > 25 for count in together[1:4]), "the protocol has fewer steps than it had"
