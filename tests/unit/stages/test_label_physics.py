"""The physics column of a simulated drive: the robot that drove it, an odd metre that shows, and no fit where there is none."""

import math
from dataclasses import replace

import numpy as np
import pytest
from simulated_streams import log_of, streams_of

from tcpipe.pipeline.ingest_run import run_stages
from tcpipe.recipe import Recipe
from tcpipe.simulation import Faults, find_scenario
from tcpipe.simulation.robot import GRAVITY_MPS2, SimulatedRobot
from tcpipe.simulation.route import Wander
from tcpipe.stages.label import add_physics
from tcpipe.tables.bits import Quality
from tcpipe.tables.columns import to_floats

USUAL = SimulatedRobot()
ROBOT = replace(
    USUAL,
    ground={name: replace(of, slip=0.0) for name, of in USUAL.ground.items()},
    slope_slip=0.0,
    scrub_half_radius_m=math.inf,
)


@pytest.fixture(scope="module")
def stages(tmp_path_factory):
    """400 m over hills and all classes, without sensor faults, of a robot without slip whose torque is the same on every curve."""
    hills = find_scenario("hills12")
    drive = replace(hills.drives[0], plan=Wander(400.0, (14.0, 34.0), climbing=0.5), faults=Faults(), robot=ROBOT)
    streams = streams_of(log_of(hills, drive, tmp_path_factory.mktemp("hills"), seed=3))
    return run_stages(streams, Recipe().ingest, run_id="run")


def test_the_fit_is_the_robot(stages):
    facts = stages[2].info.report.facts.label.physics
    assert facts.standing_watt == pytest.approx(ROBOT.idle_watt, rel=0.02)
    assert facts.weight_over_efficiency_newton == pytest.approx(
        ROBOT.mass_kg * GRAVITY_MPS2 / ROBOT.drive_efficiency, rel=0.05
    )
    assert 0.115 < facts.rolling_resistance < 0.22  # of all classes together
    assert facts.recovered_downhill == pytest.approx(ROBOT.drive_efficiency * ROBOT.regeneration_efficiency, abs=0.15)
    values = {of.term: of for of in facts.fit.terms}
    torque = ROBOT.scrub_torque_nm / ROBOT.drive_efficiency
    assert abs(values["turning"].value - torque) < max(0.05 * torque, 2.0 * values["turning"].std)
    assert values["turning"].std < 0.1 * torque
    assert facts.fit.held_out.r2 > 0.9
    assert sum(facts.fit.energy_share.values()) == pytest.approx(1.0, abs=0.03)


def test_the_prediction_stands_beside_the_label(stages):
    table = stages[2].table
    power, predicted = to_floats(table, "power_watt"), to_floats(table, "physics_power_watt")
    assert np.isfinite(predicted).all()
    assert 1 - np.var(power - predicted) / np.var(power) > 0.9  # the rest is terrain


def test_an_odd_metre_is_flagged_and_changes_nothing_for_the_others(stages):
    labelled = stages[2]
    power = to_floats(labelled.table, "power_watt").copy()
    power[7] += 300.0
    odd = labelled.table.set_column(
        labelled.table.schema.get_field_index("power_watt"), labelled.table.schema.field("power_watt"), [power]
    )
    table, facts = add_physics(odd, 14.0)
    flagged = np.flatnonzero(table["quality"].to_numpy() & np.uint32(Quality.PHYSICS_OUTLIER))
    assert 7 in flagged
    assert facts.outliers == flagged.size <= 3
    others = np.delete(np.arange(table.num_rows), 7)
    before = to_floats(labelled.table, "physics_power_watt")
    assert np.abs(to_floats(table, "physics_power_watt") - before)[others].max() < 2.0


def test_without_power_there_is_no_fit(stages):
    labelled = stages[2]
    field = labelled.table.schema.field("power_watt")
    dark = labelled.table.set_column(
        labelled.table.schema.get_field_index("power_watt"), field, [np.full(labelled.table.num_rows, np.nan)]
    )
    table, facts = add_physics(dark, np.nan)
    assert facts.fitted is False
    assert table is dark
