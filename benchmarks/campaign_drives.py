"""Simulated drives of the campaign in memory, their logs, and the comparison of labels with the truth.

A drive is simulated once for each route and seed; its sensors are sampled again for every cell. No file is written:
`MemoryLog` gives the stage `read` the same tables as a log on disk, and all later stages are those of `tcpipe ingest`.
"""

from __future__ import annotations

import time
import traceback
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Any

import numpy as np
import pyarrow as pa
import pyproj

from tcpipe.errors import TcpipeError
from tcpipe.formats.finding_lines import format_finding
from tcpipe.formats.logs.ros_types import MessageType, TypeLibrary
from tcpipe.formats.logs.writing import MessageStream
from tcpipe.formats.recipe_toml import load_shipped_profiles
from tcpipe.geometry.rotation import rpy_from_quat
from tcpipe.logs.roles import ROLE_TYPES
from tcpipe.logs.topics import Topic
from tcpipe.logs.wire_types import Scalar, iterate_flat_fields
from tcpipe.pipeline.ingest_run import run_stages
from tcpipe.recipe import Recipe
from tcpipe.simulation import Faults, Truth, compute_true_cost, simulate_readings
from tcpipe.simulation.messages import Recorder, make_streams
from tcpipe.simulation.robot import SimulatedRobot
from tcpipe.simulation.route import Leg, Pause, Wander
from tcpipe.simulation.scenarios import DriveSpec, RasterSpec, Scenario, make_small_world
from tcpipe.simulation.sensors import Noise, Reading, Sensors, record
from tcpipe.simulation.world import MUD, PAVED, UNPAVED, Band, Ellipse, Hill, Site, World, draw_waves
from tcpipe.stages.read import read_run
from tcpipe.tables.bits import Quality, flag_name
from tcpipe.tables.columns import to_floats, to_integers, to_numbers
from tcpipe.tables.findings import WITNESSES_OF_LABEL, Finding
from tcpipe.tables.levels import LabelledSegments, Streams, Track

Readings = Mapping[str, Reading]
Messages = Sequence[MessageStream]

QUANTITIES = {"T": "duration_s", "v": "velocity_mps", "w": "power_watt", "E": "energy_joule", "start": "position_m"}
"""Quantities that are compared with the truth, and their columns; the last is the position of the start point."""
RING = float(np.sqrt(-np.log(0.05)))
"""Radius that contains 95 % of the points, divided by DRMS [1], where both axes have the same error."""
_GAP_S = 5.0
TRACK = ("xy_m", "velocity_mps", "yaw_rad", "gap_xy_m", "gap_inside")
FIRST_SEED = 501
HUSKY = Recorder("ros2", "clearpath_power")
WHOLE = replace(Faults.every(), gnss_outage=False, visual_dropouts=False, power_gap=False)
"""Noise, scales, biases, mounts, outliers and delays of every sensor, but no hole in any: what is clean here."""
_STARTS_M = ((14.0, 34.0), (110.0, 30.0), (90.0, 55.0), (30.0, 60.0), (60.0, 30.0), (40.0, 20.0))
_VALLEY_STARTS_M = ((40.0, 60.0), (150.0, 110.0), (90.0, 150.0), (200.0, 60.0), (120.0, 40.0), (60.0, 120.0))
_NO_SENSORS = Sensors(*[None] * 6)


@dataclass(frozen=True)
class Drive:
    """True motion, its place, and the random streams of its sensors."""

    truth: Truth
    site: Site
    noise: Noise
    robot: str | None = "husky"
    """The profile that the log is read with; None: a robot without one."""

    @property
    def first_ns(self) -> int:
        """When the drive began."""
        return int(self.truth.stamp_ns[0])

    def seconds(self, stamp_ns: np.ndarray) -> np.ndarray:
        """Return time since the drive began [s]."""
        return (stamp_ns - self.first_ns) * 1e-9


