"""Logs whose power has a wrong scale or lacks a side: the witness that contradicts it, and the line that corrects it."""

import numpy as np
import pytest
from changed_drives import energy_ratio
from faulty_drives import SHORT_M, scale, simulate_drive
from suggested_recipes import recipe_that_follows

from tcpipe.formats.finding_lines import list_verdict
from tcpipe.formats.logs.writing import write_mcap
from tcpipe.formats.recipe_toml import parse_recipe
from tcpipe.pipeline.ingest import ingest

CODE = "power-implausible"


@pytest.fixture(scope="module")
def drive():
    return simulate_drive(length_m=SHORT_M)


def ingest_drive(drive, folder, recipe=None):
    folder.mkdir(exist_ok=True)
    log = folder / "drive.mcap"
    if not log.exists():
        write_mcap(log, drive.messages)
    (result,) = ingest([log], store=folder / "store", recipe=recipe or parse_recipe({}, where="test")).results
    return result, {finding.code: finding for finding in result.findings}


def read_energy_line(result):
    return next(line for line in list_verdict(result.verdict) if line.startswith("energy"))


def test_slopes_confirm_a_sound_run(drive, tmp_path):
    result, found = ingest_drive(drive, tmp_path)
    assert CODE not in found
    assert result.verdict.confirmed_by["energy"] == ("slope",)
    assert set(result.verdict.confirmed_by["position"]) == {"wheel_odometry", "visual_odometry"}
    assert read_energy_line(result).endswith("J/m · confirmed by: slope (to a factor of three) · usable")


def test_a_wrong_unit_is_not_usable_until_the_printed_line_corrects_it(drive, tmp_path):
    wrong = scale(drive, "power", 10.0, "measured_currents")
    result, found = ingest_drive(wrong, tmp_path / "wrong")
    assert result.verdict.energy == "not usable"
    assert result.verdict.confirmed_by["energy"] == ("nothing",)
    assert found[CODE].names["witness"] == "slope"
    corrected, left = ingest_drive(wrong, tmp_path / "right", recipe_that_follows(found[CODE]))
    assert CODE not in left
    assert corrected.verdict.energy == "usable"
    assert corrected.verdict.confirmed_by["energy"] == ("slope",)
    assert energy_ratio(drive, tmp_path / "right" / "store") == pytest.approx(1.0, abs=0.02)


def test_without_a_mass_nothing_confirms_the_energy(drive, tmp_path):
    unknown = parse_recipe({"robot": "mine", "robots": {"mine": {"platform": "A200"}}}, where="test")
    result, found = ingest_drive(scale(drive, "power", 10.0, "measured_currents"), tmp_path, unknown)
    assert CODE not in found
    assert result.verdict.energy == "usable with care"
    assert "confirmed by: nothing (no charge, no second meter, mass unknown)" in read_energy_line(result)


def test_one_side_without_current_is_not_usable(drive, tmp_path):
    def remove_side(columns):
        currents = columns["measured_currents"].copy()
        currents[:, 1] = 0.4 + 0.02 * np.random.default_rng(1).standard_normal(len(currents))
        return {"measured_currents": currents}

    result, found = ingest_drive(drive.changed("power", remove_side), tmp_path)
    assert found["power-side-missing"].numbers["share_fraction"] < 0.05
    assert result.verdict.energy == "not usable"
