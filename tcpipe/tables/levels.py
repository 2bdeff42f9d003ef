"""The levels of data L1 to L6 (ARCHITECTURE.md): the schema of every table, and the types that stages exchange.

A level is checked when it is created: an invalid Track cannot exist, and one error names every wrong column.
Frames follow REP-103 and REP-105: base_link is x forward, y left, z up; the track's plane is east, north, up of its ENU
origin.
"""

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import pyarrow as pa

from tcpipe.errors import TableError
from tcpipe.tables.bits import DropReason, Quality
from tcpipe.tables.columns import Column, Tables, TableSchema
from tcpipe.tables.facts import NOTHING_FOUND, StageFacts
from tcpipe.tables.findings import Finding, StageReport

DATA_MODEL_VERSION = "4.0"
"""Version of every manifest and card that is written; docs/reference/data-model.md has its history."""

TABLES_VERSION = "4.0"  # in which a table last changed

RESULTS_VERSION = 9
"""Raised when the same log and recipe give other values in a table: runs of an earlier one are ingested again."""


def describe_other_data_model(where: str, version: str) -> str:
    """Return the error on a store, dataset or map that another data model wrote."""
    maker = "tcpipe 1.x" if version == "3.0" else "another version of tcpipe"
    return f"{where}: made by {maker} (data model {version}), expected {DATA_MODEL_VERSION}: ingest the logs again"


GEOMETRY = "geometry"
"""Column with the place of a row for other tools (GeoParquet)."""

COORDINATES = (*(f"{end}_{axis}_deg" for end in ("start", "end") for axis in ("lon", "lat")), GEOMETRY)
"""Columns of segments and samples that state where on Earth they are."""

_METADATA_KEY = b"tcpipe"

_F64 = pa.float64()
_I64 = pa.int64()
_ENU = ("east", "north", "up")

_STAMP = Column("stamp_ns", _I64, "ns", "time of measurement, UTC, since 1970 (or since the epoch of simulated time)")
_LOG_TIME = Column("log_time_ns", _I64, "ns", "time the recorder received the message")
_EPOCH = Column(
    "clock_epoch",
    pa.int16(),
    "1",
    "clock epoch: a lasting step of the clock opens the next; nothing is integrated across it",
)


def _make_stream_schema(name: str, doc: str, *columns: Column) -> TableSchema:
    return TableSchema(name, "L1", doc, (_STAMP, _LOG_TIME, _EPOCH, *columns))


def _make_nullable(name: str, unit: str, doc: str, frame: str = "") -> Column:
    """Return a column of numbers that are not always known."""
    return Column(name, _F64, unit, doc, frame, nullable=True)


def _make_geometry(doc: str, frame: str) -> Column:
    return Column(GEOMETRY, pa.binary(), "", f"{doc}; WKB, longitude first", frame, nullable=True)


GNSS = _make_stream_schema(
    "gnss",
    "Antenna positions, fixes only.",
    Column("lon_deg", _F64, "deg", "longitude of the antenna", "gnss_crs"),
    Column("lat_deg", _F64, "deg", "latitude of the antenna", "gnss_crs"),
    Column("alt_m", _F64, "m", "height of the antenna above the ellipsoid", "gnss_crs"),
    _make_nullable("east_var_m2", "m2", "variance east; null where the receiver gives none", "enu"),
    _make_nullable("north_var_m2", "m2", "variance north; null where the receiver gives none", "enu"),
    _make_nullable("up_var_m2", "m2", "variance up; null where the receiver gives none", "enu"),
    Column("fix_status", pa.int8(), "1", "NavSatStatus: 0 fix, 1 satellite-based, 2 ground-based augmentation"),
)

IMU = _make_stream_schema(
    "imu",
    "Inertial measurements in the sensor's frame.",
    *(Column(f"angular_velocity_{c}_radps", _F64, "rad/s", f"angular velocity, {c}", "sensor") for c in "xyz"),
    *(
        Column(f"linear_acceleration_{c}_mps2", _F64, "m/s2", f"specific force (gravity included), {c}", "sensor")
        for c in "xyz"
    ),
    *(
        _make_nullable(f"quat_{c}", "1", f"orientation world_from_sensor, {c}; null where absent", "world")
        for c in "xyzw"
    ),
    *(
        _make_nullable(f"{name}_var", unit, f"mean variance of the {doc}; null where unknown", "sensor")
        for name, unit, doc in (
            ("angular_velocity", "rad2/s2", "angular velocity"),
            ("linear_acceleration", "m2/s4", "specific force"),
            ("orientation", "rad2", "orientation"),
        )
    ),
)