@dataclass(frozen=True)
class Fault:
    """Fault of a log, as the change that it makes between the robot and the log; a new fault is an instance of this class.

    ``sensors`` changes the true sensors, ``told`` what the log states about them (positions, variances), ``readings``
    their measurements, ``messages`` the recorded messages; ``route`` names the drive, ``true_ns`` converts times of the
    track to true times.
    """

    name: str
    at_fault: tuple[str, ...] = ()
    """The sensors that one who knows would leave out; none where the fault is of the drive or the whole log."""
    window_s: tuple[float, float] | None = None
    """Since the drive began; None: from beginning to end."""
    said: str = ""
    """A regular expression that a finding or error is to hold; nothing has to be said where it is empty."""
    may_refuse: bool = False
    """Whether a run without segments is correct: no sensor can show which other one is wrong, or there is nothing to label."""
    unseen_m: float = 0.0
    """Allowed error of start points that no sensor shows [m]; here 0, since this robot turns exactly about base_link."""
    route: str = "hills"
    calibrated: bool = False
    """Whether nothing is wrong at all: then deviations are to be as large as errors, and bits rare."""
    sensors: Callable[[Sensors], Sensors] = lambda sensors: sensors
    told: Callable[[Sensors], Sensors] = lambda sensors: sensors
    readings: Callable[[Readings, Drive], Readings] = lambda readings, _: readings
    messages: Callable[[Messages, Drive], Messages] = lambda messages, _: messages
    true_ns: Callable[[np.ndarray, Drive], np.ndarray] = lambda stamp_ns, _: stamp_ns

    def __and__(self, other: Fault) -> Fault:
        """Return both faults at once, this one's first."""
        spans = [fault.window_s for fault in (self, other) if fault.window_s is not None]
        both = len(spans) == len((self, other))
        window_s = (min(a for a, _ in spans), max(b for _, b in spans)) if both else None
        return Fault(
            f"{self.name} and {other.name}", (*self.at_fault, *other.at_fault), window_s,
            may_refuse=self.may_refuse or other.may_refuse,
            sensors=lambda sensors: other.sensors(self.sensors(sensors)),
            told=lambda sensors: other.told(self.told(sensors)),
            readings=lambda readings, drive: other.readings(self.readings(readings, drive), drive),
            messages=lambda messages, drive: other.messages(self.messages(messages, drive), drive),
            true_ns=lambda stamp_ns, drive: self.true_ns(other.true_ns(stamp_ns, drive), drive),
        )  # fmt: skip


def _hills(seed: int, length_m: float) -> tuple[World, DriveSpec]:
    start_m = _STARTS_M[seed % len(_STARTS_M)]
    plan = Wander(length_m, start_m, climbing=0.4)
    return make_small_world(), DriveSpec("hills", plan, start_m, sensors=_NO_SENSORS)


def _straight(_: int, length_m: float) -> tuple[World, DriveSpec]:
    world = replace(make_small_world(Site(width_m=900.0)), hills=(), regions=(), holes=())
    plan = (Pause(3.0), Leg(((10.0 + 4.0 * length_m, 40.0),)), Pause(3.0))
    return world, DriveSpec("straight", plan, (10.0, 40.0), sensors=_NO_SENSORS, weave_m=0.0)


def _standing(_: int, __: float) -> tuple[World, DriveSpec]:
    return make_small_world(), DriveSpec("standing", (Pause(60.0),), _STARTS_M[0], sensors=_NO_SENSORS)


def _valley(seed: int, length_m: float) -> tuple[World, DriveSpec]:
    """Another place and a heavier, faster robot than the campaign's and the tests'."""
    world = World(
        site=Site(epsg=32632, west_m=421300.0, south_m=5311700.0, width_m=260.0, height_m=200.0, geoid_m=48.3),
        base_m=311.0,
        hills=(
            Hill(60.0, 90.0, 8.5, 17.0, 14.0), Hill(140.0, 60.0, 7.0, 12.0, 19.0), Hill(200.0, 130.0, 9.5, 20.0, 16.0),
            Hill(110.0, 150.0, -5.0, 18.0, 13.0), Hill(230.0, 50.0, 6.0, 15.0, 15.0),
        ),
        waves=draw_waves(71, count=6, total=0.13, wavelength_m=(8.0, 30.0)),
        regions=(
            Band(UNPAVED, 130.0, 100.0, 0.6, 5.0, 6.0, 90.0, 1.1), Band(PAVED, 130.0, 70.0, -0.2, 6.0, 3.0, 110.0, 0.2),
            Ellipse(MUD, 80.0, 60.0, 11.0, 8.0, 0.7), Ellipse(MUD, 170.0, 120.0, 9.0, 13.0, 1.9),
        ),
        resistance=draw_waves(73, count=8, total=0.05, wavelength_m=(2.0, 15.0)),
    )  # fmt: skip
    robot = SimulatedRobot(
        mass_kg=118.0, max_velocity_mps=1.25, speed_time_constant_s=0.35, max_acceleration_mps2=0.8, max_yaw_rate_radps=0.9,
        slope_slip=0.07, wheelbase_m=0.65, scrub_torque_nm=240.0, idle_watt=21.0, electronics_watt=55.0,
    )  # fmt: skip
    start_m = _VALLEY_STARTS_M[seed % len(_VALLEY_STARTS_M)]
    plan = Wander(length_m, start_m, climbing=0.4)
    return world, DriveSpec("valley", plan, start_m, sensors=_NO_SENSORS, robot=robot)


