"""Streams to track: the stage's own work, on streams made of a simulated drive."""

from dataclasses import replace

import numpy as np
import pyarrow as pa
import pyproj
import pytest
from made_tracks import with_columns
from scipy.spatial.transform import Rotation
from unit.fusion import drive

from tcpipe.errors import FusionError
from tcpipe.geometry.datum import enu_from_geodetic, geodetic_from_enu
from tcpipe.recipe import FuseConfig
from tcpipe.stages.fuse import fuse_run
from tcpipe.stages.fuse_inputs import prepare_sections
from tcpipe.tables.columns import to_floats, to_integers
from tcpipe.tables.findings import Subject, make_finding, select_findings
from tcpipe.tables.levels import COMMAND, GNSS, IMU, POSE, POWER, VISUAL_ODOMETRY, WHEEL_ODOMETRY, Sensor, Streams

SITE = (15.46, 47.06, 450.0)
MOUNTING = Rotation.from_euler("xyz", [np.pi, 0.0, np.pi / 2])
SECONDS = 40.0


def sensor(xyz=(0.0, 0.0, 0.0), quat=(0.0, 0.0, 0.0, 1.0)):
    return Sensor("/topic", "pkg/msg/Type", "frame", "test", xyz, quat, placed_by="recipe")


def filled(schema, stamp, **known):
    """Make a table of a role: the given columns, the rest null or zero."""
    columns = {"stamp_ns": stamp, "log_time_ns": stamp, "clock_epoch": np.zeros(stamp.size, np.int16)} | known
    for column in schema.columns:
        columns.setdefault(
            column.name, np.full(stamp.size, np.nan) if column.nullable else np.zeros(stamp.size, np.int8)
        )
    return schema.table(**columns)


def streams_of(measurements):
    """Write measurements back as the streams they came from: geodetic fixes, an IMU mounted upside down."""
    tables, sensors = {}, {}
    if measurements.gnss is not None:
        lon, lat, alt = geodetic_from_enu(measurements.gnss.position_enu_m, datum_deg_m=SITE)
        variance = dict(zip(("east_var_m2", "north_var_m2", "up_var_m2"), measurements.gnss.variance_m2.T, strict=True))
        tables["gnss"] = filled(GNSS, measurements.gnss.stamp_ns, lon_deg=lon, lat_deg=lat, alt_m=alt, **variance)
        sensors["gnss"] = sensor(measurements.gnss.lever_arm_m)
    if measurements.imu is not None:
        rate = MOUNTING.inv().apply(measurements.imu.angular_velocity_radps)
        force = MOUNTING.inv().apply(measurements.imu.specific_force_mps2)
        columns = {f"angular_velocity_{a}_radps": rate[:, k] for k, a in enumerate("xyz")}
        columns |= {f"linear_acceleration_{a}_mps2": force[:, k] for k, a in enumerate("xyz")}
        tables["imu"] = filled(IMU, measurements.imu.stamp_ns, **columns)
        sensors["imu"] = sensor(quat=tuple(MOUNTING.as_quat()))
    for role, schema, source in (
        ("wheel_odometry", WHEEL_ODOMETRY, measurements.wheels),
        ("visual_odometry", VISUAL_ODOMETRY, measurements.visual),
    ):
        if source is not None:
            velocity = np.nan_to_num(source.velocity_mps)
            columns = {f"velocity_{a}_mps": velocity[:, k] for k, a in enumerate("xyz")}
            columns |= {f"velocity_var_{a}_m2ps2": np.full(len(velocity), 0.03**2) for a in "xyz"}
            columns |= {f"angular_velocity_{a}_radps": np.full(len(velocity), np.nan) for a in "xyz"}
            tables[role] = filled(schema, source.stamp_ns, **columns)
            sensors[role] = sensor(tuple(map(float, source.lever_arm_m)))
    return Streams(tables, sensors, "husky")


@pytest.fixture(scope="module")
def truth():
    return drive.make_drive(SECONDS)


