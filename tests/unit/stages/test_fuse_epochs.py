"""Every clock epoch decides for itself; units, mounting and scale are those of the robot; nothing is laid over time without data."""

import tracemalloc
from dataclasses import replace

import numpy as np
import pyarrow as pa
import pytest
from made_tracks import with_columns
from rough_drive import drive as rough_drive
from rough_drive import measured
from unit.fusion import drive
from unit.fusion.checks.test_clock_offsets import HALF_HOUR, drive_with_clocks
from unit.stages.test_fuse import filled, streams_of

from tcpipe.fusion.measurements import select_measurements
from tcpipe.recipe import FuseConfig
from tcpipe.stages.fuse import fuse_run
from tcpipe.stages.fuse_clocks import correct_clocks, find_clocks, find_offsets
from tcpipe.stages.fuse_inputs import Section, drop_implausible_sensors
from tcpipe.stages.fuse_sections import find_exclusions
from tcpipe.tables.columns import to_floats, to_integers
from tcpipe.tables.findings import select_findings
from tcpipe.tables.levels import COMMAND, Sensor, Streams

SECONDS = 40.0


@pytest.fixture(scope="module")
def streams():
    return streams_of(drive.measure(drive.make_drive(SECONDS), 1))


@pytest.fixture(scope="module")
def sensors():
    return measured(rough_drive(120.0, 3), 3)


def begin_in_1970(streams, messages):
    """Return the streams with a few of the first messages of each sensor once more at the start, stamped from 1970 on."""
    tables = {}
    for role, table in streams.tables.items():
        stamp = to_integers(table, "stamp_ns")[:messages] - drive.ZERO_NS + 1
        tables[role] = pa.concat_tables([with_columns(table.slice(0, messages), stamp_ns=stamp), table])
    return replace(streams, tables=tables)


@pytest.mark.parametrize("without", [(), ("wheel_odometry", "visual_odometry")], ids=["all", "GNSS and IMU"])
def test_a_few_messages_of_1970_need_no_memory_and_change_nothing_after_them(streams, without):
    streams = replace(streams, tables={role: of for role, of in streams.tables.items() if role not in without})
    whole = fuse_run(streams, FuseConfig(), run_id="r")
    tracemalloc.start()
    try:
        track = fuse_run(begin_in_1970(streams, 3), FuseConfig(), run_id="r")
        _, peak_bytes = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak_bytes < 2**30
    assert track.info.report.facts.sensor_checks.excluded == {}
    now = track.table.filter(pa.array(to_integers(track.table, "stamp_ns") >= drive.ZERO_NS))
    assert now.num_rows == whole.table.num_rows
    for name in ("forward_velocity_mps", "yaw_rad", "lon_deg", "x_std_m", "displacement_std_1s_m"):
        np.testing.assert_allclose(to_floats(now, name), to_floats(whole.table, name), atol=1e-6)


PLACE = ("lon_deg", "lat_deg", "alt_m")
DAYS_NS = 3 * 86_400 * 10**9
ROLES = ("gnss", "imu", "wheel_odometry", "visual_odometry", "command")
FIRST = filled(COMMAND, np.zeros(1, np.int64), forward_velocity_mps=np.zeros(1), yaw_rate_radps=np.zeros(1))
STREAMS = Streams(
    {"command": FIRST},
    {role: Sensor(f"/{role}", "x/msg/Y", role, "why", placed_by="recipe") for role in ROLES},
    "husky",
)


def later(measurements, by_ns=DAYS_NS):
    """Return measurements stamped later."""
    moved = {role: replace(each, stamp_ns=each.stamp_ns + by_ns) for role, each in measurements.sensors().items()}
    return measurements.replace_sensors(moved)


def test_each_epoch_takes_out_the_drift_of_a_clock_about_its_own_middle():
    """50 ppm over three days are 13 s."""
    late_s = 0.1 + 50e-6 * (HALF_HOUR - 950.0)
    drifting, steady = drive_with_clocks(gnss=late_s), drive_with_clocks()
    sections = correct_clocks(find_clocks([Section(0, drifting), Section(1, later(drifting))]), STREAMS)
    for section, by_ns in zip(sections, (0, DAYS_NS), strict=True):
        off_s = (section.measurements.gnss.stamp_ns - by_ns - steady.gnss.stamp_ns) * 1e-9
        assert np.abs(off_s).max() < 0.02
    (finding,) = find_offsets(sections, STREAMS)
    assert (finding.code, finding.span_s[1] - finding.span_s[0]) == (
        "clock-drift",
        pytest.approx(3 * 86_400 + 1900, abs=1),
    )