def _make_odometry_schema(name: str, doc: str) -> TableSchema:
    return _make_stream_schema(
        name,
        doc,
        *(
            _make_nullable(f"{prefix}_{axis}_{suffix}", unit, f"{text}, {axis}", "child")
            for prefix, suffix, unit, text in (
                ("velocity", "mps", "m/s", "body velocity; null where the source does not measure it"),
                ("angular_velocity", "radps", "rad/s", "body angular velocity; null if not measured"),
                ("velocity_var", "m2ps2", "m2/s2", "variance of the body velocity; null where unknown"),
            )
            for axis in "xyz"
        ),
        _make_nullable("yaw_rate_var", "rad2/s2", "variance of the yaw rate; null where unknown", "child"),
        *(
            _make_nullable(f"{axis}_m", "m", f"pose {axis} in the source's own odom frame; for increments only", "odom")
            for axis in "xyz"
        ),
        *(
            _make_nullable(f"quat_{c}", "1", f"pose orientation odom_from_child, {c}; for increments only", "odom")
            for c in "xyzw"
        ),
    )


WHEEL_ODOMETRY = _make_odometry_schema("wheel_odometry", "Wheel odometry: a body twist in the child frame.")
VISUAL_ODOMETRY = _make_odometry_schema(
    "visual_odometry", "Visual odometry: a body twist, or poses to be used as increments, in its own child frame."
)

GNSS_VELOCITY = _make_stream_schema(
    "gnss_velocity",
    "Velocity of the antenna over ground, from its receiver (Doppler).",
    *(Column(f"{axis}_velocity_mps", _F64, "m/s", f"velocity {axis}", "enu", axis == "up") for axis in _ENU),
    *(_make_nullable(f"{axis}_var_m2ps2", "m2/s2", f"variance {axis}; null if unknown", "enu") for axis in _ENU),
    Column("fix_status", pa.int8(), "1", "NavSatStatus as in gnss; -1 if the message has none"),
)

POWER = _make_stream_schema(
    "power",
    "Voltage and current of each drive rail; a rail's power is their product, the robot's the sum over rails.",
    Column("rail", pa.string(), "", "name of the rail (profile or topic)"),
    _make_nullable(
        "voltage_volt", "V", "voltage; null where this row carries only a current; 1 if only power [W] is known"
    ),
    _make_nullable("current_amp", "A", "current, positive when drawn; null where this row carries only a voltage"),
)

COMMAND = _make_stream_schema(
    "command",
    "Commanded body velocity.",
    Column("forward_velocity_mps", _F64, "m/s", "commanded forward velocity", "base_link"),
    Column("yaw_rate_radps", _F64, "rad/s", "commanded yaw rate", "base_link"),
)

POSE = _make_stream_schema(
    "pose",
    "Positions and attitudes from SLAM or post-processing, used in place of GNSS.",
    *(Column(f"{axis}_m", _F64, "m", f"position, {axis}, as recorded", "pose_crs or its own") for axis in "xyz"),
    _make_nullable("lon_deg", "deg", "longitude; null without a CRS", "gnss_crs"),
    _make_nullable("lat_deg", "deg", "latitude; null without a CRS", "gnss_crs"),
    _make_nullable("alt_m", "m", "height, as recorded; null without a CRS", "gnss_crs"),
    *(
        _make_nullable(f"{name}_var_m2", "m2", f"variance along {axis}; null where none is given", "")
        for name, axis in (("east", "x"), ("north", "y"), ("up", "z"))
    ),
    *(
        _make_nullable(f"quat_{c}", "1", f"frame_from_sensor, {c}; null where unknown", "pose_crs or its own")
        for c in "xyzw"
    ),
    *(_make_nullable(f"rotation_{axis}_var", "rad2", f"variance about {axis}; null where unknown") for axis in "xyz"),
)

STREAMS: dict[str, TableSchema] = {
    schema.name: schema for schema in (GNSS, GNSS_VELOCITY, IMU, WHEEL_ODOMETRY, VISUAL_ODOMETRY, POWER, COMMAND, POSE)
}
"""Schema of each role's table."""

