"""Segments of drives written down by formula, and where every metre went."""

import numpy as np
import pyproj
import pytest
from made_tracks import GRAZ, straight_track

from tcpipe.recipe import MaskConfig, SegmentConfig
from tcpipe.stages.mask import mask_track
from tcpipe.stages.segment import segment_track
from tcpipe.tables.columns import to_floats, to_integers
from tcpipe.tables.findings import select_findings

T = np.arange(0, 60, 0.05)


def cut(track, *, mask=None, limit_mps=1.0):
    masked = mask_track(track, mask or MaskConfig(), max_velocity_mps=limit_mps, chord_m=1.0)
    return segment_track(masked, SegmentConfig())


def chord_error_m(table):
    step = [to_floats(table, f"end_{axis}_m") - to_floats(table, f"start_{axis}_m") for axis in "xy"]
    return np.abs(np.hypot(*step) - 1.0)


def test_a_hill_is_cut_by_its_horizontal_chord():
    slope, course = np.radians(22.5), np.radians(120)
    segments = cut(straight_track(np.full(len(T), 0.9), course_rad=course, slope_rad=slope))
    table = segments.table
    horizontal = 0.9 * np.cos(slope)
    assert table.num_rows == int(horizontal * T[-1])
    assert chord_error_m(table).max() < 1e-6
    assert to_floats(table, "chord_m") == pytest.approx(1.0, abs=1e-6)
    assert to_floats(table, "arc_length_m") == pytest.approx(1.0, abs=1e-6)
    assert to_floats(table, "course_rad") == pytest.approx(course, abs=1e-9)
    duration = (to_integers(table, "end_ns") - to_integers(table, "start_ns")) * 1e-9
    assert duration == pytest.approx(1 / horizontal, abs=1e-8)
    assert to_floats(table, "fused_velocity_mps") == pytest.approx(0.9)
    rise = to_floats(table, "end_z_m") - to_floats(table, "start_z_m")
    assert rise == pytest.approx(np.tan(slope), abs=1e-6)


def test_longitude_and_latitude_are_those_of_the_enu_position():
    datum = GRAZ
    table = cut(straight_track(np.full(len(T), 0.9), course_rad=0.4, slope_rad=0.1, datum=datum)).table
    chain = (
        f"+proj=pipeline +step +inv +proj=topocentric +ellps=WGS84 +lon_0={datum.lon_deg} +lat_0={datum.lat_deg} "
        f"+h_0={datum.alt_m} +step +inv +proj=cart +ellps=WGS84"
    )
    to_geodetic = pyproj.Transformer.from_pipeline(chain)
    geod = pyproj.Geod(ellps="WGS84")
    for end in ("start", "end"):
        lon, lat, _ = to_geodetic.transform(*(to_floats(table, f"{end}_{axis}_m") for axis in "xyz"))
        got = to_floats(table, f"{end}_lon_deg"), to_floats(table, f"{end}_lat_deg")
        _, _, apart = geod.inv(lon, lat, *got)
        assert np.max(apart) < 1e-6


def test_kept_backward_sections_never_share_a_segment_with_forward_ones():
    speed = np.where(T < 30, 0.8, -0.8)
    track = straight_track(speed, forward_mps=speed)
    segments = cut(track, mask=MaskConfig(keep_reversing=True, max_acceleration_mps2=50.0, ramp_acceleration_mps2=50.0))
    fused = to_floats(segments.table, "fused_velocity_mps")
    assert set(np.round(fused, 9)) == {0.8, -0.8}


def test_mean_command_of_a_segment():
    commanded = np.where(T < 30, 1.0, np.nan)
    table = cut(straight_track(np.full(len(T), 0.9), commanded_mps=commanded)).table
    mean = to_floats(table, "commanded_velocity_mps")
    assert np.nanmax(np.abs(mean - 1)) < 1e-9
    assert np.isnan(mean[to_integers(table, "end_ns") > to_integers(table, "start_ns")[0] + 31_000_000_000]).all()


def test_a_run_that_never_moves_says_so():
    segments = cut(straight_track(np.zeros(len(T))))
    assert segments.table.num_rows == 0
    (finding,) = select_findings(segments.info.report.findings, "robot-did-not-move")
    assert finding.numbers == {"driven_m": 0.0}


def test_a_run_without_segments_says_why_and_what_it_lost():
    segments = cut(straight_track(np.full(len(T), -0.8), forward_mps=np.full(len(T), -0.8)))
    (why,) = select_findings(segments.info.report.findings, "no-segments")
    assert why.names == {"reason": "reversing"}
    (lost,) = select_findings(segments.info.report.findings, "lost-reversing")
    assert lost.numbers["lost_fraction"] == pytest.approx(why.numbers["lost_m"] / why.numbers["driven_m"])
