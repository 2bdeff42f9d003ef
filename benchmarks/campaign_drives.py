"""What the campaign drives: simulated drives in memory, their log as a reader of the pipeline takes it, and labels against the truth.

A drive is simulated once for a route and a seed; its sensors are then read anew for every cell. No file is written: `MemoryLog` gives
the stage `read` the tables that a log on disk would give, and the stages from there on are those of `tcpipe ingest`.
"""

from __future__ import annotations

import traceback
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np
import pyarrow as pa
import pyproj

from tcpipe.errors import TcpipeError
from tcpipe.formats.finding_lines import format_finding
from tcpipe.formats.logs.writing import MessageStream
from tcpipe.formats.recipe_toml import load_shipped_profiles
from tcpipe.logs.messages import list_needed_fields
from tcpipe.logs.topics import Topic
from tcpipe.pipeline.ingest_run import run_stages
from tcpipe.recipe import Recipe
from tcpipe.simulation import Faults, Truth, compute_true_cost, simulate_readings
from tcpipe.simulation.messages import Recorder, make_streams
from tcpipe.simulation.route import Leg, Manoeuvre, Pause, Wander
from tcpipe.simulation.scenarios import DriveSpec, RasterSpec, Scenario, make_small_world
from tcpipe.simulation.sensors import Noise, Reading, Sensors, record
from tcpipe.simulation.world import Site
from tcpipe.stages.read import read_run
from tcpipe.tables.arrays import to_numbers
from tcpipe.tables.bits import Quality, flag_name
from tcpipe.tables.columns import to_floats, to_integers
from tcpipe.tables.findings import Finding
from tcpipe.tables.levels import LabelledSegments, Streams

Readings = Mapping[str, Reading]
Messages = Sequence[MessageStream]

QUANTITIES = {"T": "duration_s", "v": "velocity_mps", "w": "power_watt", "E": "energy_joule", "start": "position_m"}
"""What is compared with the truth, and its column; the last is the start point's place."""
FIRST_SEED = 501
HUSKY = Recorder("ros2", "clearpath_power")
WHOLE = replace(Faults.every(), gnss_outage=False, visual_dropouts=False, power_gap=False)
"""Noise, scales, biases, mounts, outliers and delays of every sensor, but no hole in any: what is clean here."""
_STARTS_M = ((14.0, 34.0), (110.0, 30.0), (90.0, 55.0), (30.0, 60.0), (60.0, 30.0), (40.0, 20.0))
_WHEEL_PERIOD_S = 0.02


@dataclass(frozen=True)
class Drive:
    """What truly happened, where, and the random streams of its sensors."""

    truth: Truth
    site: Site
    noise: Noise

    @property
    def first_ns(self) -> int:
        """When the drive began."""
        return int(self.truth.stamp_ns[0])

    def seconds(self, stamp_ns: np.ndarray) -> np.ndarray:
        """Return time since the drive began [s]."""
        return (stamp_ns - self.first_ns) * 1e-9


@dataclass(frozen=True)
class Fault:
    """What is wrong with a log, as what it changes on the way from the robot to the log; a new fault is one of these.

    ``sensors`` changes the sensors as they really are, ``told`` what the log says of them (places, variances), ``readings`` what
    they measured, ``messages`` what was recorded; ``route`` names the drive, ``true_ns`` leads from the track's time to the truth's.
    """

    name: str
    at_fault: tuple[str, ...] = ()
    """The sensors that one who knows would leave out; none where the fault is of the drive or the whole log."""
    window_s: tuple[float, float] | None = None
    """Since the drive began; None: from beginning to end."""
    said: str = ""
    """A regular expression that a finding or error is to hold; nothing has to be said where it is empty."""
    may_refuse: bool = False
    """Whether a run without a segment is right: no sensor is left that could tell who is wrong, or nothing is to be labelled."""
    unseen_m: float = 0.0
    """By how much start points may err as no sensor tells, though here they do not: this robot turns about base_link exactly."""
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


@cache
def simulated(route: str, seed: int, length_m: float) -> Drive:
    """Return a drive: over hills, straight ahead, or standing."""
    start_m = _STARTS_M[seed % len(_STARTS_M)]
    site = Site(width_m=900.0) if route == "straight" else Site()
    world = make_small_world(site)
    plan: tuple[Manoeuvre, ...] | Wander
    if route == "straight":
        start_m, world = (10.0, 40.0), replace(world, hills=(), regions=(), holes=())
        plan = (Pause(3.0), Leg(((10.0 + 4.0 * length_m, 40.0),)), Pause(3.0))
    elif route == "standing":
        plan = (Pause(60.0),)
    else:
        plan = Wander(length_m, start_m, climbing=0.4)
    weave_m = 0.0 if route == "straight" else 0.04
    spec = DriveSpec("drive", plan, start_m, sensors=Sensors(*[None] * 6), weave_m=weave_m)
    scenario = Scenario("campaign", world, (spec,), ((1.0, 1.0), (80.0, 1.0), (80.0, 79.0)), RasterSpec(2.0, 2.0, 2.0))
    truth, _ = simulate_readings(scenario, seed=seed)
    return Drive(truth, site, Noise(seed, 0))


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
    try:
        return list_needed_fields(type_name)
    except KeyError:  # of power and of transforms
        return ()