_TRACK_COLUMNS = (
    Column("stamp_ns", _I64, "ns", "time, UTC; a multiple of the track's period"),
    _EPOCH,
    *(
        Column(f"{axis}_m", _F64, "m", f"base_link {name} of the datum", "enu")
        for axis, name in zip("xyz", ("east", "north", "up"), strict=True)
    ),
    _make_nullable("lon_deg", "deg", "longitude of base_link; null in a local frame", "gnss_crs"),
    _make_nullable("lat_deg", "deg", "latitude of base_link; null in a local frame", "gnss_crs"),
    _make_nullable("alt_m", "m", "ellipsoidal height of base_link; null in a local frame", "gnss_crs"),
    Column("roll_rad", _F64, "rad", "roll", "enu"),
    Column("pitch_rad", _F64, "rad", "pitch, positive nose down (REP-103)", "enu"),
    Column("yaw_rad", _F64, "rad", "yaw of the body, counter-clockwise from true east, [-pi, pi)", "enu"),
    *(
        Column(f"{name}_velocity_mps", _F64, "m/s", f"velocity {name} of base_link", "enu")
        for name in ("east", "north", "up")
    ),
    Column("forward_velocity_mps", _F64, "m/s", "velocity along the body's x axis", "base_link"),
    Column("yaw_rate_radps", _F64, "rad/s", "angular velocity about the body's z axis", "base_link"),
    *(Column(f"{axis}_std_m", _F64, "m", f"standard deviation of {axis}", "enu") for axis in "xyz"),
    Column("yaw_std_rad", _F64, "rad", "standard deviation of yaw", "enu"),
    Column("forward_velocity_std_mps", _F64, "m/s", "standard deviation of the forward velocity", "base_link"),
    *(
        _make_nullable(
            f"displacement_std_{name}_m",
            "m",
            f"standard deviation of the horizontal displacement over the next {name}, along it, "
            "including the correlation of both ends; "
            "null where the track does not go on, and without a smoother",
            "enu",
        )
        for name in ("500ms", "1s", "2s", "4s", "8s", "16s")
    ),
    _make_nullable(
        "wheel_velocity_mps", "m/s", "forward velocity by the wheels, interpolated; null without", "base_link"
    ),
    _make_nullable("commanded_velocity_mps", "m/s", "last commanded forward velocity; null if it is old", "base_link"),
    _make_nullable("commanded_yaw_rate_radps", "rad/s", "last commanded yaw rate; null if it is old", "base_link"),
    _make_nullable("voltage_volt", "V", "mean voltage over the rails, interpolated; null if not measured"),
    _make_nullable("current_amp", "A", "sum of the rails' currents, interpolated; null if not measured"),
    _make_nullable("power_watt", "W", "sum over rails of voltage times current; null without power"),
)

TRACK = TableSchema("track", "L2", "The fused track, 20 Hz, base_link.", _TRACK_COLUMNS)

MASKED_TRACK = TableSchema(
    "track",
    "L3",
    "The fused track with the reasons why rows are not used; nothing is deleted.",
    (*_TRACK_COLUMNS, Column("dropped_by", pa.uint32(), "bits", "why the row is not used, 0 = kept", flags=DropReason)),
)

_SEGMENT_COLUMNS = (
    Column("segment_id", pa.string(), "", "run_id + '-' + start stamp"),
    Column("run_id", pa.string(), "", "log stem + first 8 hex of its sha256"),
    Column("robot", pa.string(), "", "robot profile"),
    _EPOCH,
    Column("start_ns", _I64, "ns", "time at the segment's start, interpolated"),
    Column("end_ns", _I64, "ns", "time at the segment's end, interpolated"),
    *(
        _make_nullable(f"{end}_{name}_deg", "deg", f"{doc} of the {end}; null in a local frame", "gnss_crs")
        for end in ("start", "end")
        for name, doc in (("lon", "longitude"), ("lat", "latitude"))
    ),
    *(
        Column(f"{end}_{axis}_m", _F64, "m", f"{name} of the {end}", "enu")
        for end in ("start", "end")
        for axis, name in zip("xyz", ("east", "north", "up"), strict=True)
    ),
    Column("chord_m", _F64, "m", "horizontal straight-line distance start to end", "enu"),
    Column("arc_length_m", _F64, "m", "horizontal length of the driven path", "enu"),
    Column("course_rad", _F64, "rad", "direction start to end, counter-clockwise from true east", "enu"),
    Column(
        "fused_velocity_mps", _F64, "m/s", "time-mean of the fused forward body velocity (the paper's v*)", "base_link"
    ),
    Column(
        "position_std_m",
        _F64,
        "m",
        "DRMS of the horizontal position (root of the sum of both variances), less certain end",
        "enu",
    ),
    _make_nullable(
        "commanded_velocity_mps", "m/s", "mean commanded forward velocity; null without commands", "base_link"
    ),
)

