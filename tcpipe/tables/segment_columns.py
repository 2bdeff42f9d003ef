"""Columns that later data models added: how the robot moved over a segment, what it cost above standing, and its geometry."""

from __future__ import annotations

import pyarrow as pa

from tcpipe.tables.columns import Column


def _make_column(name: str, unit: str, doc: str, frame: str = "") -> Column:
    return Column(name, pa.float64(), unit, doc, frame, nullable=True, since="1.3")


_UNSURE = "null without a gyroscope or a smoother"

MOTION_COLUMNS = (
    _make_column("yaw_change_rad", "rad", "change of yaw from start to end, counter-clockwise", "enu"),
    _make_column("yaw_change_std_rad", "rad", f"standard deviation of yaw_change_rad; {_UNSURE}", "enu"),
    _make_column("mean_abs_yaw_rate_radps", "rad/s", "time-mean of the absolute yaw rate", "base_link"),
    _make_column(
        "mean_abs_yaw_rate_std_radps", "rad/s", f"standard deviation of mean_abs_yaw_rate_radps; {_UNSURE}", "base_link"
    ),
    _make_column("curvature_radpm", "rad/m", "yaw_change_rad over arc_length_m, positive to the left", "enu"),
    _make_column("curvature_std_radpm", "rad/m", f"standard deviation of curvature_radpm; {_UNSURE}", "enu"),
    _make_column("roll_rad", "rad", "measured roll in the middle of the segment's time", "enu"),
    _make_column("pitch_rad", "rad", "measured pitch there, positive nose down (REP-103)", "enu"),
    _make_column(
        "slip_fraction",
        "1",
        "1 - mean speed over ground / mean speed of the wheels as they tell it, both along the body; null without wheels",
        "base_link",
    ),
    _make_column(
        "slip_std_fraction",
        "1",
        "standard deviation of slip_fraction from the speed over ground: a wrong wheel radius is not in it, it counts as slip",
        "base_link",
    ),
    _make_column(
        "vibration_mps2",
        "m/s2",
        "root mean square of the specific force between 3 and 20 Hz, three axes together; null where the IMU has gaps or is below 50 Hz",
        "sensor",
    ),
)

NET_COLUMNS = (
    _make_column("voltage_volt", "V", "time-mean of the voltage, over the rails; null without power"),
    _make_column(
        "idle_power_watt", "W", "what the robot draws while it stands, of the run; null where it hardly stood"
    ),
    _make_column(
        "idle_power_std_watt",
        "W",
        "standard deviation of idle_power_watt: how it differs over the run, and how well it is measured",
    ),
    _make_column("net_power_watt", "W", "power_watt less idle_power_watt"),
    _make_column("net_power_std_watt", "W", "standard deviation of it, as a label of the true metre"),
    _make_column("net_energy_joule", "J", "energy_joule less idle_power_watt times duration_s"),
    _make_column("net_energy_std_joule", "J", "standard deviation of it, likewise"),
)

GEOMETRY = "geometry"
"""Tells other tools where a row lies (GeoParquet)."""


def _make_geometry(doc: str, frame: str) -> Column:
    return Column(GEOMETRY, pa.binary(), "", f"{doc}; WKB, longitude first", frame, nullable=True, since="2.1")


LINE_COLUMN = _make_geometry("LineString from start to end; null in a local frame", "gnss_crs")
POINT_COLUMN = _make_geometry("Point in the centre of the patch", "WGS 84")