@pytest.fixture(scope="module")
def streams(truth):
    whole = streams_of(drive.measure(truth, 1))
    stamp = drive.ns(np.arange(0.0, SECONDS, 0.05))
    t = (stamp - drive.ZERO_NS) * 1e-9
    power = filled(
        POWER, stamp, rail=pa.array(["all"] * stamp.size), voltage_volt=24.0 + 0.01 * t, current_amp=5.0 + 0.1 * t
    )
    command_ns = drive.ns([5.0, 10.0])
    command = filled(
        COMMAND, command_ns, forward_velocity_mps=np.array([1.0, 0.5]), yaw_rate_radps=np.array([0.0, 0.2])
    )
    tables = {**whole.tables, "power": power, "command": command}
    return replace(whole, tables=tables, sensors={**whole.sensors, "power": sensor(), "command": sensor()})


@pytest.fixture(scope="module")
def track(streams):
    return fuse_run(streams, FuseConfig(), run_id="run-1")


def truth_at(truth, table):
    t = (to_integers(table, "stamp_ns") - drive.ZERO_NS) * 1e-9
    return t, truth.at(truth.position, t), truth.slerp(t)


def test_the_track_is_the_drive(track, truth):
    table = track.table
    t, position, rotation = truth_at(truth, table)
    assert t.size >= SECONDS * 20 - 3
    lon, lat, alt = geodetic_from_enu(position, datum_deg_m=SITE)
    assert np.abs(np.radians(to_floats(table, "lat_deg") - lat) * 6.37e6).max() < 0.05
    assert np.abs(np.radians(to_floats(table, "lon_deg") - lon) * 6.37e6 * np.cos(np.radians(47))).max() < 0.05
    assert np.abs(to_floats(table, "alt_m") - alt).max() < 0.08  # the height of a stated antenna is known to 10 cm
    roll_pitch_yaw = rotation.as_euler("xyz")
    for k, name in enumerate(("roll_rad", "pitch_rad", "yaw_rad")):
        difference = np.angle(np.exp(1j * (to_floats(table, name) - roll_pitch_yaw[:, k])))
        assert np.sqrt(np.mean(difference**2)) < 0.0175  # the mounting of an IMU is stated to a degree
    assert np.abs(to_floats(table, "forward_velocity_mps") - np.interp(t, truth.t, truth.forward)).max() < 0.03
    speed = np.stack([to_floats(table, f"{name}_velocity_mps") for name in ("east", "north", "up")], -1)
    assert np.abs(speed - truth.at(truth.velocity, t)).max() < 0.04


def test_enu_and_geodetic_columns_agree_by_proj(track):
    datum = track.info.datum
    pipeline = pyproj.Transformer.from_pipeline(
        "+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad +step +proj=cart +ellps=WGS84 "
        f"+step +proj=topocentric +ellps=WGS84 +lon_0={datum.lon_deg} +lat_0={datum.lat_deg} +h_0={datum.alt_m}"
    )
    enu = pipeline.transform(*(to_floats(track.table, name) for name in ("lon_deg", "lat_deg", "alt_m")))
    for axis, values in zip("xyz", enu, strict=True):
        assert to_floats(track.table, f"{axis}_m") == pytest.approx(values, abs=1e-7)


def test_power_command_and_wheels_stand_at_the_tracks_stamps(track, truth):
    t, _, _ = truth_at(truth, track.table)
    inside = t <= SECONDS - 0.05
    volt, amp = 24.0 + 0.01 * t, 5.0 + 0.1 * t
    assert to_floats(track.table, "voltage_volt")[inside] == pytest.approx(volt[inside], abs=1e-9)
    assert to_floats(track.table, "power_watt")[inside] == pytest.approx((volt * amp)[inside], abs=1e-6)
    command = to_floats(track.table, "commanded_velocity_mps")
    assert np.isnan(command[t < 5.0]).all()
    assert (command[(t >= 5.0) & (t < 10.0)] == 1.0).all()
    yaw_rate = to_floats(track.table, "commanded_yaw_rate_radps")
    assert (yaw_rate[(t >= 10.0) & (t < 24.9)] == 0.2).all()
    assert np.isnan(yaw_rate[t > 25.1]).all()  # older than three periods of 5 s
    wheel = to_floats(track.table, "wheel_velocity_mps") - np.interp(t, truth.t, truth.forward)
    assert np.median(np.abs(wheel)) < 0.06


def test_findings_and_rejections(track):
    facts = track.info.report.facts.fuse
    assert facts.sensors == ("gnss", "imu", "visual_odometry", "wheel_odometry")
    assert facts.rows == track.table.num_rows
    assert facts.sections[0].heading_from == "course over ground"
    assert sum(facts.rejected.values()) == track.rejections.num_rows > 0
    assert set(track.rejections["reason"].to_pylist()) == {"gate"}
    assert track.info.estimator == "smoother"