SEGMENTS = TableSchema("segments", "L4", "Steady, straight sections of one chord each.", _SEGMENT_COLUMNS)

_GAPS = "null where the IMU has gaps or is below 50 Hz"
_UNSURE = "null without a gyroscope or a smoother"

MOTION_COLUMNS = tuple(
    _make_nullable(name, unit, doc, frame)
    for name, unit, doc, frame in (
        ("yaw_change_rad", "rad", "change of yaw from start to end, counter-clockwise", "enu"),
        ("yaw_change_std_rad", "rad", f"standard deviation of yaw_change_rad; {_UNSURE}", "enu"),
        ("mean_abs_yaw_rate_radps", "rad/s", "time-mean of the absolute yaw rate", "base_link"),
        (
            "mean_abs_yaw_rate_std_radps",
            "rad/s",
            f"standard deviation of mean_abs_yaw_rate_radps; {_UNSURE}",
            "base_link",
        ),
        ("curvature_radpm", "rad/m", "yaw_change_rad over arc_length_m, positive to the left", "enu"),
        ("curvature_std_radpm", "rad/m", f"standard deviation of curvature_radpm; {_UNSURE}", "enu"),
        ("roll_rad", "rad", "measured roll in the middle of the segment's time", "enu"),
        ("pitch_rad", "rad", "measured pitch there, positive nose down (REP-103)", "enu"),
        (
            "slip_fraction",
            "1",
            "1 - mean speed over ground / mean speed of the wheels, both along the body; null without wheels",
            "base_link",
        ),
        (
            "slip_std_fraction",
            "1",
            (
                "standard deviation of slip_fraction from the speed over ground: "
                "it excludes a wrong wheel radius, which counts as slip"
            ),
            "base_link",
        ),
        (
            "vibration_mps2",
            "m/s2",
            f"root mean square of the specific force between 3 and 20 Hz, three axes together; {_GAPS}",
            "sensor",
        ),
        (
            "vibration_std_mps2",
            "m/s2",
            "standard deviation of vibration_mps2 by the short time of a segment; it excludes the noise of the IMU",
            "sensor",
        ),
    )
)
"""How the robot moves over a segment."""

_NET_COLUMNS = tuple(
    _make_nullable(name, unit, doc)
    for name, unit, doc in (
        ("voltage_volt", "V", "time-mean of the voltage, over the rails; null if not measured"),
        ("idle_power_watt", "W", "power of the stationary robot in this run; null if it was hardly stationary"),
        (
            "idle_power_std_watt",
            "W",
            "standard deviation of idle_power_watt: variation over the run and measurement noise",
        ),
        ("net_power_watt", "W", "power_watt less idle_power_watt"),
        ("net_power_std_watt", "W", "standard deviation of net_power_watt as a label of the segment"),
        ("net_energy_joule", "J", "energy_joule less idle_power_watt times duration_s"),
        ("net_energy_std_joule", "J", "standard deviation of net_energy_joule, likewise"),
    )
)

_COMMON_COLUMNS = tuple(
    _make_nullable(name, unit, f"part of {name.replace('_common', '')} that is one error of the whole run")
    for name, unit in (
        ("duration_common_std_s", "s"),
        ("velocity_common_std_mps", "m/s"),
        ("power_common_std_watt", "W"),
        ("energy_common_std_joule", "J"),
        ("net_power_common_std_watt", "W"),
        ("net_energy_common_std_joule", "J"),
    )
)
"""Over a path these add up linearly."""

