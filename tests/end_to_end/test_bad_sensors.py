"""Sensors gone wrong, from a log to labels: nothing crashes, what is wrong is named with its cure, and no label is confidently wrong."""

import tomllib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from tcpipe.errors import FusionError, RoleError
from tcpipe.formats.logs.log_file import open_log
from tcpipe.formats.logs.writing import MessageStream, write_mcap
from tcpipe.formats.robot_files import shipped_profiles
from tcpipe.pipeline.run_stages import run_stages
from tcpipe.recipe import Placement, ReadConfig, Recipe
from tcpipe.simulation import Faults, Truth, scenario, simulated_drive, true_cost
from tcpipe.simulation.messages import TOPICS, streams
from tcpipe.simulation.route import Pause, Wander
from tcpipe.stages.read import read_run
from tcpipe.tables.levels import LabelledSegments, Streams

NAMES = TOPICS["ros2"]
Columns = dict[str, np.ndarray]


@dataclass(frozen=True)
class Drive:
    truth: Truth
    messages: tuple[MessageStream, ...]

    def without(self, *sensors: str) -> "Drive":
        return Drive(self.truth, tuple(m for m in self.messages if m.topic not in {NAMES[s] for s in sensors}))

    def changed(self, sensor: str, change: Callable[[Columns], Mapping[str, np.ndarray]]) -> "Drive":
        """Every column of a sensor's messages may be replaced; ``change`` gets copies of all, constants as columns too."""

        def apply(m: MessageStream) -> MessageStream:
            if m.topic != NAMES[sensor]:
                return m
            columns = {name: np.array(values) for name, values in m.columns.items()}
            return replace(m, columns={**columns, **change(columns)})

        return Drive(self.truth, tuple(apply(m) for m in self.messages))


def make(plan=None, *, placements: bool = True) -> Drive:
    demo = scenario("demo")
    spec = demo.drives[0]
    spec = replace(
        spec,
        plan=plan or Wander(60.0, (110.0, 30.0)),
        recorder=replace(spec.recorder, placements=placements),
        faults=replace(Faults.every(), gnss_outage=False, visual_dropouts=False, power_gap=False),
    )
    demo = replace(demo, drives=(spec,))
    truth, readings = simulated_drive(demo, seed=5)
    made = streams(readings, spec.sensors.mounted(spec.faults), spec.recorder, geoid_m=demo.world.site.geoid_m)
    return Drive(truth, tuple(made))


@pytest.fixture(scope="module")
def drive() -> Drive:
    return make()


def read(drive: Drive, out: Path, config: ReadConfig | None = None) -> Streams:
    write_mcap(out / "run.mcap", drive.messages)
    with open_log(out / "run.mcap") as log:
        return read_run(log, config or ReadConfig(), robot=None, known=shipped_profiles())


def run(drive: Drive, out: Path, config: ReadConfig | None = None) -> LabelledSegments:
    return run_stages(read(drive, out, config), Recipe().ingest, run_id="run")[2]


def assert_labels_hold(labelled: LabelledSegments, truth: Truth, *, at_least: int = 30, within: float = 0.03) -> None:
    """Duration and energy are those of the true metre, to what they claim: under five standard deviations, and 3 % over all."""
    table = labelled.table
    assert table.num_rows >= at_least
    if table.num_rows == 0:
        return
    wanted = true_cost(truth, table["start_ns"].to_numpy())
    for name, unit in (("duration", "s"), ("energy", "joule")):
        got, std = (table[column].to_numpy() for column in (f"{name}_{unit}", f"{name}_std_{unit}"))
        off = got - getattr(wanted, f"{name}_{unit}")
        assert np.abs(off).sum() <= within * np.abs(got).sum()
        assert np.mean(np.abs(off) > 5 * std) <= 0.02


def fused(labelled: LabelledSegments) -> set[str]:
    return set(labelled.info.findings.facts.fuse.sensors)


def refused(labelled: LabelledSegments) -> set[str]:
    return set(labelled.info.findings.facts.sensor_checks.refused)


def cure(labelled: LabelledSegments, role: str) -> ReadConfig:
    """Read the recipe line out of the warning, as a person would."""
    (warning,) = [w for w in labelled.info.findings.warnings if w.startswith(f"{role}: ") and "is not fused" in w]
    table, line = warning.rsplit("under [", 1)[1].split("]: ", 1)
    keys = tomllib.loads(f"[{table}]\n{line}")["read"]
    if "placement" in keys:
        keys["placement"] = {
            name: Placement(**{key: tuple(map(float, triple)) for key, triple in place.items()})
            for name, place in keys["placement"].items()
        }
    return ReadConfig(**keys)


