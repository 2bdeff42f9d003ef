"""Sensors gone wrong, from a log to labels: nothing crashes, what is wrong is named with its cure, and no label is confidently wrong."""

from collections.abc import Callable
from dataclasses import replace
from functools import reduce
from pathlib import Path

import numpy as np
import pytest
from changed_drives import NAMES, Columns, Drive, make
from suggested_recipes import merged, proposed, recipe_that_follows

from tcpipe.errors import FusionError, RoleError
from tcpipe.formats.logs.log_file import open_log
from tcpipe.formats.logs.writing import MessageStream, write_mcap
from tcpipe.formats.recipe_toml import load_shipped_profiles, parse_recipe
from tcpipe.pipeline.ingest_run import run_stages
from tcpipe.recipe import FuseConfig, ReadConfig, Recipe
from tcpipe.simulation import Truth, compute_true_cost
from tcpipe.simulation.route import Pause, Wander
from tcpipe.stages.read import read_run
from tcpipe.tables.findings import Finding, select_findings
from tcpipe.tables.levels import LabelledSegments, Streams


@pytest.fixture(scope="module")
def drive() -> Drive:
    return make(Wander(30.0, (110.0, 30.0)))


def read(drive: Drive, out: Path, config: ReadConfig | None = None) -> Streams:
    write_mcap(out / "run.mcap", drive.messages)
    with open_log(out / "run.mcap") as log:
        return read_run(log, config or ReadConfig(), robot=None, known=load_shipped_profiles())


def run(
    drive: Drive,
    out: Path,
    config: ReadConfig | None = None,
    *,
    recipe: Recipe = Recipe(),  # noqa: B008
) -> LabelledSegments:
    return run_stages(read(drive, out, config), recipe.ingest, run_id="run")[2]


def heard(drive: Drive, sensor: str, when: Callable[[np.ndarray], np.ndarray]) -> Drive:
    """Keep the messages of a sensor at some times since its first [s]."""

    def kept(m: MessageStream) -> MessageStream:
        if m.topic != NAMES[sensor]:
            return m
        rows = when((m.log_time_ns - m.log_time_ns[0]) * 1e-9)
        columns = {name: np.asarray(values)[rows] for name, values in m.columns.items()}
        published = None if m.publish_time_ns is None else m.publish_time_ns[rows]
        return replace(m, log_time_ns=m.log_time_ns[rows], columns=columns, publish_time_ns=published)

    return Drive(drive.truth, tuple(kept(m) for m in drive.messages))


def every(period_s: float) -> Callable[[np.ndarray], np.ndarray]:
    return lambda at_s: np.diff(np.floor(at_s / period_s), prepend=-1.0) > 0


def assert_labels_hold(labelled: LabelledSegments, truth: Truth, *, at_least: int = 22, within: float = 0.03) -> None:
    """Duration and energy are those of the true metre, to what they claim: under five standard deviations, and 3 % over all."""
    table = labelled.table
    assert table.num_rows >= at_least
    if table.num_rows == 0:
        return
    wanted = compute_true_cost(truth, table["start_ns"].to_numpy())
    for name, unit in (("duration", "s"), ("energy", "joule")):
        got, std = (table[column].to_numpy() for column in (f"{name}_{unit}", f"{name}_std_{unit}"))
        off = got - getattr(wanted, f"{name}_{unit}")
        assert np.abs(off).sum() <= within * np.abs(got).sum()
        assert np.mean(np.abs(off) > 5 * std) <= 0.02


def fused(labelled: LabelledSegments) -> set[str]:
    return set(labelled.info.report.facts.fuse.sensors)


def refused(labelled: LabelledSegments) -> set[str]:
    return set(labelled.info.report.facts.sensor_checks.excluded)


def cure(labelled: LabelledSegments, role: str) -> ReadConfig:
    """Follow the remedy of the finding on an excluded sensor, as a person would."""
    return recipe_that_follows(exclusion(labelled, role)).read