_LABEL_COLUMNS = (
    Column("duration_s", _F64, "s", "T: time from start to end"),
    Column("velocity_mps", _F64, "m/s", "v: chord / duration"),
    _make_nullable("power_watt", "W", "w: energy / duration; null without power"),
    _make_nullable("energy_joule", "J", "E: integral of voltage times current; null without power"),
    Column("duration_std_s", _F64, "s", "standard deviation of the duration as a label of the true chord"),
    Column("velocity_std_mps", _F64, "m/s", "standard deviation of the velocity, likewise"),
    _make_nullable("power_std_watt", "W", "standard deviation of the power, likewise; null without power"),
    _make_nullable("energy_std_joule", "J", "standard deviation of the energy, likewise; null without power"),
    *_NET_COLUMNS,
    *_COMMON_COLUMNS,
    Column("power_samples", pa.int32(), "1", "power samples inside the segment"),
    Column(
        "confirming_sensor_count",
        pa.int32(),
        "1",
        "GNSS or pose, wheels, camera: how many measured in the segment and agree with the track",
        nullable=True,
    ),
    Column("quality", pa.uint32(), "bits", "limitations of the label, 0 = none", flags=Quality),
)

LABEL_STD = {
    "power_watt": "power_std_watt",
    "velocity_mps": "velocity_std_mps",
    "duration_s": "duration_std_s",
    "energy_joule": "energy_std_joule",
}
"""Column of the standard deviation of each label, w, v, T, E."""

LABELLED_SEGMENTS = TableSchema(
    "segments",
    "L5",
    "Segments with their labels.",
    (
        *(*_SEGMENT_COLUMNS, *MOTION_COLUMNS, *_LABEL_COLUMNS),
        _make_geometry("LineString from start to end; null in a local frame", "gnss_crs"),
    ),
)

LABELS: Mapping[str, str] = {
    "energy": "energy_joule",
    "time": "duration_s",
    "slip": "slip_fraction",
    "vibration": "vibration_mps2",
}
"""Column of each label that a dataset can be asked for."""

PLACED_SEGMENTS = LABELLED_SEGMENTS.select_columns(
    *(f"{end}_{axis}_deg" for end in ("start", "end") for axis in ("lon", "lat")),
    *("run_id", "chord_m", "arc_length_m", "position_std_m"),
)
"""Columns of a segment that sampling reads."""

SAMPLES = TableSchema(
    "samples",
    "L6",
    "One row per sample, in the order of the patches.",
    (
        Column("sample_id", pa.string(), "", "the segment's id; joins samples and patches"),
        Column("split", pa.string(), "", "train, test, unseen or buffer"),
        Column(
            "fold",
            pa.int8(),
            "1",
            "fold of spatial cross-validation, blocks kept whole; null unless train or test",
            nullable=True,
        ),
        Column(
            "map", pa.string(), "", "name of the map the patch was sampled from; null without patches", nullable=True
        ),
        *_SEGMENT_COLUMNS,
        *MOTION_COLUMNS,
        *_LABEL_COLUMNS,
        Column(
            "terrain_class",
            pa.uint8(),
            "1",
            "majority class id under the chord; null without a terrain layer",
            nullable=True,
        ),
        Column("terrain_name", pa.string(), "", "name of that class; null without a terrain layer", nullable=True),
        _make_nullable("terrain_purity", "1", "share of the chord on that class; null without a terrain layer"),
        *(
            _make_nullable(name, unit, f"{doc}; null without patches", frame)
            for name, unit, doc, frame in (
                (
                    "slope_rad",
                    "rad",
                    "slope of a plane fitted to the patch's heights, positive uphill along travel",
                    "",
                ),
                ("cross_slope_rad", "rad", "cross slope, positive when the left side is higher", ""),
                ("valid_fraction", "1", "share of the patch's pixels with data in every layer", ""),
                ("height_min_m", "m", "smallest height in the patch; the height layer is above it", "map"),
                (
                    "height_clipped_fraction",
                    "1",
                    "share of pixels more than 1 m above the smallest, clipped in the tensor",
                    "",
                ),
            )
        ),
        _make_geometry("Point in the centre of the footprint; null in a local frame", "WGS 84"),
    ),
)

REJECTIONS = TableSchema(
    "rejections",
    "L2",
    "Measurements that the filter rejected, and why.",
    (
        Column("stamp_ns", _I64, "ns", "time of the measurement"),
        Column("role", pa.string(), "", "gnss, gnss_velocity, imu, wheel_odometry, visual_odometry"),
        Column("reason", pa.string(), "", "gate: chi-square; invalid: not finite; covariance: unusable"),
        _make_nullable("normalized_innovation_squared", "1", "innovation' S^-1 innovation; null where not computed"),
        _make_nullable("threshold", "1", "the gate; null where not computed"),
    ),
)