@pytest.mark.parametrize(("jittery", "severity"), [(0.2, "note"), (1.0, "warning")])
def test_jitter_of_most_stamps_is_a_warning_as_it_doubts_most_places(streams, jittery, severity):
    fixes = streams.tables["gnss"]
    late_s = np.random.default_rng(1).exponential(0.3, fixes.num_rows)
    late_s[round(jittery * fixes.num_rows) :] = 0.0
    stamp_ns = np.sort(to_integers(fixes, "stamp_ns") + np.rint(1e9 * late_s).astype(np.int64))
    late = replace(streams, tables={**streams.tables, "gnss": with_columns(fixes, stamp_ns=stamp_ns)})
    (finding,) = select_findings(prepare_sections(late, FuseConfig())[0].findings, "stamp-jitter")
    assert finding.severity == severity


def without(streams, *roles):
    return replace(streams, tables={role: table for role, table in streams.tables.items() if role not in roles})


def test_without_gnss_the_frame_is_local(streams):
    track = fuse_run(without(streams, "gnss"), FuseConfig(), run_id="r")
    assert track.info.datum is None
    assert track.table["lon_deg"].null_count == track.table.num_rows
    assert abs(to_floats(track.table, "x_m")[0]) < 0.01


def test_without_power_and_commands_their_columns_are_null(streams):
    track = fuse_run(without(streams, "power", "command"), FuseConfig(), run_id="r")
    for name in ("voltage_volt", "current_amp", "power_watt", "commanded_velocity_mps", "commanded_yaw_rate_radps"):
        assert track.table[name].null_count == track.table.num_rows


def test_nothing_but_an_imu_is_no_motion(streams):
    only = without(streams, "gnss", "wheel_odometry", "visual_odometry")
    with pytest.raises(FusionError) as error:
        fuse_run(only, FuseConfig(), run_id="r")
    (finding,) = error.value.findings
    assert (finding.code, finding.subject) == ("no-motion", Subject("run", "r"))
    assert finding.numbers["imu_row_count"] == streams.tables["imu"].num_rows


def test_fixes_at_null_island_are_listed_as_invalid(streams):
    table = streams.tables["gnss"]
    lon, lat = to_floats(table, "lon_deg").copy(), to_floats(table, "lat_deg").copy()
    lon[:3] = lat[:3] = 0.0
    broken = with_columns(table, lon_deg=lon, lat_deg=lat)
    track = fuse_run(replace(streams, tables={**streams.tables, "gnss": broken}), FuseConfig(), run_id="r")
    assert track.rejections["reason"].to_pylist()[:3] == ["invalid"] * 3
    assert track.rejections["normalized_innovation_squared"].null_count == 3
    assert make_finding("values-unusable", Subject("role", "gnss"), row_count=3) in track.info.report.findings
    assert abs(track.info.datum.lon_deg - SITE[0]) < 0.01


def test_a_clock_step_makes_two_epochs_fused_apart(streams, truth):
    """The clock jumps back by 30 s half-way: stamps of the second clock_epoch overlap those of the first."""
    half = drive.ns(SECONDS / 2)
    tables = {}
    for role, table in streams.tables.items():
        stamp = to_integers(table, "stamp_ns")
        clock_epoch = (stamp >= half).astype(np.int16)
        shifted = stamp - clock_epoch.astype(np.int64) * 30_000_000_000
        tables[role] = with_columns(table, stamp_ns=shifted, clock_epoch=clock_epoch)
    table = fuse_run(replace(streams, tables=tables), FuseConfig(), run_id="r").table
    clock_epoch, stamp = to_integers(table, "clock_epoch"), to_integers(table, "stamp_ns")
    assert (np.diff(clock_epoch) >= 0).all()
    assert set(clock_epoch.tolist()) == {0, 1}
    t = (stamp + clock_epoch * 30_000_000_000 - drive.ZERO_NS) * 1e-9
    assert np.abs(to_floats(table, "forward_velocity_mps") - np.interp(t, truth.t, truth.forward)).max() < 0.05
    for k in (0, 1):
        assert (np.diff(stamp[clock_epoch == k]) == 50_000_000).all()