def test_the_drive_as_it_is_raises_no_doubt(drive, tmp_path):
    labelled = run(drive, tmp_path)
    assert_labels_hold(labelled, drive.truth)
    assert refused(labelled) == set()
    assert fused(labelled) == {"gnss", "imu", "wheel_odometry", "visual_odometry"}


@pytest.mark.parametrize("units", ["deg", "g", "deg_g"])
def test_an_imu_in_degrees_or_in_g_is_refused_until_it_is_declared(drive, tmp_path, units):
    factors = {
        "angular_velocity": np.degrees(1.0) if "deg" in units else 1.0,
        "linear_acceleration": 1 / 9.80665 if "g" in units.split("_") else 1.0,
    }
    other = drive.changed(
        "imu", lambda c: {n: v * factors[n.split(".")[0]] for n, v in c.items() if n.split(".")[0] in factors}
    )
    labelled = run(other, tmp_path)
    assert refused(labelled) == {"imu"}
    assert_labels_hold(labelled, drive.truth)
    config = cure(labelled, "imu")
    assert config.imu_units == units
    declared = run(other, tmp_path, config)
    assert refused(declared) == set()
    assert "imu" in fused(declared)


def test_an_imu_that_feels_nothing_is_not_used_and_said(drive, tmp_path):
    mute = drive.changed("imu", lambda c: {n: 0.0 * v for n, v in c.items() if n.startswith("linear_acceleration.")})
    labelled = run(mute, tmp_path)
    assert refused(labelled) == {"imu"}
    assert any("its specific force is zero throughout" in line for line in labelled.info.findings.warnings)
    assert_labels_hold(labelled, drive.truth)


def test_degrees_are_seen_without_any_odometry(drive, tmp_path):
    other = drive.without("wheels", "visual").changed(
        "imu", lambda c: {n: v * np.degrees(1.0) for n, v in c.items() if n.startswith("angular_velocity.")}
    )
    labelled = run(other, tmp_path)
    assert refused(labelled) == {"imu"}
    assert cure(labelled, "imu").imu_units == "deg"


def test_an_imu_that_nothing_places_is_refused_and_its_mounting_proposed(tmp_path):
    """The unit is upside down and turned by 90°: the log alone shows both."""
    drive = make(placements=False)
    labelled = run(drive, tmp_path)
    assert refused(labelled) == {"imu"}
    config = cure(labelled, "imu")
    assert (
        np.abs(np.mod(np.subtract(config.placement["imu"].rpy_rad, (np.pi, 0.0, np.pi / 2)) + 1, 2 * np.pi) - 1).max()
        < 1e-3
    )
    placed = run(drive, tmp_path, config)
    assert refused(placed) == set()
    assert "imu" in fused(placed)


FLIPS = {"forward": (-1.0, 1.0), "yaw rate": (1.0, -1.0), "both": (-1.0, -1.0)}


def flipped(drive: Drive, sensor: str, flip: str) -> Drive:
    linear, angular = FLIPS[flip]
    factors = {"twist.twist.linear.x": linear, "twist.twist.angular.z": angular}
    return drive.changed(sensor, lambda c: {name: c[name] * factor for name, factor in factors.items()})


@pytest.mark.parametrize("flip", FLIPS)
@pytest.mark.parametrize(
    "without", [(), ("command",), ("command", "visual")], ids=["", "no command", "no command, no camera"]
)
def test_wheels_with_a_flipped_sign_are_refused_and_their_turn_proposed(drive, tmp_path, flip, without):
    other = flipped(drive.without(*without), "wheels", flip)
    labelled = run(other, tmp_path)
    assert refused(labelled) == {"wheel_odometry"}
    assert_labels_hold(labelled, drive.truth)
    mended = run(other, tmp_path, cure(labelled, "wheel_odometry"))
    assert refused(mended) == set()
    assert "wheel_odometry" in fused(mended)
    assert_labels_hold(mended, drive.truth)


def test_a_camera_that_drives_backwards_is_refused(drive, tmp_path):
    other = drive.changed(
        "visual", lambda c: {f"twist.twist.linear.{axis}": -c[f"twist.twist.linear.{axis}"] for axis in "xy"}
    )
    labelled = run(other, tmp_path)
    assert refused(labelled) == {"visual_odometry"}
    assert_labels_hold(labelled, drive.truth)