def exclusion(labelled: LabelledSegments, role: str) -> Finding:
    code = labelled.info.report.facts.sensor_checks.excluded[role]
    (finding,) = [of for of in select_findings(labelled.info.report.findings, code) if of.subject.name == role]
    assert finding.action == "excluded"
    return finding


def test_the_drive_as_it_is_raises_no_doubt(drive, tmp_path):
    labelled = run(drive, tmp_path)
    assert_labels_hold(labelled, drive.truth)
    assert refused(labelled) == set()
    assert fused(labelled) == {"gnss", "imu", "wheel_odometry", "visual_odometry"}
    assert not select_findings(labelled.info.report.findings, "idle-power-high")


def test_an_imu_in_degrees_and_in_g_is_refused_until_it_is_declared(drive, tmp_path):
    factors = {"angular_velocity": np.degrees(1.0), "linear_acceleration": 1 / 9.80665}
    other = drive.changed(
        "imu", lambda c: {n: v * factors[n.split(".")[0]] for n, v in c.items() if n.split(".")[0] in factors}
    )
    labelled = run(other, tmp_path)
    assert refused(labelled) == {"imu"}
    assert_labels_hold(labelled, drive.truth)
    config = cure(labelled, "imu")
    assert config.imu_units == "deg_g"
    declared = run(other, tmp_path, config)
    assert refused(declared) == set()
    assert "imu" in fused(declared)


UKF = Recipe(fuse=FuseConfig(estimator="ukf"))
FIXES = ("wheels", "visual", "doppler")


def test_gaps_of_an_imu_are_driven_as_without_it(drive, tmp_path):
    """The last measurement is not held for seconds: the forward filter made 272 m of 63."""
    gaps = ((15.0, 18.0), (25.0, 30.0), (37.0, 47.0))

    def when(at_s):
        return every(0.08)(at_s) & ~np.any([(at_s > first) & (at_s < last) for first, last in gaps], axis=0)

    labelled = run(heard(drive.without(*FIXES), "imu", when), tmp_path, recipe=UKF)
    assert "imu" in fused(labelled)
    assert sum(labelled.distance_by_reason_m.values()) == pytest.approx(drive.truth.distance_m[-1], rel=0.06)
    assert_labels_hold(labelled, drive.truth, within=0.04)


def test_an_imu_that_is_silent_while_the_robot_sets_off_leaves_its_heading_known(drive, tmp_path):
    """The first yaw came from a path that turned through the gap as the gyroscope did on both sides of it: labels were 2 to 5 % off."""
    silent = heard(drive.without(*FIXES), "imu", lambda at_s: (at_s < 7.0) | (at_s > 10.0))
    labelled = run(silent, tmp_path)
    assert "imu" in fused(labelled)
    assert not select_findings(labelled.info.report.findings, "gnss-contradicts-odometry")
    assert_labels_hold(labelled, drive.truth, at_least=25, within=0.012)


def test_an_imu_that_nothing_places_is_refused_and_its_mounting_proposed(tmp_path):
    """The unit is upside down and turned by 90°: the log alone shows both."""
    drive = make(Wander(30.0, (110.0, 30.0)), placements=False)
    labelled = run(drive, tmp_path)
    assert refused(labelled) == {"imu"}
    # Without it nothing measures how an antenna sways whose height nobody states: σ holds that.
    table, true = labelled.table, compute_true_cost(drive.truth, labelled.table["start_ns"].to_numpy())
    error, std = table["duration_s"].to_numpy() - true.duration_s, table["duration_std_s"].to_numpy()
    assert np.mean(np.abs(error) < 2.0 * std) >= 0.85
    places = [
        proposed(finding)
        for finding in labelled.info.report.findings
        if finding.code != "sensor-not-placed"  # prints ? for what must be measured
        and any("read.extrinsics" in remedy.recipe for remedy in finding.remedies)
    ]
    values = reduce(merged, places)
    assert values == reduce(merged, reversed(places))  # no two findings propose different values for one key
    config = parse_recipe(values, where="followed").read
    assert config.extrinsics["imu"] == cure(labelled, "imu").extrinsics["imu"]
    assert (
        np.abs(np.mod(np.subtract(config.extrinsics["imu"].rpy_rad, (np.pi, 0.0, np.pi / 2)) + 1, 2 * np.pi) - 1).max()
        < 1e-3
    )
    placed = run(drive, tmp_path, config)
    assert refused(placed) == set()
    assert "imu" in fused(placed)