@dataclass(frozen=True, slots=True)
class Sensor:
    """The topic of a stream and the extrinsics of its sensor.

    ``xyz_m``, ``quat_xyzw``: base_link_from_sensor (position of the sensor in base_link; rotation sensor to base_link).
    """

    topic: str
    type_name: str
    frame_id: str
    why: str
    xyz_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    quat_xyzw: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 1.0)
    placed_by: str = "assumed"
    """``tf_static``, ``recipe``, ``same frame`` (already base_link), ``assumed``, ``not needed`` (power, command)."""
    time_source: str = "header"
    """Source of the stamps: ``header`` or ``log``."""


@dataclass(frozen=True, slots=True)
class Streams:
    """L1: one checked table per role that the log has, and where each came from."""

    tables: Tables
    sensors: Mapping[str, Sensor]
    robot: str
    gnss_crs: str = "EPSG:4326"
    power_averaged: bool = False
    """The source averages power over its message period (right-endpoint rectangle) rather than sampling it."""
    report: StageReport[StageFacts] = NOTHING_FOUND

    def __post_init__(self) -> None:
        """Check every table against its role's schema."""
        if problems := [line for role, table in self.tables.items() for line in STREAMS[role].find_problems(table)]:
            raise TableError(*problems)


@dataclass(frozen=True, slots=True)
class Datum:
    """Origin of a track's ENU plane; ``crs`` is the geographic CRS of lon/lat. All zero in a local frame."""

    lon_deg: float
    lat_deg: float
    alt_m: float
    crs: str = "EPSG:4326"


@dataclass(frozen=True, slots=True)
class TrackInfo:
    """Facts of a whole track; ``datum`` is None for a local frame (a log without GNSS)."""

    run_id: str
    robot: str
    datum: Datum | None
    rate_hz: float
    estimator: str
    report: StageReport[StageFacts] = NOTHING_FOUND


@dataclass(frozen=True, slots=True)
class Track:
    """L2: the fused track and the measurements that fusion refused."""

    table: pa.Table
    rejections: pa.Table
    info: TrackInfo

    def __post_init__(self) -> None:
        """Check both tables."""
        TRACK.check(self.table)
        REJECTIONS.check(self.rejections)


@dataclass(frozen=True, slots=True)
class _Level:
    """The table of a level, checked against its schema, and facts of the whole track."""

    schema: ClassVar[TableSchema]
    table: pa.Table
    info: TrackInfo

    def __post_init__(self) -> None:
        """Check the table."""
        self.schema.check(self.table)


class MaskedTrack(_Level):
    """L3: the track with ``dropped_by``."""

    __slots__ = ()
    schema = MASKED_TRACK


@dataclass(frozen=True, slots=True)
class Segments(_Level):
    """L4: cut segments, and every metre of the track by reason (``distance_by_reason_m``: kept, then each loss)."""

    schema: ClassVar[TableSchema] = SEGMENTS
    distance_by_reason_m: Mapping[str, float]


class LabelledSegments(Segments):
    """L5: segments with their labels."""

    __slots__ = ()
    schema = LABELLED_SEGMENTS


def add_findings(info: TrackInfo, findings: Iterable[Finding], facts: StageFacts) -> TrackInfo:
    """Return ``info`` with one more stage's findings, and the facts with that stage's."""
    return replace(info, report=StageReport((*info.report.findings, *findings), facts))


def add_metadata(table: pa.Table, metadata: Mapping[str, Any]) -> pa.Table:
    """Return the table with ``metadata`` (JSON values) in its schema, under the key ``tcpipe``."""
    text = json.dumps({"data_model_version": TABLES_VERSION, **metadata}, sort_keys=True)
    return table.replace_schema_metadata({**(table.schema.metadata or {}), _METADATA_KEY: text.encode()})


def read_metadata(table: pa.Table) -> dict[str, Any]:
    """Return what `add_metadata` stored, or an empty dict."""
    found: dict[str, Any] = json.loads((table.schema.metadata or {}).get(_METADATA_KEY, b"{}"))
    return found
