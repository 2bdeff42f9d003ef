"""A robot whose only sensor of motion is a GNSS antenna: no metre is lost for what fixes cannot show."""

from dataclasses import replace

import numpy as np
import pytest
from unit.fusion import drive
from unit.stages.test_fuse import SITE, sensor, streams_of

from tcpipe.geometry.datum import enu_from_geodetic
from tcpipe.recipe import FuseConfig, MaskConfig
from tcpipe.stages.fuse import fuse_run
from tcpipe.stages.mask import mask_track
from tcpipe.tables.bits import DropReason
from tcpipe.tables.columns import to_floats, to_integers
from tcpipe.tables.findings import StageReport, Subject, make_finding

SECONDS, REVERSE_S = 60.0, 8.0


@pytest.fixture(scope="module")
def truth():
    """Return a drive that begins in reverse, stops and goes forward."""
    return drive.make_drive(SECONDS, reverse_s=REVERSE_S)


def record(truth, *, imu_hz=200.0, **sensors):
    """Return the streams of a drive with fixes of an antenna that nothing places, and with the sensors asked for."""
    carried = {"wheels": False, "visual": False, "imu": False} | sensors
    streams = streams_of(drive.measure(truth, 1, imu_hz=imu_hz, **carried))
    sensors = dict(streams.sensors)
    unplaced = [role for role in ("gnss", "imu") if role in sensors]
    sensors["gnss"] = replace(sensor(), placed_by="assumed")
    findings = tuple(
        make_finding("sensor-not-placed", Subject("role", role), names={"frame": role, "topic": "/topic"})
        for role in unplaced
    )
    report = StageReport(findings, streams.report.facts)
    return replace(streams, sensors=sensors, report=report)


def fuse(streams):
    return fuse_run(streams, FuseConfig(), run_id="run")


def codes_of(track, severity):
    return [(each.code, each.subject.name) for each in track.info.report.findings if each.severity == severity]


def seconds(table):
    return (to_integers(table, "stamp_ns") - drive.ZERO_NS) * 1e-9


def reversing_of(track, truth):
    """Return of the rows that truly move which are dropped as reversing, and which truly go backward."""
    masked = mask_track(track, MaskConfig(), max_velocity_mps=None, chord_m=1.0)
    forward = np.interp(seconds(masked.table), truth.t, truth.forward)
    dropped = (to_integers(masked.table, "dropped_by") & DropReason.REVERSING) != 0
    return dropped[np.abs(forward) > 0.3], forward[np.abs(forward) > 0.3] < 0.0


@pytest.fixture(scope="module")
def alone(truth):
    return fuse(record(truth))


@pytest.fixture(scope="module")
def once_a_second(truth):
    return fuse(record(truth, gnss_hz=1.0, gnss_outliers=0.0))


@pytest.mark.parametrize("track", ["alone", "once_a_second"])
def test_an_antenna_alone_defines_the_track_and_its_errors_are_as_claimed(track, truth, request):
    track = request.getfixturevalue(track)
    table, datum = track.table, track.info.datum
    t = seconds(table)
    antenna = truth.at(truth.position, t) + truth.slerp(t).apply(drive.LEVER)
    geodetic = [to_floats(table, name) for name in ("lon_deg", "lat_deg", "alt_m")]
    assert (datum.lon_deg, datum.lat_deg) == pytest.approx(SITE[:2], abs=0.01)
    off = enu_from_geodetic(*geodetic, datum_deg_m=SITE) - antenna
    std = np.column_stack([to_floats(table, f"{axis}_std_m") for axis in "xy"])
    assert np.median(std) < 0.03
    assert np.mean(np.abs(off[:, :2]) < 2.0 * std) > 0.9


def test_an_antenna_alone_does_not_show_reversing_which_is_a_note(alone, truth):
    dropped, backward = reversing_of(alone, truth)
    assert backward.sum() > 100
    assert dropped.sum() < 10  # at the stop between backward and forward
    moving = np.abs(np.interp(seconds(alone.table), truth.t, truth.forward)) > 0.3
    velocity = np.column_stack([to_floats(alone.table, f"{axis}_velocity_mps") for axis in ("east", "north")])
    yaw = to_floats(alone.table, "yaw_rad")
    ahead = np.sum(velocity * np.column_stack((np.cos(yaw), np.sin(yaw))), axis=1)
    assert np.mean(ahead[moving] > 0.2) > 0.98
    notes = codes_of(alone, "note")
    assert notes.count(("direction-assumed", "gnss")) == notes.count(("track-of-antenna", "gnss")) == 1
    assert "sensor-not-placed" not in {code for code, _ in codes_of(alone, "warning")}


def test_an_imu_too_slow_to_bridge_fixes_leaves_an_antenna_alone(truth):
    found = fuse(record(truth, imu=True, imu_hz=1.0)).info.report.findings
    codes = [each.code for each in found]
    assert codes.count("imu-too-slow") == codes.count("track-of-antenna") == codes.count("direction-assumed") == 1
    assert "sensor-not-placed" not in codes


@pytest.mark.parametrize("sensors", [{"wheels": True}, {"imu": True, "wheels": True}], ids=["wheels", "IMU, wheels"])
def test_another_sensor_keeps_the_doubt_about_the_antenna_and_shows_reversing(truth, sensors):
    track = fuse(record(truth, **sensors))
    dropped, backward = reversing_of(track, truth)
    assert np.mean(dropped == backward) > 0.97
    if "imu" in sensors:
        assert track.info.report.facts.fuse.longest.parameters["antenna"].prior_std == (0.5, 0.5, 0.5)
    else:
        assert np.median(to_floats(track.table, "z_std_m")) > 0.4
    assert ("sensor-not-placed", "gnss") in codes_of(track, "warning")
    assert not {"direction-assumed", "track-of-antenna"} & {code for code, _ in codes_of(track, "note")}