def test_wheels_with_a_flipped_sign_are_refused_and_their_turn_proposed(drive, tmp_path):
    other = drive.changed("wheels", lambda c: {"twist.twist.linear.x": -c["twist.twist.linear.x"]})
    labelled = run(other, tmp_path)
    assert refused(labelled) == {"wheel_odometry"}
    assert_labels_hold(labelled, drive.truth)
    mended = run(other, tmp_path, cure(labelled, "wheel_odometry"))
    assert refused(mended) == set()
    assert "wheel_odometry" in fused(mended)
    assert_labels_hold(mended, drive.truth)


def astray(columns: Columns) -> Columns:
    """Fixes that wander off by a metre a second, each as sure of itself as before."""
    steps = np.random.default_rng(6).normal(0.0, 0.3 / 111e3, (2, columns["latitude"].size))
    return {n: columns[n] + walk for n, walk in zip(("latitude", "longitude"), steps.cumsum(axis=1), strict=True)}


def test_labels_hold_where_fixes_wander_off(tmp_path):
    drive = make(Wander(45.0, (110.0, 30.0)))
    labelled = run(drive.changed("gnss", astray), tmp_path)
    assert "gnss" in {
        of.subject.name for of in select_findings(labelled.info.report.findings, "gnss-contradicts-odometry")
    }
    assert labelled.info.report.facts.label.quality["sensors_disagree"] == labelled.table.num_rows
    assert_labels_hold(labelled, drive.truth, within=0.08)


def test_fixes_that_never_change_are_refused_until_they_are_not_read(drive, tmp_path):
    place = ("latitude", "longitude", "altitude")
    other = drive.changed("gnss", lambda c: {name: np.full_like(c[name], c[name][0]) for name in place})
    labelled = run(other, tmp_path)
    assert refused(labelled) == {"gnss"}
    assert (exclusion(labelled, "gnss").code, labelled.info.datum) == ("frozen", None)
    assert_labels_hold(labelled, drive.truth, within=0.06)
    without = run(other, tmp_path, cure(labelled, "gnss"))
    assert not refused(without)
    assert "gnss" not in fused(without)


def test_two_that_contradict_each_other_are_both_refused(drive, tmp_path):
    """Without camera, IMU and command, no sensor decides between fixes and wheels: no label is better than a wrong one."""
    alone = drive.without("visual", "imu", "command")
    other = alone.changed("gnss", lambda c: {"latitude": c["longitude"], "longitude": c["latitude"]})
    with pytest.raises(FusionError) as error:
        run(other, tmp_path)
    suspects = {of.subject.name: of.names["suspect"] for of in error.value.findings if "suspect" in of.names}
    assert suspects == {"gnss": "wheel_odometry", "wheel_odometry": "gnss"}


SENSORS = ("gnss", "imu", "wheels", "power", "visual", "command")


def scattered(size: int, share: float = 0.05) -> np.ndarray:
    return np.random.default_rng(8).random(size) < share


def test_values_that_are_no_numbers_cost_only_themselves(drive, tmp_path):
    def broken(columns: Columns) -> Columns:
        found = {}
        for name, values in columns.items():
            if np.issubdtype(values.dtype, np.floating) and not name.startswith("header") and "covariance" not in name:
                hit = scattered(len(values), 0.003 if name.startswith("measured_") else 0.03)
                values[hit] = np.resize((np.nan, np.inf, 1e30, -np.inf), values[hit].shape)
                found[name] = values
        return found

    labelled = run(reduce(lambda drive, sensor: drive.changed(sensor, broken), SENSORS, drive), tmp_path)
    assert refused(labelled) == set()
    assert_labels_hold(labelled, drive.truth, at_least=15)