def test_a_gap_of_all_motion_is_a_step_in_the_stamps(streams):
    tables = {}
    for role, table in streams.tables.items():
        t = (to_integers(table, "stamp_ns") - drive.ZERO_NS) * 1e-9
        tables[role] = table.filter(pa.array((t < 20.0) | (t > 23.0))) if role != "imu" else table
    table = fuse_run(replace(streams, tables=tables), FuseConfig(), run_id="r").table
    step = np.diff(to_integers(table, "stamp_ns"))
    assert np.sum(step > 50_000_000) == 1
    assert step.max() == pytest.approx(3.05e9, abs=0.11e9)


def test_the_paper_estimator_and_another_rate_by_the_recipe(streams, truth):
    begun = {role: to_integers(table, "stamp_ns") < drive.ZERO_NS + 14e9 for role, table in streams.tables.items()}
    tables = {role: table.filter(pa.array(begun[role])) for role, table in streams.tables.items()}
    track = fuse_run(replace(streams, tables=tables), FuseConfig(estimator="ukf", rate_hz=10.0), run_id="r")
    assert track.info.estimator == "ukf"
    assert (np.diff(to_integers(track.table, "stamp_ns")) == 100_000_000).all()
    t, position, _ = truth_at(truth, track.table)
    _, lat, _ = geodetic_from_enu(position, datum_deg_m=SITE)
    settled = t > 10.0
    assert np.abs(np.radians(to_floats(track.table, "lat_deg") - lat)[settled] * 6.37e6).max() < 0.15


def test_the_same_streams_give_the_same_track(streams, track):
    again = fuse_run(streams, FuseConfig(), run_id="run-1")
    assert again.table.equals(track.table)
    assert again.rejections.equals(track.rejections)
    assert again.info == track.info


def with_pose(streams, columns):
    """The streams with positions made elsewhere in the place of the fixes."""
    fixes = streams.tables["gnss"]
    kept = {name: fixes[name] for name in fixes.column_names if name in POSE.names()}
    tables = {role: table for role, table in streams.tables.items() if role != "gnss"}
    sensors = {role: of for role, of in streams.sensors.items() if role != "gnss"} | {"pose": streams.sensors["gnss"]}
    unknown = dict.fromkeys((of.name for of in POSE.columns if of.nullable), np.full(fixes.num_rows, np.nan))
    return replace(streams, tables=tables | {"pose": POSE.table(**unknown | kept | columns)}, sensors=sensors)


def test_a_pose_in_a_frame_of_its_own_gives_the_same_drive_and_no_place(streams, track):
    fixes = streams.tables["gnss"]
    datum = track.info.datum
    place = [to_floats(fixes, name) for name in ("lon_deg", "lat_deg", "alt_m")]
    enu = enu_from_geodetic(*place, datum_deg_m=(datum.lon_deg, datum.lat_deg, datum.alt_m)) + np.array(
        [50.0, -20.0, 3.0]
    )
    unknown = np.full(fixes.num_rows, np.nan)
    columns = dict(zip(("x_m", "y_m", "z_m"), enu.T, strict=True))
    local = fuse_run(
        with_pose(streams, columns | dict.fromkeys(("lon_deg", "lat_deg", "alt_m"), unknown)), FuseConfig(), run_id="r"
    )
    assert local.info.datum is None
    assert local.table["lon_deg"].null_count == local.table.num_rows == track.table.num_rows
    for name in ("forward_velocity_mps", "yaw_rad", "x_std_m"):
        np.testing.assert_allclose(to_floats(local.table, name), to_floats(track.table, name), atol=1e-3)
    moved = [np.diff(to_floats(table, "x_m")) for table in (local.table, track.table)]
    np.testing.assert_allclose(*moved, atol=1e-3)


def test_a_pose_in_a_crs_is_fused_as_the_fixes_are(streams, track):
    place = {name: streams.tables["gnss"][name] for name in ("lon_deg", "lat_deg", "alt_m")}
    columns = dict(zip(("x_m", "y_m", "z_m"), place.values(), strict=True)) | place
    placed = fuse_run(with_pose(streams, columns), FuseConfig(), run_id="r")
    assert placed.info.datum == track.info.datum
    np.testing.assert_array_equal(to_floats(placed.table, "lon_deg"), to_floats(track.table, "lon_deg"))