def log_of(drive: Drive, sensors: Sensors, fault: Fault) -> MemoryLog:
    """Return what is recorded of a drive where a fault is."""
    real = fault.sensors(sensors).mounted(WHOLE)
    readings = fault.readings(record(drive.truth, drive.site, real, WHOLE, drive.noise), drive)
    messages = make_streams(readings, fault.told(real), HUSKY, geoid_m=drive.site.geoid_m)
    recorded = fault.messages(messages, drive)
    return MemoryLog([m for m in recorded if m.constants.get("transforms") != []])


@dataclass(frozen=True)
class Outcome:
    """What one log gave, and how true it is; arrays have one value a labelled segment."""

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
    """The way that the wheels tell; NaN without."""
    kept_m: float
    said: list[str]
    """Findings, or why there is no run."""
    trace: str = ""
    """Where an error that nobody foresaw comes from."""


def outcome_of(drive: Drive, sensors: Sensors, fault: Fault) -> Outcome:
    """Run the stages of ingest over a log, and compare with the truth; no error gets out."""
    true_m = float(drive.truth.distance_m[-1])
    recipe = Recipe()
    try:
        read = read_run(log_of(drive, sensors, fault), recipe.read, robot="husky", known=load_shipped_profiles())
        _, _, labelled = run_stages(read, recipe.ingest, run_id="run")
    except TcpipeError as error:
        return Outcome(
            [],
            _nothing(),
            _nothing(),
            [],
            [],
            0.0,
            true_m,
            float("nan"),
            0.0,
            [*error.problems, *said_of(error.findings)],
        )
    except Exception as error:  # noqa: BLE001  the campaign is to find them
        trace, said = traceback.format_exc(), [f"{type(error).__name__}: {error}"]
        return Outcome([], _nothing(), _nothing(), [], [], 0.0, true_m, float("nan"), 0.0, said, trace)
    return _compared(labelled, read, drive, fault, max_std_m=recipe.sample.max_position_std_m)


def said_of(findings: Iterable[Finding]) -> list[str]:
    """Return the findings as lines with their codes."""
    return [format_finding(finding) for finding in dict.fromkeys(findings)]


def _nothing() -> dict[str, list[float]]:
    return {name: [] for name in QUANTITIES}


def _compared(labelled: LabelledSegments, read: Streams, drive: Drive, fault: Fault, *, max_std_m: float) -> Outcome:
    table = labelled.table
    start_ns = fault.true_ns(to_integers(table, "start_ns"), drive)
    true = compute_true_cost(drive.truth, start_ns)
    error, claimed = {}, {}
    for name, column in list(QUANTITIES.items())[:-1]:
        quantity, unit = column.rsplit("_", 1)
        error[name] = (to_floats(table, column) - getattr(true, column)).tolist()
        claimed[name] = to_floats(table, f"{quantity}_std_{unit}").tolist()
    there = drive.truth.at(start_ns)
    lon, lat = to_floats(table, "start_lon_deg"), to_floats(table, "start_lat_deg")
    std_m = to_floats(table, "position_std_m")
    _, _, apart_m = pyproj.Geod(ellps="WGS84").inv(lon, lat, there.lon_deg, there.lat_deg)
    error["start"], claimed["start"] = apart_m.tolist(), std_m.tolist()
    placed = np.isfinite(lon) & (std_m <= max_std_m)
    return Outcome(
        start_s=drive.seconds(start_ns).tolist(), error=error, claimed=claimed,
        bits=to_numbers(table["quality"]).tolist(), placed=placed.tolist(),
        driven_m=sum(labelled.ledger_m.values()), true_m=float(drive.truth.distance_m[-1]), wheels_m=wheels_m(read),
        kept_m=labelled.ledger_m.get("kept", 0.0), said=said_of(labelled.info.report.findings),
    )  # fmt: skip


def wheels_m(read: Streams) -> float:
    """Return the way that the wheels tell [m]; NaN without."""
    if "wheel_odometry" not in read.tables:
        return float("nan")
    table = read.tables["wheel_odometry"]
    steps_s = np.diff(to_integers(table, "stamp_ns")) * 1e-9
    speed = np.abs(to_floats(table, "velocity_x_mps"))
    return float(np.sum((speed[1:] + speed[:-1]) / 2 * np.minimum(steps_s, 1.0)))


def bit_names(bits: int) -> list[str]:
    """Return the names of quality bits."""
    return [flag_name(bit) for bit in Quality if bits & bit]