def covariances(kind: str, size: int) -> np.ndarray:
    side = 3 if size == 9 else 6
    matrix = {
        "nan": np.full((side, side), np.nan),
        "infinite": np.full((side, side), np.inf),
        "not positive": 1e-4 * np.eye(side) + 1.0 - np.eye(side),
        "too good": 1e-20 * np.eye(side),
        "too large": 1e30 * np.eye(side),
    }[kind]
    return matrix.ravel()


ODD = ("nan", "infinite", "not positive", "too good")


@pytest.mark.parametrize("kinds", [ODD, ("too large",) * 4], ids=", ".join)
def test_covariances_that_cannot_be_are_replaced(drive, tmp_path, kinds):
    """The kinds are of GNSS, wheels, camera and IMU."""
    of_gnss, *of_others = kinds

    def broken(columns: Columns) -> Columns:
        found = {}
        for name, values in columns.items():
            if name.endswith("covariance") and values.ndim == 2:
                found[name] = np.broadcast_to(covariances(of_gnss, values.shape[1]), values.shape)
        return found

    other = drive.changed("gnss", broken)
    for sensor, kind in zip(("wheels", "visual", "imu"), of_others, strict=True):
        other = Drive(
            other.truth,
            tuple(_constant_covariances(m, kind) if m.topic == NAMES[sensor] else m for m in other.messages),
        )
    labelled = run(other, tmp_path)
    if of_gnss == "too large":  # no trust in anything but the IMU: few labels, and they say how bad they are
        assert_labels_hold(labelled, drive.truth, at_least=0, within=0.2)
    else:
        assert_labels_hold(labelled, drive.truth)


def _constant_covariances(m: MessageStream, kind: str) -> MessageStream:
    sizes = {name: len(value) for name, value in m.constants.items() if name.endswith("covariance")}
    return replace(m, constants={**m.constants, **{name: covariances(kind, size) for name, size in sizes.items()}})


def test_a_current_with_an_offset_is_said(drive, tmp_path):
    other = drive.changed("power", lambda c: {n: v + 50.0 for n, v in c.items() if "current" in n})
    (finding,) = select_findings(run(other, tmp_path).info.report.findings, "idle-power-high")
    assert finding.numbers["idle_watt"] > 0.5 * finding.numbers["driving_watt"]


@pytest.fixture(scope="module")
def parked() -> Drive:
    return make((Pause(40.0),))


@pytest.mark.parametrize("without", [(), ("wheels", "visual")])
def test_a_log_that_never_moves_has_no_segments_and_says_why(parked, tmp_path, without):
    labelled = run(parked.without(*without), tmp_path)
    assert labelled.table.num_rows == 0
    assert select_findings(labelled.info.report.findings, "robot-did-not-move")
    assert labelled.info.report.facts.segment.odometer_m < 2.0


def test_wheels_that_go_too_short_a_way_and_tell_no_turn_rate_are_excluded_and_their_scale_proposed(drive, tmp_path):
    rng = np.random.default_rng(1)

    def coarse(c: Columns) -> Columns:
        metre_deg = {"latitude": 9e-6, "longitude": 1.3e-5}
        noisy = {name: c[name] + 1.5 * per_m * rng.standard_normal(c[name].shape) for name, per_m in metre_deg.items()}
        return {
            **noisy,
            "position_covariance": np.broadcast_to(np.diag([2.2, 2.2, 9.0]).ravel(), (len(c["latitude"]), 9)),
        }

    names = ("twist.twist.linear.x", "twist.twist.angular.z")
    other = drive.without("imu", "visual", "command").changed("gnss", coarse)
    other = other.changed("wheels", lambda c: {names[0]: 0.43 * c[names[0]], names[1]: 0.0 * c[names[1]]})
    labelled = run(other, tmp_path)
    assert refused(labelled) == {"wheel_odometry"}
    config = cure(labelled, "wheel_odometry")
    assert config.odometry_scale["wheel_odometry"] == pytest.approx(1 / 0.43, rel=0.2)
    cured = run(other, tmp_path, config)
    assert fused(cured) == {"gnss", "wheel_odometry"}
    assert sum(cured.distance_by_reason_m.values()) == pytest.approx(drive.truth.distance_m[-1], rel=0.15)
    assert select_findings(cured.info.report.findings, "rate-from-orientation")