def _few_turns(count: int) -> Callable[[int, float], tuple[World, DriveSpec]]:
    """Return a drive over the valley whose only turns are some corners."""

    def make(seed: int, length_m: float) -> tuple[World, DriveSpec]:
        world, spec = _valley(seed, length_m)
        corners_m = ((35.0, 30.0), (215.0, 35.0), (205.0, 165.0), (50.0, 160.0))[: count + 2]
        return world, replace(spec, plan=(Pause(4.0), Leg(corners_m[1:]), Pause(3.0)), start_m=corners_m[0])

    return make


def _plain(seed: int, length_m: float) -> tuple[World, DriveSpec]:
    """Return a drive of the same robot where nothing rises."""
    world, spec = _valley(seed, length_m)
    return replace(world, hills=(), waves=()), spec


def _slow(seed: int, length_m: float) -> tuple[World, DriveSpec]:
    """Return a drive over a third of the length with the same robot, at 0.15 m/s."""
    world, spec = _valley(seed, length_m / 3.0)
    return world, replace(spec, robot=replace(spec.robot, max_velocity_mps=0.15, max_yaw_rate_radps=0.3))


ROUTES: Mapping[str, Callable[[int, float], tuple[World, DriveSpec]]] = {
    "hills": _hills, "straight": _straight, "standing": _standing,
    "valley": _valley, "plain": _plain, "slow": _slow, "one turn": _few_turns(1), "two turns": _few_turns(2),
}  # fmt: skip
"""A world and a drive over it by name, from a seed and about how far to drive [m]."""


@cache
def simulated(route: str, seed: int, length_m: float) -> Drive:
    """Return a drive along one of `ROUTES`."""
    world, spec = ROUTES[route](seed, length_m)
    scenario = Scenario("campaign", world, (spec,), ((1.0, 1.0), (80.0, 1.0), (80.0, 79.0)), RasterSpec(2.0, 2.0, 2.0))
    truth, _ = simulate_readings(scenario, seed=seed)
    return Drive(truth, world.site, Noise(seed, 0), "husky" if spec.robot == SimulatedRobot() else None)


@dataclass(frozen=True)
class MemoryLog:
    """A log that was never written: what the stage `read` wants of one."""

    messages: Messages

    @property
    def topics(self) -> Mapping[str, Topic]:
        """Every topic by name."""
        return {m.topic: self._topic(m) for m in self.messages}

    @staticmethod
    def _topic(m: MessageStream) -> Topic:
        ends = (int(m.log_time_ns.min()), int(m.log_time_ns.max())) if m.log_time_ns.size else (None, None)
        return Topic(m.topic, m.type_name, m.log_time_ns.size, *ends, "cdr", "")

    def tables(self, topics: Sequence[str]) -> dict[str, pa.Table]:
        """Return the messages of topics; what a stream does not name is zero, as in a log."""
        return {m.topic: _table(m) for m in self.messages if m.topic in topics}

    def batches(self, topics: Sequence[str]) -> Iterator[Mapping[str, pa.Table]]:
        """Yield the same in one piece."""
        yield self.tables(topics)


def _table(m: MessageStream) -> pa.Table:
    order, count = np.argsort(m.log_time_ns, kind="stable"), m.log_time_ns.size
    publish_ns = m.log_time_ns if m.publish_time_ns is None else m.publish_time_ns
    columns: dict[str, Any] = {"log_time_ns": m.log_time_ns[order], "publish_time_ns": publish_ns[order]}
    for name, value in m.constants.items():
        whole = np.tile(value, (count, 1)) if isinstance(value, np.ndarray) else None
        columns[name] = pa.array([value] * count) if whole is None else _lists(whole)
    for name, values in m.columns.items():
        if values.dtype.kind == "S":
            columns[name] = pa.array(values[order].astype(str).tolist())
        else:
            columns[name] = _lists(values[order]) if values.ndim > 1 else values[order]
    for name in _fields(m.type_name):
        columns.setdefault(name, np.zeros(count))
    return pa.table(columns)


