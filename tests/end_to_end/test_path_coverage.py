"""The quick part of ``benchmarks/path_coverage.py``: 90 % intervals hold about 90 % of further simulated drives."""

import sys
from pathlib import Path

import pytest

pytest.importorskip("lightgbm")
sys.path.append(str(Path(__file__).parents[2] / "benchmarks"))

import path_coverage


def test_intervals_of_metres_and_paths_hold_what_further_drives_measure():
    found = path_coverage.coverage(train=10, metres=300.0, further=20, seed=4)
    for (name, metres), held in found.items():
        assert held.low - 0.03 <= 0.9 <= held.high + 0.03, (name, metres, held)  # of eight 95 % intervals one may miss
    widths = [found["energy", metres].half_width for metres in path_coverage.LENGTHS]
    assert widths == sorted(widths, reverse=True)
