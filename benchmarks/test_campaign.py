"""A quick part of the campaign (docs/internals/tests.md): no label is sure and wrong, whatever is wrong with the log."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

sys.path.append(str(Path(__file__).parent))

import campaign
from campaign_drives import FIRST_SEED, Fault, outcome_of, simulated
from campaign_faults import DOPPLER, FAULTS, VELOCITY_FAULTS, Cell, cells
from campaign_figures import LABELS, Figures, Result, figures_of
from campaign_map import MapResult

LENGTH_M = campaign.QUICK_LENGTH_M


@pytest.fixture(scope="session")
def clean() -> Result:
    """Return what all sensors without a fault give on a short drive."""
    return campaign.made(Cell("all", 10.0, FAULTS["clean"]), FIRST_SEED, length_m=LENGTH_M)


def figures(cell: Cell, clean: Result) -> Figures:
    return figures_of(cell, [campaign.made(cell, FIRST_SEED, length_m=LENGTH_M)], [clean])


def test_labels_of_a_clean_log_are_true_and_not_doubted(clean):
    found = figures_of(Cell("all", 10.0, FAULTS["clean"]), [clean], [clean])
    assert found.ladder["labelled"] > 0.8 * found.ladder["true"]
    assert found.doubted <= 0.02
    for name in LABELS:
        assert found.inside[name][2].value > 0.9


@pytest.mark.parametrize("name", ["metres, none claimed", "IMU pitched by 5 deg", "wrong fix"])
def test_no_label_is_sure_and_wrong(name, clean):
    """Few labels without a flag are off by more than two standard deviations."""
    found = figures(Cell("all", 10.0, FAULTS[name]), clean)
    assert not found.traces
    for label in LABELS:
        assert 1.0 - found.inside[label][2].value <= 0.1 if label in found.inside else found.doubted > 0.5
    assert "start" not in found.inside or 1.0 - found.inside["start"][2].value <= 0.15


def test_a_straight_drive_is_a_clean_log():
    """Where nothing turns, no mounting and no antenna is contradicted."""
    cell = Cell("all", 10.0, FAULTS["straight ahead"])
    result = campaign.made(cell, FIRST_SEED, length_m=40.0)
    found = figures_of(cell, [result], [result])
    assert found.doubted <= 0.02
    assert all(found.inside[name][2].value > 0.9 for name in ("T", "v", "E", "start"))
    assert not result.outcome.said


def test_a_log_of_five_seconds_ends_in_words():
    fault = FAULTS["5 s"]
    found = outcome_of(simulated(fault.route, FIRST_SEED, LENGTH_M), Cell("all", 10.0, fault).fitted, fault)
    assert not found.trace
    assert found.bits or found.said


def test_a_label_that_is_sure_and_wrong_is_found(clean):
    """The campaign itself: deviations that are a tenth of what they were, or doubt of everything, fail."""
    sure = replace_claimed(clean, 0.1)
    cell = Cell("all", 10.0, Fault("made up"))
    assert any("beyond 2 sigma" in line for line in figures_of(cell, [sure], [clean]).failures)
    wide = replace_claimed(clean, 10.0)
    assert any("RMS" in line for line in figures_of(cell, [wide], [clean]).failures)
    doubted = Result(0, replace(clean.outcome, bits=[1 << 8] * len(clean.outcome.bits)))
    assert figures_of(cell, [doubted], [clean]).failures == ["0% of good metres kept"]
    refused = Result(0, replace(clean.outcome, bits=[], start_s=[], placed=[], error=empty(), claimed=empty()), 40)
    assert figures_of(cell, [refused], [clean]).failures == ["1 of 1 runs refused needlessly"]


def replace_claimed(result: Result, factor: float) -> Result:
    claimed = {name: (factor * np.array(values)).tolist() for name, values in result.outcome.claimed.items()}
    return Result(0, replace(result.outcome, claimed=claimed))


def empty():
    return {name: [] for name in (*LABELS, "start")}


def test_cells_are_many_and_named_once():
    names = [cell.name for cell in cells()]
    assert len(names) == len(set(names)) >= 80


def test_a_footprint_is_no_word_about_feet():
    assert MapResult(["nearest train footprint 0.00 m"], False, 18.0).failures
    assert not MapResult(["its heights seem to be feet"], False, 18.0).failures


def test_a_receivers_own_velocity_makes_fixes_of_metres_worth_labels():
    """Once a second and 2.3 m off, fixes alone bear no segment; with it they do, and it claims what it errs by."""
    without, told = (
        campaign.made(Cell(sensors, 1.0, FAULTS["metres, claimed"]), FIRST_SEED, length_m=LENGTH_M).outcome
        for sensors in ("GNSS alone", f"GNSS alone{DOPPLER}")
    )
    assert without.bits == []
    assert len(told.bits) > 0.7 * told.true_m
    for label in ("T", "E"):
        assert np.mean(np.abs(told.error[label]) <= 2 * np.array(told.claimed[label])) > 0.9


def test_a_receivers_own_velocity_holds_the_track_while_fixes_float():
    without, told = (
        campaign.made(Cell(sensors, 5.0, FAULTS["float minute"]), FIRST_SEED, length_m=LENGTH_M).outcome
        for sensors in ("no visual", f"no visual{DOPPLER}")
    )
    for label in ("T", "start"):
        error, usual = (np.sqrt(np.mean(np.square(of.error[label]))) for of in (told, without))
        assert error < usual


@pytest.mark.parametrize("name", ["velocity 0 for a minute", "velocity north, east, down", "velocity 0.2 s late"])
def test_a_velocity_that_lies_moves_no_label(name, clean):
    """It is left out, or refused where it lies, and named: the labels are what they are without it."""
    result = campaign.made(Cell(f"all{DOPPLER}", 10.0, VELOCITY_FAULTS[name]), FIRST_SEED, length_m=LENGTH_M)
    # A lag of 0.2 s is estimated; a minute at 0 moves no label, and may go without a name.
    is_harmless = name in {"velocity 0.2 s late", "velocity 0 for a minute"}
    assert is_harmless or any("gnss_velocity" in line for line in result.outcome.said)
    for label in ("T", "E"):
        error, usual = (np.sqrt(np.mean(np.square(of.error[label]))) for of in (result.outcome, clean.outcome))
        assert error < 1.1 * usual
