"""The fuzz targets of the log reader: their corpus with seeded changes."""

import importlib.util
import sys
from pathlib import Path

import numpy as np
import pytest

TARGET_FILE = Path(__file__).with_name("fuzz_log_reading.py")
_spec = importlib.util.spec_from_file_location("fuzz_log_reading", TARGET_FILE)
fuzz_log_reading = importlib.util.module_from_spec(_spec)
sys.modules[_spec.name] = fuzz_log_reading
_spec.loader.exec_module(fuzz_log_reading)
TARGETS = fuzz_log_reading.TARGETS

CHANGES = 8
"""Changed copies of each input of a corpus."""


def changed(data, rng):
    """Flip, overwrite, cut, double or insert some bytes."""
    held = bytearray(data)
    for _ in range(rng.integers(1, 5)):
        at, size = int(rng.integers(len(held) + 1)), int(rng.integers(1, 9))
        kind = rng.integers(5)
        if kind == 0 and at < len(held):
            held[at] ^= 1 << int(rng.integers(8))
        elif kind == 1:
            held[at : at + size] = rng.choice([b"\0", b"\xff", b"\x7f"]) * size
        elif kind == 2:
            del held[at : at + size]
        elif kind == 3:
            held[at:at] = held[at : at + 40 * size]
        else:
            held[at : at + size] = rng.bytes(size)
    return bytes(held)


@pytest.mark.parametrize("name", TARGETS)
def test_inputs_and_changed_inputs_break_nothing(name):
    target, rng = TARGETS[name], np.random.default_rng(3)
    for data in target.corpus():
        target.read(data)
        for _ in range(CHANGES):
            target.read(changed(data, rng))