def constant(names: str, value: float | None = None) -> Callable[[Columns], Columns]:
    return lambda c: {
        n: np.full_like(v, v[len(v) // 2] if value is None else value) for n, v in c.items() if n.startswith(names)
    }


def astray(columns: Columns) -> Columns:
    """Fixes that wander off by a metre a second, each as sure of itself as before."""
    steps = np.random.default_rng(6).normal(0.0, 0.3 / 111e3, (2, columns["latitude"].size))
    return {n: columns[n] + walk for n, walk in zip(("latitude", "longitude"), steps.cumsum(axis=1), strict=True)}


UNLIKE = {
    "fixes that go astray": ("gnss", astray, "the others contradict it"),
    "fixes that never change": ("gnss", constant(("latitude", "longitude", "altitude")), "same place"),
    "places in radians": ("gnss", lambda c: {n: np.radians(c[n]) for n in ("latitude", "longitude")}, "radians?"),
    "exchanged axes": ("gnss", lambda c: {"latitude": c["longitude"], "longitude": c["latitude"]}, "exchanged?"),
    "wheels that never change": ("wheels", constant("twist.twist"), "on all of its"),
    "wheels in km/h": ("wheels", lambda c: {"twist.twist.linear.x": 3.6 * c["twist.twist.linear.x"]}, "km/h?"),
    "a dead camera": ("visual", constant("twist.twist", 0.0), "is 0 m/s on all"),
    "a dead IMU": ("imu", constant(("angular_velocity.", "linear_acceleration."), 0.0), "never changes"),
}


@pytest.mark.parametrize("what", UNLIKE)
def test_a_sensor_that_is_unlike_the_rest_is_refused(drive, tmp_path, what):
    sensor, change, word = UNLIKE[what]
    other = drive.changed(sensor, change)
    if sensor == "visual":  # its pose too, or the velocities would be taken from that
        other = other.changed(sensor, lambda c: {**constant("twist.twist", 0.0)(c), **constant("pose.pose")(c)})
    labelled = run(other, tmp_path)
    role = {"wheels": "wheel_odometry", "visual": "visual_odometry"}.get(sensor, sensor)
    assert refused(labelled) == {role}
    (why,) = [w for w in labelled.info.findings.warnings if "is not fused" in w]
    assert word in why
    assert "ignore_topics" in why
    assert (labelled.info.datum is None) == (sensor == "gnss")
    assert_labels_hold(labelled, drive.truth, within=0.06 if sensor == "gnss" else 0.03)


def test_two_that_contradict_each_other_are_both_refused(drive, tmp_path):
    """Without camera, IMU and command nothing tells whether fixes or wheels are right: no label is better than a wrong one."""
    alone = drive.without("visual", "imu", "command")
    other = alone.changed("gnss", lambda c: {"latitude": c["longitude"], "longitude": c["latitude"]})
    with pytest.raises(FusionError) as error:
        run(other, tmp_path)
    assert sum("nothing tells which of the two is right" in line for line in error.value.problems) == 2


def scattered(size: int, share: float = 0.05) -> np.ndarray:
    return np.random.default_rng(8).random(size) < share


@pytest.mark.parametrize("what", [(np.nan, np.inf, -np.inf), (1e30,)], ids=["none", "huge"])
@pytest.mark.parametrize("sensor", ["gnss", "imu", "wheels", "visual", "power", "command"])
def test_values_that_are_no_numbers_cost_only_themselves(drive, tmp_path, sensor, what):
    def broken(columns: Columns) -> Columns:
        found = {}
        for name, values in columns.items():
            if np.issubdtype(values.dtype, np.floating) and not name.startswith("header") and "covariance" not in name:
                hit = scattered(len(values), 0.03 if sensor != "power" else 0.003)
                values[hit] = np.resize(what, np.count_nonzero(hit))
                found[name] = values
        return found

    labelled = run(drive.changed(sensor, broken), tmp_path)
    assert_labels_hold(labelled, drive.truth, at_least=15)


@pytest.mark.parametrize("quat", [(0.0, 0.0, 0.0, 0.0), (2.0, 0.0, 0.0, 2.0), (np.nan, 0.0, 0.0, 1.0)])
def test_quaternions_that_are_none_are_set_aside(drive, tmp_path, quat):
    def broken(columns: Columns) -> Columns:
        names = [name for name in columns if "orientation." in name]
        return {
            name: np.where(scattered(len(columns[name]), 0.3), quat["xyzw".index(name[-1])], columns[name])
            for name in names
        }

    other = drive.changed("imu", broken).changed("wheels", broken).changed("visual", broken)
    labelled = run(other, tmp_path)
    assert refused(labelled) == set()
    assert_labels_hold(labelled, drive.truth)


def covariances(kind: str, size: int) -> np.ndarray:
    side = 3 if size == 9 else 6
    matrix = {
        "zero": np.zeros((side, side)),
        "negative": -0.01 * np.eye(side),
        "nan": np.full((side, side), np.nan),
        "infinite": np.full((side, side), np.inf),
        "not positive": 1e-4 * np.eye(side) + 1.0 - np.eye(side),
        "too good": 1e-20 * np.eye(side),
        "too large": 1e30 * np.eye(side),
    }[kind]
    return matrix.ravel()


@pytest.mark.parametrize("kind", ["zero", "negative", "nan", "infinite", "not positive", "too good", "too large"])
def test_covariances_that_cannot_be_are_replaced(drive, tmp_path, kind):
    def broken(columns: Columns) -> Columns:
        found = {}
        for name, values in columns.items():
            if name.endswith("covariance") and values.ndim == 2:
                found[name] = np.broadcast_to(covariances(kind, values.shape[1]), values.shape)
        return found

    other = drive.changed("gnss", broken)
    for sensor in ("wheels", "visual", "imu"):
        other = Drive(
            other.truth,
            tuple(_constant_covariances(m, kind) if m.topic == NAMES[sensor] else m for m in other.messages),
        )
    labelled = run(other, tmp_path)
    if kind == "too large":  # no trust in anything but the IMU: few labels, and they say how bad they are
        assert_labels_hold(labelled, drive.truth, at_least=0, within=0.2)
    else:
        assert_labels_hold(labelled, drive.truth)


def _constant_covariances(m: MessageStream, kind: str) -> MessageStream:
    sizes = {name: len(value) for name, value in m.constants.items() if name.endswith("covariance")}
    return replace(m, constants={**m.constants, **{name: covariances(kind, size) for name, size in sizes.items()}})


def test_fixes_at_zero_zero_are_no_places(drive, tmp_path):
    def somewhere(columns: Columns) -> Columns:
        hit = scattered(len(columns["latitude"]), 0.2)
        return {name: np.where(hit, 0.0, columns[name]) for name in ("latitude", "longitude", "altitude")}

    labelled = run(drive.changed("gnss", somewhere), tmp_path)
    assert_labels_hold(labelled, drive.truth)
    assert any("null_island" in warning for warning in labelled.info.findings.warnings)


def test_a_current_with_an_offset_is_said(drive, tmp_path):
    other = drive.changed("power", lambda c: {n: v + 50.0 for n, v in c.items() if "current" in n})
    (warning,) = [w for w in run(other, tmp_path).info.findings.warnings if w.startswith("power: ")]
    assert "are drawn while standing" in warning
    assert not any("while standing" in w for w in run(drive, tmp_path).info.findings.warnings)


def test_fixes_without_altitude_still_say_where(drive, tmp_path):
    labelled = run(drive.changed("gnss", lambda c: {"altitude": np.full_like(c["altitude"], np.nan)}), tmp_path)
    assert labelled.info.datum is not None
    assert any("have no altitude" in warning for warning in labelled.info.findings.warnings)
    assert_labels_hold(labelled, drive.truth)


def test_a_receiver_that_never_had_a_fix_leaves_a_local_frame(drive, tmp_path):
    nowhere = drive.changed("gnss", lambda c: {n: np.zeros_like(c[n]) for n in ("latitude", "longitude", "altitude")})
    labelled = run(nowhere, tmp_path)
    assert labelled.info.datum is None
    assert labelled.table["start_lon_deg"].null_count == labelled.table.num_rows
    assert any("null_island" in warning for warning in labelled.info.findings.warnings)


@pytest.mark.parametrize("share", [0.1, 1.0])
@pytest.mark.parametrize("sensor", ["gnss", "imu", "wheels", "visual", "power"])
def test_stamps_at_zero_are_taken_from_the_recorder(drive, tmp_path, sensor, share):
    def unset(columns: Columns) -> Columns:
        hit = scattered(len(columns["header.stamp.sec"]), share)
        return {name: np.where(hit, 0, columns[name]) for name in ("header.stamp.sec", "header.stamp.nanosec")}

    labelled = run(drive.changed(sensor, unset), tmp_path)
    assert_labels_hold(labelled, drive.truth)
    if share == 1.0:
        assert any("log time rules" in warning for warning in labelled.info.findings.warnings)


def test_two_robots_in_one_log_are_one_question(drive, tmp_path):
    other = tuple(replace(m, topic=m.topic.replace("/a200_0000/", "/a200_0001/")) for m in drive.messages)
    with pytest.raises(RoleError) as error:
        read(Drive(drive.truth, drive.messages + other), tmp_path)
    question, _, *lines = error.value.problems
    assert "2 robots" in question
    assert "/a200_0000 (gnss" in question
    assert "/a200_0001 (gnss" in question
    config = ReadConfig(**tomllib.loads("\n".join(lines))["read"])
    labelled = run(Drive(drive.truth, drive.messages + other), tmp_path, config)
    assert_labels_hold(labelled, drive.truth)


@pytest.mark.parametrize("without", [(), ("gnss",), ("wheels", "visual"), ("imu", "visual", "command")])
def test_a_log_that_never_moves_has_no_segments_and_says_why(tmp_path, without):
    labelled = run(make((Pause(40.0),)).without(*without), tmp_path)
    assert labelled.table.num_rows == 0
    assert any(warning.startswith("no segments: ") for warning in labelled.info.findings.warnings)
    assert labelled.info.findings.facts.segment.odometer_m < 2.0
