"""Power sensors that err, on a simulated drive over hills: labels against the truth, and what is found."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from scipy.stats import norm
from simulated_streams import streams_of

from tcpipe.pipeline.ingest_run import run_stages
from tcpipe.recipe import Recipe
from tcpipe.robots import Robot
from tcpipe.simulation import Faults, compute_true_cost, find_scenario, read_truth, simulate
from tcpipe.simulation.route import Wander
from tcpipe.simulation.scenarios import RasterSpec
from tcpipe.stages.fuse_sections import make_power_columns
from tcpipe.stages.label import label_segments
from tcpipe.stages.segment import segment_track
from tcpipe.tables.bits import Quality
from tcpipe.tables.columns import to_floats, to_integers
from tcpipe.tables.levels import MASKED_TRACK, STREAMS

NOISY = Faults.only("gnss_noise", "imu_noise", "wheel_noise", "visual_noise", "power_noise")
CODES = {"current-offset", "current-gain-changes", "current-sign-lost", "power-smoothed", "power-delayed"}
CODES |= {"motion-without-power"}


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    """Streams, masked track and truth of three minutes with halts; power errs afterwards."""
    plan = find_scenario("hills12")
    start_m = (14.0, 34.0)
    spec = replace(plan.drives[0], plan=Wander(150.0, start_m, climbing=0.5), start_m=start_m, faults=NOISY)
    single = replace(plan, drives=(spec,), rasters=RasterSpec(1.0, 1.0, 1.0))
    site = simulate(tmp_path_factory.mktemp("power"), scenario=single, seed=7)
    streams = streams_of(site.logs[0])
    _, masked, _ = run_stages(streams, Recipe().ingest, run_id="run")
    return streams, masked, read_truth(site.truths[0])


def label(drive, change=lambda amp, _: amp, recipe=None):
    """Label with the current [A] that ``change`` makes of the right one and the share of the drive that has passed."""
    streams, masked, _ = drive
    table = streams.tables["power"]
    stamp_ns = to_integers(table, "stamp_ns")
    share = (stamp_ns - stamp_ns[0]) / (stamp_ns[-1] - stamp_ns[0])
    columns = {name: table[name] for name in table.column_names}
    columns["current_amp"] = change(to_floats(table, "current_amp"), share)
    streams = replace(streams, tables={**streams.tables, "power": STREAMS["power"].table(**columns)})
    rows = masked.table
    power = make_power_columns(streams, 0, to_integers(rows, "stamp_ns"), max_gap_ns=300_000_000)
    masked = replace(
        masked, table=MASKED_TRACK.table(**{name: power.get(name, rows[name]) for name in rows.column_names})
    )
    recipe = recipe or Recipe()
    return label_segments(segment_track(masked, recipe.segment), masked, streams, recipe.label, robot=Robot())


def normalized(drive, labelled, name, part="std"):
    true = compute_true_cost(drive[2], to_integers(labelled.table, "start_ns"))
    quantity, unit = name.rsplit("_", 1)
    return (to_floats(labelled.table, name) - getattr(true, name)) / to_floats(
        labelled.table, f"{quantity}_{part}_{unit}"
    )


def find_codes(labelled):
    return {found.code: found for found in labelled.info.report.findings if found.code in CODES}


def average(amp, seconds):
    """Return the mean of the samples at 20 Hz so far back."""
    total = np.cumsum(np.concatenate((np.full(20 * seconds, amp[0]), amp)))
    return (total[20 * seconds :] - total[: -20 * seconds]) / (20 * seconds)


FAULTS = {
    "offset of 1 A": (lambda amp, _: amp + 1.0, "current-offset"),
    "offset of 0.5 A": (lambda amp, _: amp + 0.5, "current-offset"),
    "offset of -1 A": (lambda amp, _: amp - 1.0, "current-offset"),
    "zero moves by 1 A": (lambda amp, share: amp + (share > 0.5), "current-offset"),
    "unsigned": (lambda amp, _: np.abs(amp), "current-sign-lost"),
    "gain + 10 %": (lambda amp, share: amp * np.where(share > 0.5, 1.1, 1.0), "current-gain-changes"),
    "gain - 10 %": (lambda amp, share: amp * np.where(share > 0.4, 0.9, 1.0), "current-gain-changes"),
    "mean of 2 s": (lambda amp, _: average(amp, 2), "power-smoothed"),
    "mean of 6 s": (lambda amp, _: average(amp, 6), "power-smoothed"),
    "two means of 1 s": (lambda amp, _: average(average(amp, 1), 1), "power-delayed"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_is_named_and_labels_are_no_more_wrong_than_they_say(drive, fault):
    change, code = FAULTS[fault]
    labelled = label(drive, change)
    assert set(find_codes(labelled)) == {code}
    for name in ("power_watt", "energy_joule"):
        assert np.mean(np.abs(normalized(drive, labelled, name)) < 2.0) >= 0.92, name


@pytest.mark.parametrize("delay_s", [0.0, 0.2, 0.6])
def test_the_delay_of_power_is_in_the_uncertainty(drive, delay_s):
    stamp_ns = to_integers(drive[0].tables["power"], "stamp_ns")
    share = delay_s / ((stamp_ns[-1] - stamp_ns[0]) * 1e-9)
    labelled = label(drive, lambda amp, at: np.interp(at - share, at, amp))
    found_s, std_s = labelled.info.report.facts.label.power_sensor.delay_s
    assert abs(found_s - delay_s) < 3.0 * std_s < 0.15
    for name in ("power_watt", "energy_joule"):
        assert np.mean(np.abs(normalized(drive, labelled, name)) < 2.0) >= 0.92
    error = labelled.info.report.facts.label.energy_budget.delay
    assert error < 0.005 if delay_s == 0.0 else error == pytest.approx(0.14 * delay_s, rel=0.3)
    assert not (to_integers(labelled.table, "quality") & int(Quality.CLOCK_DOUBTFUL)).any()
    found = find_codes(labelled)
    assert set(found) <= {"power-delayed"}
    assert len(found) == 1 if delay_s > 0.3 else not found or delay_s > 0.1
    for finding in found.values():
        (remedy,) = finding.remedies
        assert remedy.recipe["read.time_offset_s"]["power"] == pytest.approx(-delay_s, abs=0.06)


def test_motion_with_the_power_of_rest_is_named_with_its_span_and_a_line_that_drops_it(drive):
    """Pushed for a seventh of the drive; a robot that rolls downhill without power is driven."""
    pushed = lambda amp, share: np.where((share > 0.40) & (share < 0.55), amp[:40].mean(), amp)  # noqa: E731
    labelled = label(drive, pushed)
    found = find_codes(labelled)
    stamp_ns = to_integers(drive[0].tables["power"], "stamp_ns")
    whole_s = (stamp_ns[-1] - stamp_ns[0]) * 1e-9
    assert set(found) == {"motion-without-power"}
    begin_s, end_s = found["motion-without-power"].span_s
    assert 0.38 * whole_s < begin_s < 0.50 * whole_s < end_s < 0.58 * whole_s
    unpowered = (to_integers(labelled.table, "quality") & int(Quality.UNPOWERED)) != 0
    inside_s = (to_integers(labelled.table, "start_ns")[unpowered] - stamp_ns[0]) * 1e-9
    assert len(inside_s) == found["motion-without-power"].numbers["segments_count"]
    assert begin_s - 2.0 < inside_s.min() < inside_s.max() < end_s
    (remedy,) = found["motion-without-power"].remedies
    assert remedy.recipe["mask.windows"] == [{"run": "run", "start": np.floor(begin_s), "end": np.ceil(end_s)}]
    assert not find_codes(label(drive, lambda amp, _: np.maximum(amp, amp[:40].mean())))


def test_a_right_sensor_gives_no_finding_and_only_its_prior(drive):
    labelled = label(drive)
    assert not find_codes(labelled)
    sensor = labelled.info.report.facts.label.power_sensor
    assert (sensor.gain_std_fraction, sensor.offset_std_amp, sensor.lost_signs) == (0.02, 0.2, 0)


def test_labels_of_many_sensors_are_as_wrong_as_they_say(drive):
    """Gain and zero of each run are quantiles of their priors: pooled over runs, σ is right."""
    rng, quantiles = np.random.default_rng(5), norm.ppf((np.arange(20) + 0.5) / 20)
    drawn = [partial(lambda amp, _, gain, zero: amp * (1.0 + gain) + zero, gain=gain, zero=zero)
             for gain, zero in zip(0.02 * rng.permutation(quantiles), 0.2 * rng.permutation(quantiles), strict=True)]  # fmt: skip
    runs = [label(drive, change) for change in drawn]
    for name in ("power_watt", "energy_joule"):
        off = np.abs(np.concatenate([normalized(drive, run, name) for run in runs]))
        assert 0.55 < np.mean(off < 1.0) < 0.80
        assert 0.90 < np.mean(off < 2.0) < 0.995
    # Over the whole drive the common part alone tells the error of the sum, added up linearly.
    sums = []
    for run in runs:
        true = compute_true_cost(drive[2], to_integers(run.table, "start_ns"))
        error = to_floats(run.table, "energy_joule") - true.energy_joule
        sums.append(error.sum() / to_floats(run.table, "energy_common_std_joule").sum())
    assert 0.7 < np.sqrt(np.mean(np.square(sums))) < 1.3
