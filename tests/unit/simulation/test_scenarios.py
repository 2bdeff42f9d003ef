"""Scenarios and the page that describes them."""

import re
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest

from tcpipe.simulation import Faults, compute_true_cost, find_scenario
from tcpipe.simulation.scenarios import SCENARIOS

PAGE = (Path(__file__).parents[3] / "docs" / "reference" / "simulation.md").read_text(encoding="utf-8")


def test_the_reference_names_every_scenario_and_fault():
    heads = re.findall(r"^- (`\w+`(?:, `\w+`)*):", PAGE, flags=re.MULTILINE)
    assert {name for head in heads for name in re.findall(r"\w+", head)} == set(SCENARIOS) | {
        field.name for field in fields(Faults)
    }


@pytest.mark.parametrize("name", sorted(SCENARIOS))
def test_every_scenario_starts_on_free_ground_inside_its_site(name):
    made = find_scenario(name)
    for drive in made.drives:
        x, y = (
            np.array([offset + at])
            for offset, at in zip((made.world.site.west_m, made.world.site.south_m), drive.start_m, strict=True)
        )
        assert made.world.terrain_class(x, y)[0] >= 4
        assert 0 < drive.start_m[0] < made.world.site.width_m
        assert 0 < drive.start_m[1] < made.world.site.height_m


def test_hills12_is_twelve_hilly_minutes(long_truth):
    assert (long_truth.stamp_ns[-1] - long_truth.stamp_ns[0]) * 1e-9 == pytest.approx(720, abs=40)
    fast = long_truth.forward_velocity_mps > 0.5
    slopes = np.degrees(long_truth.slope_rad[fast])
    assert slopes.min() < -18
    assert slopes.max() > 18
    assert long_truth.power_watt[fast].mean() == pytest.approx(155, abs=15)  # the paper's 150 to 165 W
    assert (long_truth.power_watt < 0).sum() > 1000


def test_a_metre_costs_what_the_paper_found(long_truth):
    steady = (long_truth.command_velocity_mps > 0.99) & (long_truth.forward_velocity_mps > 0.6)
    cost = compute_true_cost(long_truth, long_truth.stamp_ns[steady][::200])
    assert np.nanmedian(cost.duration_s) == pytest.approx(1.2, abs=0.1)
    assert np.nanmean(cost.energy_joule) == pytest.approx(200, abs=30)
