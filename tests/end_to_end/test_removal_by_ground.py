"""Metres in use by class and slope against the truth of a drive that crawls wherever there is mud."""

import json

import numpy as np
import pytest

from tcpipe.pipeline.dataset.build import build_dataset
from tcpipe.pipeline.ingest import ingest
from tcpipe.pipeline.maps import add_map
from tcpipe.simulation import Faults, read_truth, simulate
from tcpipe.simulation.messages import Recorder
from tcpipe.simulation.route import Leg, Pause
from tcpipe.simulation.scenarios import DriveSpec, RasterSpec, Scenario, make_small_world
from tcpipe.tables.bits import DropReason
from tcpipe.terrain.layers import PAPER_CLASSES

LAP = (
    Leg(((33.0, 22.0),), command=0.5),
    Leg(((33.0, 36.0),)),
    Leg(((12.0, 36.0),)),
    Leg(((12.0, 22.0),)),
)


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    plan = (Pause(2.0), *LAP, *LAP, Pause(1.0))
    drive = DriveSpec("laps", plan, (12.0, 22.0), recorder=Recorder("ros2", "clearpath_power"), faults=Faults())
    region = ((2.0, 2.0), (60.0, 2.0), (60.0, 78.0), (2.0, 78.0))
    scenario = Scenario("laps", make_small_world(), (drive,), region, RasterSpec(0.1, 0.12, 0.1))
    return simulate(tmp_path_factory.mktemp("laps") / "site", scenario=scenario, seed=2)


@pytest.fixture(scope="module")
def card(site):
    here = site.directory.parent
    assert ingest(site.logs, store=here / "store").exit_code == 0
    rasters = site.rasters
    add_map(
        "site", store=here / "store", height=rasters["height"], terrain=rasters["terrain"], classes=rasters["classes"]
    )
    build_dataset(here / "dataset", store=here / "store")
    return json.loads((here / "dataset" / "dataset.json").read_text())


@pytest.mark.parametrize("table", ["by_class", "by_slope"])
def test_tables_add_up_to_the_ledger(card, table):
    groups, ledger = card["removal"][table], card["distance_by_reason_m"]
    assert sum(group["driven_m"] for group in groups) == pytest.approx(sum(ledger.values()), rel=1e-3)
    in_samples = ledger["kept"]
    assert sum(group["used_m"] for group in groups) == pytest.approx(in_samples, rel=1e-3)
    for bit in DropReason:
        name = bit.name.lower()
        removed = sum(group["removed_m"].get(name, 0.0) for group in groups)
        assert removed == pytest.approx(ledger[name], abs=0.01)
    for group in groups:
        assert group["used_m"] + sum(group["removed_m"].values()) == pytest.approx(group["driven_m"])


def test_classes_are_those_that_were_driven_on(card, site):
    truth = read_truth(site.truths[0])
    steps, ground = np.diff(truth.distance_m), truth.terrain_class[:-1]
    names = {entry.id: entry.name for entry in PAPER_CLASSES.classes}
    wanted = {names[number]: steps[ground == number].sum() for number in np.unique(ground)}
    found = {group["name"]: group["driven_m"] for group in card["removal"]["by_class"]}
    for name, metres in wanted.items():
        assert found.get(name, 0.0) == pytest.approx(metres, abs=1.0)


def test_slopes_are_those_that_were_driven(card, site):
    truth = read_truth(site.truths[0])
    steep = np.diff(truth.distance_m)[np.degrees(truth.slope_rad[:-1]) > 5.0].sum()
    found = sum(g["driven_m"] for g in card["removal"]["by_slope"] if g["name"] in ("5° to 10°", "above 10°"))
    assert found == pytest.approx(steep, abs=0.1 * steep + 2.0)


def test_mud_that_is_only_crawled_over_is_warned_of(card):
    (mud,) = [group for group in card["removal"]["by_class"] if group["name"] == "mud"]
    assert mud["driven_m"] > 20.0
    assert mud["used_share"] < 0.1
    biased = [of for of in card["findings"] if of["code"] == "selection-bias"]
    assert {"kind": "class", "name": "mud"} in [of["subject"] for of in biased]
    assert {of["names"]["reason"] for of in biased if of["subject"]["name"] == "mud"} == {"below_full_speed"}