def _lists(values: np.ndarray) -> pa.Array:
    return pa.FixedSizeListArray.from_arrays(np.ascontiguousarray(values, np.float64).ravel(), values.shape[1])


def _fields(type_name: str) -> tuple[str, ...]:
    """Return the numbers of a message that is used as a role, but for power and transforms."""
    if all(type_name not in types for role, types in ROLE_TYPES.items() if role != "power"):
        return ()
    found = TypeLibrary().find_type(type_name, definition="", schema_encoding="", ros1=False)
    assert isinstance(found, MessageType), found
    return tuple(name for name, of in iterate_flat_fields(found.wire) if isinstance(of, Scalar))


def log_of(drive: Drive, sensors: Sensors, fault: Fault) -> MemoryLog:
    """Return what is recorded of a drive where a fault is."""
    real = fault.sensors(sensors).mounted(WHOLE)
    readings = fault.readings(record(drive.truth, drive.site, real, WHOLE, drive.noise), drive)
    messages = make_streams(readings, fault.told(real.stated(WHOLE, drive.noise)), HUSKY)
    recorded = fault.messages(messages, drive)
    return MemoryLog([m for m in recorded if m.constants.get("transforms") != []])


@dataclass(frozen=True)
class Outcome:
    """Result of one log and its errors; arrays have one value for each labelled segment."""

    start_s: list[float]
    """Since the drive began."""
    error: dict[str, list[float]]
    """By quantity, in its unit; NaN where there is no truth or no place."""
    claimed: dict[str, list[float]]
    bits: list[int]
    placed: list[bool]
    """Whether it would be sampled: it has a place on the map, and that is sure enough."""
    driven_m: float
    """By the track."""
    true_m: float
    wheels_m: float
    """Distance by the wheels [m]; NaN without wheels."""
    kept_m: float
    said: list[str]
    """Findings, or why there is no run."""
    common: dict[str, list[float]] = field(default_factory=dict)
    """The part of ``claimed`` that is one error of the whole run."""
    value: dict[str, list[float]] = field(default_factory=dict)
    """The labels themselves, by quantity."""
    blamed: list[str] = field(default_factory=list)
    """Subjects of which a warning says that they were excluded or rejected."""
    track: dict[str, float] = field(default_factory=dict)
    """By `TRACK`: RMS errors of the track's rows; the last of rows in gaps of the fixes, and the share of these inside `RING` DRMS."""
    cpu_s: float = 0.0
    trace: str = ""
    """Place in the code where an unexpected error was raised."""


def outcome_of(drive: Drive, sensors: Sensors, fault: Fault) -> Outcome:
    """Run the stages of ingest over a log, and compare with the truth; no error gets out."""
    return judge_log(drive, log_of(drive, sensors, fault), fault)


def judge_log(drive: Drive, log: MemoryLog, fault: Fault) -> Outcome:
    """Return the same of a log that is there."""
    recipe, begun_s = Recipe(), time.process_time()
    nothing = Outcome(
        [], {name: [] for name in QUANTITIES}, {name: [] for name in QUANTITIES}, [], [],
        0.0, float(drive.truth.distance_m[-1]), float("nan"), 0.0, [],
    )  # fmt: skip
    try:
        read = read_run(log, recipe.read, robot=drive.robot, known=load_shipped_profiles())
        track, _, labelled = run_stages(read, recipe.ingest, run_id="run")
    except TcpipeError as error:
        return replace(nothing, said=[*error.problems, *said_of(error.findings)], cpu_s=time.process_time() - begun_s)
    except Exception as error:  # noqa: BLE001  the campaign is to find them
        return replace(nothing, said=[f"{type(error).__name__}: {error}"], trace=traceback.format_exc())
    spent_s = time.process_time() - begun_s
    compared = _compared(labelled, read, drive, fault, max_std_m=recipe.sample.max_position_std_m)
    return replace(compared, track=_track_errors(track, read, drive, fault), cpu_s=spent_s)


