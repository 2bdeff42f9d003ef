"""Drives with a fault each: following a printed line makes no label wrong and sure that was not before."""

import numpy as np
import pytest
from faulty_drives import SHORT_M, make_drives
from suggested_recipes import recipe_that_follows

from tcpipe.formats.logs.writing import write_mcap
from tcpipe.pipeline.ingest import ingest
from tcpipe.simulation import compute_true_cost
from tcpipe.store import Store
from tcpipe.tables.columns import to_floats, to_integers

MIN_COVERAGE = 0.8
"""Share of true labels inside 2σ below which a label is wrong."""


FAULTS = ("imu_late", "gyroscope_mirrored", "wheels_too_fast", "fixes_jump", "currents_in_milliamperes")
"""Faults whose printed lines test_bad_sensors.py and test_power_sensor.py do not follow."""


@pytest.fixture(scope="module")
def drives():
    return make_drives(*FAULTS, length_m=SHORT_M)


def find_wrong_and_sure(drive, result, store):
    """Return the labels of a run that are usable by the verdict, and of which too few without a flag are inside 2σ."""
    if result.run is None or not result.run.segments:
        return set()
    (run,) = Store(store).runs()
    segments = run.segments()
    unflagged = to_integers(segments, "quality") == 0
    true = compute_true_cost(drive.truth, to_integers(segments, "start_ns"))
    found = set()
    for label, name, unit in (("time", "duration", "s"), ("energy", "energy", "joule")):
        error = np.abs(to_floats(segments, f"{name}_{unit}") - getattr(true, f"{name}_{unit}"))
        known = np.isfinite(error) & unflagged
        inside = error[known] < 2.0 * to_floats(segments, f"{name}_std_{unit}")[known]
        if getattr(result.verdict, label) != "not usable" and known.any() and inside.mean() < MIN_COVERAGE:
            found.add(label)
    return found


@pytest.mark.parametrize("name", FAULTS)
def test_followed_lines_make_no_label_wrong_and_sure(drives, tmp_path, name):
    log, drive = tmp_path / "drive.mcap", drives[name]
    write_mcap(log, drive.messages)
    (before,) = ingest([log], store=tmp_path / "before").results
    wrong = find_wrong_and_sure(drive, before, tmp_path / "before")
    assert not wrong
    remedies = [
        (finding, number)
        for finding in before.findings
        for number, remedy in enumerate(finding.remedies)
        if remedy.recipe
    ]
    for number, (finding, alternative) in enumerate(remedies):
        store = tmp_path / f"after-{number}"
        (after,) = ingest([log], store=store, recipe=recipe_that_follows(finding, alternative=alternative)).results
        assert after.run is not None
        assert find_wrong_and_sure(drive, after, store) <= wrong