LATE_S = 0.3


def late(columns: Columns) -> Columns:
    stamp_ns = columns["header.stamp.sec"] * 10**9 + columns["header.stamp.nanosec"] + round(LATE_S * 1e9)
    return {"header.stamp.sec": stamp_ns // 10**9, "header.stamp.nanosec": stamp_ns % 10**9}


def with_pose(drive: Drive) -> Drive:
    """The drive without GNSS, with poses of a SLAM of another name: centimetres of noise, of base_link."""
    every = slice(None, None, 20)
    truth, random = drive.truth, np.random.default_rng(4)
    stamp_ns, place = truth.stamp_ns[every], truth.enu_m[every]
    place = place + random.normal(0.0, 0.01, place.shape)
    columns = {f"pose.position.{axis}": place[:, i] for i, axis in enumerate("xyz")}
    columns |= {f"pose.orientation.{part}": truth.quat_xyzw[every, i] for i, part in enumerate("xyzw")}
    stamps = {"header.stamp.sec": stamp_ns // 10**9, "header.stamp.nanosec": stamp_ns % 10**9}
    pose = MessageStream(POSE_TOPIC, "geometry_msgs/msg/PoseStamped", stamp_ns, columns | stamps)
    return Drive(truth, (*drive.without("gnss").messages, pose))


POSE_TOPIC = "/tracker/pose"


def time_offsets(labelled: LabelledSegments) -> list[Finding]:
    return select_findings(labelled.info.report.findings, "time-offset")


def test_a_late_clock_is_corrected_by_the_lines_as_they_are_printed(drive, tmp_path):
    config = {"read": {"topics": {"pose": [POSE_TOPIC]}}}
    messages = tuple(
        replace(m, columns={**m.columns, **late(m.columns)}) if m.topic == POSE_TOPIC else m
        for m in with_pose(drive).messages
    )
    off = Drive(drive.truth, messages)
    (finding,) = time_offsets(run(off, tmp_path, parse_recipe(config, where="test").read))
    ((role, offset_s),) = proposed(finding)["read"]["time_offset_s"].items()
    assert (finding.subject.name, role) == ("pose", "pose")
    assert offset_s == pytest.approx(-LATE_S, abs=0.03)
    assert not time_offsets(run(off, tmp_path, recipe_that_follows(finding, before=config).read))


def test_a_pose_that_nobody_names_is_offered_as_what_it_can_be(drive, tmp_path):
    other = with_pose(drive).without("wheels", "visual")
    with pytest.raises(RoleError) as error:
        read(other, tmp_path)
    (found,) = [of for of in select_findings(error.value.findings, "topic-left-out") if of.remedies]
    assert proposed(found) == {"read": {"topics": {"pose": [POSE_TOPIC]}}}
    assert "pose" in read(other, tmp_path, recipe_that_follows(found).read).tables


def test_an_offset_of_a_role_that_is_not_there_is_an_error_and_a_placement_a_warning(drive, tmp_path):
    topics = {"read": {"topics": {"pose": [POSE_TOPIC]}}}
    other = with_pose(drive)
    with pytest.raises(
        RoleError, match=r"read.time_offset_s.gnss: no topic of this log is used as gnss.*roles in the log: .*pose"
    ):
        read(other, tmp_path, parse_recipe(merged(topics, {"read": {"time_offset_s": {"gnss": -0.3}}}), where="").read)
    placed = {"read": {"extrinsics": {"gnss": {"xyz_m": [0.1, 0.0, 0.5]}}}}
    found = read(other, tmp_path, parse_recipe(merged(topics, placed), where="").read)
    (unused_key,) = select_findings(found.report.findings, "recipe-key-unused")
    assert unused_key.names == {"key": "read.extrinsics.gnss"}