@pytest.mark.parametrize("drift_ppm", [0.0, 50.0])
def test_a_short_epoch_has_the_latency_of_a_long_one_and_not_its_drift(drift_ppm):
    long = drive_with_clocks(gnss=0.2 + 1e-6 * drift_ppm * (HALF_HOUR - 950.0))
    short = select_measurements(long, 900 * 10**9, 905 * 10**9)
    sections = find_clocks([Section(0, later(short)), Section(1, long)])
    offset = sections[0].clocks.offsets["gnss"]
    moved_s = (correct_clocks(sections, STREAMS)[0].measurements.gnss.stamp_ns - later(short).gnss.stamp_ns) * 1e-9
    if drift_ppm:
        assert (offset.is_wrong, offset.std_s > 5.0, np.abs(moved_s).max()) == (False, True, 0.0)
    else:
        assert moved_s == pytest.approx(-0.2, abs=0.02)
        (finding,) = find_offsets(sections, STREAMS)
        assert finding.numbers["offset_s"] == pytest.approx(0.2, abs=0.02)


def drop(*epochs, command=None):
    sections = [Section(k, later(m, k * DAYS_NS), command) for k, m in enumerate(epochs)]
    return drop_implausible_sensors(sections, STREAMS)


def test_a_sensor_that_is_frozen_or_reversed_in_the_shorter_epoch_is_excluded_there_only(sensors):
    short = select_measurements(sensors, sensors.gnss.stamp_ns[0], sensors.gnss.stamp_ns[0] + 60 * 10**9)
    still = np.tile(short.gnss.position_enu_m[:1], (short.gnss.stamp_ns.size, 1))
    frozen = replace(short, gnss=replace(short.gnss, position_enu_m=still))
    long, of_short = drop(sensors, frozen)
    assert (long.excluded, [(each.code, each.subject.name) for each in of_short.excluded.values()]) == (
        {},
        [("frozen", "gnss")],
    )
    assert of_short.datum_deg_m is None
    assert long.measurements.gnss is not None
    backwards = replace(short, visual=replace(short.visual, velocity_mps=-short.visual.velocity_mps))
    long, of_short = drop(sensors, backwards)
    assert (set(long.excluded), set(of_short.excluded)) == (set(), {"visual_odometry"})
    (finding,) = find_exclusions([long, of_short])
    assert finding.code == "drives-backwards"


def test_a_mounting_that_the_long_epoch_shows_holds_in_one_that_shows_nothing(sensors):
    backwards = replace(sensors, visual=replace(sensors.visual, velocity_mps=-sensors.visual.velocity_mps))
    short = select_measurements(backwards, sensors.gnss.stamp_ns[0], sensors.gnss.stamp_ns[0] + 2 * 10**9)
    assert [set(drop(short)[0].excluded), *(set(of.excluded) for of in drop(short, backwards))] == [
        set(),
        {"visual_odometry"},
        {"visual_odometry"},
    ]
    (finding,) = find_exclusions(drop(short, backwards))
    assert finding.code == "drives-backwards"


def test_fixes_that_are_frozen_in_one_epoch_take_no_place_from_the_other(streams):
    tables = {}
    for role, table in streams.tables.items():
        stamp = to_integers(table, "stamp_ns")
        again = with_columns(table, stamp_ns=stamp + DAYS_NS, clock_epoch=np.ones(stamp.size, np.int16))
        if role == "gnss":
            again = with_columns(again, **{name: np.full(stamp.size, to_floats(table, name)[0]) for name in PLACE})
        tables[role] = pa.concat_tables([table, again])
    whole = fuse_run(streams, FuseConfig(), run_id="r")
    track = fuse_run(replace(streams, tables=tables), FuseConfig(), run_id="r")
    assert track.table.equals(whole.table)
    assert track.info.datum == whole.info.datum
    (frozen,) = select_findings(track.info.report.findings, "frozen")
    assert frozen.span_s[0] == pytest.approx(DAYS_NS * 1e-9, abs=1.0)
    (skipped,) = select_findings(track.info.report.findings, "sections-skipped")
    assert skipped.numbers["skipped_s"] == pytest.approx(SECONDS, abs=2.0)