def _track_errors(track: Track, read: Streams, drive: Drive, fault: Fault) -> dict[str, float]:
    table, geod = track.table, pyproj.Geod(ellps="WGS84")
    stamp_ns = to_integers(table, "stamp_ns")
    true_ns = fault.true_ns(stamp_ns, drive)
    at = drive.truth.at(true_ns)
    _, _, apart_m = geod.inv(to_floats(table, "lon_deg"), to_floats(table, "lat_deg"), at.lon_deg, at.lat_deg)
    yaw_rad = np.angle(np.exp(1j * (to_floats(table, "yaw_rad") - rpy_from_quat(at.quat_xyzw)[:, 2])))
    drms_m = np.hypot(to_floats(table, "x_std_m"), to_floats(table, "y_std_m"))
    known = true_ns >= drive.first_ns
    placed = known & np.isfinite(apart_m)
    gap = placed & _in_gap(read, stamp_ns)
    inside = float(np.mean(apart_m[gap] <= RING * drms_m[gap])) if gap.any() else float("nan")
    velocity_mps = (to_floats(table, "forward_velocity_mps") - at.forward_velocity_mps)[known]
    figures = (_rms(apart_m[placed]), _rms(velocity_mps), _rms(yaw_rad[placed]), _rms(apart_m[gap]), inside)
    return dict(zip(TRACK, figures, strict=True))


def _in_gap(read: Streams, stamp_ns: np.ndarray) -> np.ndarray:
    """Return which times lie between two fixes that are more than `_GAP_S` apart."""
    fix_ns = to_integers(read.tables["gnss"], "stamp_ns") if "gnss" in read.tables else np.zeros(0, np.int64)
    wide = np.flatnonzero(np.diff(fix_ns) > _GAP_S * 1e9)
    between = (fix_ns[wide][:, None] < stamp_ns) & (stamp_ns < fix_ns[wide + 1][:, None])
    return np.asarray(between.any(axis=0))


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values)))) if values.size else float("nan")


def said_of(findings: Iterable[Finding]) -> list[str]:
    """Return the findings as lines with their codes."""
    return [format_finding(finding) for finding in dict.fromkeys(findings) if finding.code != WITNESSES_OF_LABEL]


def _compared(labelled: LabelledSegments, read: Streams, drive: Drive, fault: Fault, *, max_std_m: float) -> Outcome:
    table, findings = labelled.table, labelled.info.report.findings
    start_ns = fault.true_ns(to_integers(table, "start_ns"), drive)
    true = compute_true_cost(drive.truth, start_ns)
    value, error, claimed, common = {}, {}, {}, {}
    for name, column in list(QUANTITIES.items())[:-1]:
        quantity, unit = column.rsplit("_", 1)
        value[name] = to_floats(table, column).tolist()
        error[name] = (to_floats(table, column) - getattr(true, column)).tolist()
        claimed[name] = to_floats(table, f"{quantity}_std_{unit}").tolist()
        of_run = f"{quantity}_common_std_{unit}"
        common[name] = (
            np.nan_to_num(to_floats(table, of_run)).tolist() if of_run in table.column_names else [0.0] * table.num_rows
        )
    there = drive.truth.at(start_ns)
    lon, lat = to_floats(table, "start_lon_deg"), to_floats(table, "start_lat_deg")
    std_m = to_floats(table, "position_std_m")
    _, _, apart_m = pyproj.Geod(ellps="WGS84").inv(lon, lat, there.lon_deg, there.lat_deg)
    error["start"] = np.where(np.isfinite(true.duration_s), apart_m, np.nan).tolist()
    claimed["start"] = std_m.tolist()
    placed = np.isfinite(lon) & (std_m <= max_std_m)
    return Outcome(
        start_s=drive.seconds(start_ns).tolist(), error=error, claimed=claimed, common=common, value=value,
        bits=to_numbers(table["quality"]).tolist(), placed=placed.tolist(),
        driven_m=sum(labelled.distance_by_reason_m.values()), true_m=float(drive.truth.distance_m[-1]), wheels_m=wheels_m(read),
        kept_m=labelled.distance_by_reason_m.get("kept", 0.0), said=said_of(findings),
        blamed=sorted({f.subject.name for f in findings if f.severity != "note" and f.action in ("excluded", "rejected")}),
    )  # fmt: skip


def wheels_m(read: Streams) -> float:
    """Return the distance by the wheels [m]; NaN without wheels."""
    if "wheel_odometry" not in read.tables:
        return float("nan")
    table = read.tables["wheel_odometry"]
    steps_s = np.diff(to_integers(table, "stamp_ns")) * 1e-9
    speed = np.abs(to_floats(table, "velocity_x_mps"))
    return float(np.sum((speed[1:] + speed[:-1]) / 2 * np.minimum(steps_s, 1.0)))


def bit_names(bits: int) -> list[str]:
    """Return the names of quality bits."""
    return [flag_name(bit) for bit in Quality if bits & bit]
