"""The recipe: every key of the pipeline's configuration, one frozen dataclass a stage, with default, bounds and reason.

It is checked at creation, in TOML and in Python. ``formats.recipe_toml`` reads it from TOML; docs/reference/recipe.md
and ``tcpipe init`` are written from the docstrings here.
Names end in their units. Rulings and their sources: docs/explanation/rulings.md.

Outside its bounds a value has no meaning or unlimited cost: bounds are far outside the needs of any robot, sensor or
site.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from typing import Annotated, Literal

from tcpipe.recipe.checking import parse_utc_ns, validate_fields
from tcpipe.robots import NOMINAL_STD_FRACTION, TABLE_POWER, PlausibleSpeed, PowerSource, Robot, Share, Volt
from tcpipe.tables.bounds import Bounds
from tcpipe.tables.findings import omit

Role = Literal["gnss", "gnss_velocity", "imu", "wheel_odometry", "visual_odometry", "power", "command", "pose"]
MappedRole = Literal["gnss", "gnss_velocity", "imu", "wheel_odometry", "visual_odometry", "command", "pose"]
"""Roles whose messages can be mapped; power has its own tables, [[power_sources]]."""
MadeFrom = Literal["imu", "wheel_odometry", "visual_odometry"]
FixQuality = Literal["rtk_fixed", "rtk_float", "differential", "single"]
Fraction = Annotated[float, Bounds(ge=0, le=1)]
Deviation = Annotated[float, Bounds(ge=1e-6, le=1e3)]
"""Bounds of a standard deviation or noise: smaller values have no effect in sums, larger ones no weight."""
Limit = Annotated[float, Bounds(ge=1e-6, le=1e3)]
"""Bounds of a threshold of speed, rate, acceleration or radius: beyond them, all or no values pass."""
Window = Annotated[float, Bounds(ge=0.01, le=60)]
"""Time that one motion takes [s]: less than any sensor's period, more than any manoeuvre."""
Gap = Annotated[float, Bounds(ge=0.01, le=3600)]
"""Bounds of a time without messages [s]: from less than any sensor's period to more than odometry stays accurate."""
Widening = Annotated[float, Bounds(ge=0, le=600)]
"""Time around an event that is dropped with it [s]."""
ArcToChord = Annotated[float, Bounds(ge=1, le=10)]
"""Length of an arc over that of its chord: 1 is straight, 1.57 a half circle."""
Metres = Annotated[float, Bounds(ge=-1000, le=1000)]
Tolerance = Annotated[float, Bounds(ge=0, le=10)]
"""Bounds of the σ of a stated position [m]: 0 is exact; values above the robot's size have no meaning."""
Radians = Annotated[float, Bounds(ge=-6.3, le=6.3)]
"""An angle: one turn either way; more is mostly degrees."""
Offset = Annotated[float, Bounds(ge=-2e9, le=2e9)]
"""Between two clocks [s]: from one that counts from its start to UTC, or back."""
Scale = Annotated[float, Bounds(ge=0.01, le=100)]
"""Factor on a measurement; values outside the bounds are other units."""


class _Section:
    """Keys that are checked when they are made; messages name them after the class."""

    __slots__ = ()

    def __post_init__(self) -> None:
        validate_fields(self, type(self).__name__.removesuffix("Config").lower())


@dataclass(frozen=True, slots=True)
class Extrinsics(_Section):
    """Extrinsics of a sensor: base_link_from_sensor."""

    xyz_m: tuple[Metres, Metres, Metres] = (0.0, 0.0, 0.0)
    """Position of the sensor in base_link (x forward, y left, z up) [m]."""
    rpy_rad: tuple[Radians, Radians, Radians] = (0.0, 0.0, 0.0)
    """Rotation sensor to base_link as roll, pitch, yaw about fixed axes [rad]."""


@dataclass(frozen=True, slots=True)
class ReadConfig(_Section):
    """Topics by role, and the meaning of their numbers and stamps."""

    topics: dict[Role, list[str]] = field(default_factory=dict)
    """Topics by role (gnss, gnss_velocity, imu, wheel_odometry, visual_odometry, power, command, pose), if unclear."""
    ignore_topics: list[str] = field(default_factory=list)
    """Topics that are never used."""
    fields: dict[MappedRole, dict[str, str]] = omit({})
    """Fields of your own message types by role (gnss.latitude = "pvt.lat * 1e-7"); also list the topic in topics."""
    pose_crs: str | None = omit()
    """Projected CRS of the pose's positions (EPSG:2949); default: a local frame, which cannot be placed on a map."""
    pose_sources: list[MadeFrom] = omit([])
    """Roles besides GNSS that the pose was computed from: not fused as well, because they would count twice."""
    namespace: str | None = None
    """For a log of several robots: use only topics below this name (for example "/husky_1"); default: all topics."""
    extrinsics: dict[Role, Extrinsics] = field(default_factory=dict)
    """Sensor extrinsics by role; overrides /tf_static."""
    gnss_crs: str = "EPSG:4326"
    """Geographic CRS of the GNSS positions; RTK often comes in a national datum."""
    fix_std_m: dict[FixQuality, Deviation] = omit({})
    """Horizontal σ of fixes without useful covariance [m]: rtk_fixed 0.02, rtk_float 0.5, differential 1, single 4."""
    time_source: dict[Role, Literal["auto", "header", "log"]] = field(default_factory=dict)
    """Source of stamps by role: header, log or auto; auto uses header.stamp if it is set and follows the log time."""
    time_offset_s: dict[Role, Offset] = field(default_factory=dict)
    """Offset added to the stamps of a role [s]."""
    odometry_scale: dict[Role, Scale] = omit({})
    """Factor on velocities and distances of an odometry (wheels of another radius, a camera of another baseline)."""
    imu_units: Literal["si", "deg", "g", "deg_g"] = "si"
    """Units of the IMU: si: rad/s and m/s² (REP-103); deg: deg/s and m/s²; g: rad/s and g; deg_g: deg/s and g."""
    current_scale: Annotated[float, Bounds(ge=1e-6, le=1e6)] = omit(1.0)
    """Factor on all currents, powers and counters of energy: 0.001 if a driver publishes milliamperes as amperes."""
    current_sign: Literal["auto", "drawn_positive", "drawn_negative"] = "auto"
    """Sign of currents: auto uses the message type's; for BatteryState, which differs by robot, the run's mean."""
    current_offset_amp: Annotated[float, Bounds(ge=-1e4, le=1e4)] = omit(0.0)
    """Zero of each rail's current, positive as drawn, that is subtracted [A]; of a power without voltage [W]."""
    power_averaged: Literal["auto", "yes", "no"] = "auto"
    """Whether the power source averages over its message period: auto uses the value of the message type."""
    husky_power: Literal["battery", "drivers"] = "battery"
    """Power of a Husky: battery voltage times both driver currents (paper), or drivers: each driver's own voltage."""


@dataclass(frozen=True, slots=True)
class FuseConfig(_Section):
    """The estimator, and the noise that it assumes if the log states none."""

    estimator: Literal["smoother", "ukf"] = "smoother"
    """smoother: error-state unscented filter and fixed-interval smoother; ukf: the paper's forward filter."""
    rate_hz: Annotated[float, Bounds(ge=1, le=500)] = 20.0
    """Rate of the track, at most 500 Hz (the paper: 20 Hz)."""
    gate_probability: Annotated[float, Bounds(ge=0.5, le=0.999999999)] = 0.999
    """Outlier gate (chi-square): a measurement less likely than this is rejected and listed."""
    gnss_std_floor_m: Deviation = 0.01
    """Lower bound of GNSS standard deviations, whatever the receiver reports [m]."""
    gnss_default_std_m: Deviation = 0.05
    """Horizontal σ where the receiver gives none (the paper's RTK: 5 cm); vertical is twice as large [m]."""
    lever_arm_std_m: tuple[Tolerance, Tolerance, Tolerance] | None = omit()
    """Standard deviation of the lever arm of GNSS antenna or pose [m]; 0: exact. Default: 0.05 horizontal, up 0.1."""
    gnss_velocity_std_mps: Deviation = omit(0.1)
    """σ of a receiver's own velocity if it gives none (NMEA never does) [m/s]; vertical is twice as large."""
    wheel_std_mps: Deviation = 0.05
    """Standard deviation of wheel velocity where the source gives none [m/s]."""
    visual_std_mps: Deviation = 0.05
    """Standard deviation of visual velocity where the source gives none [m/s]."""
    nonholonomic_std_mps: Deviation = 0.15
    """σ of zero sideways and vertical velocity, 60 times a second [m/s]; far smaller values lead to rejected GNSS."""
    gyro_noise_radps: Deviation = 0.003
    """White noise of the gyroscope at its rate [rad/s]."""
    accelerometer_noise_mps2: Deviation = 0.10
    """White noise of the accelerometer at its rate, vibration included [m/s²]."""
    max_gap_s: Gap = 1.0
    """Without any motion measurement for this long the track has a gap [s]."""
    max_power_gap_s: Gap = 0.3
    """A power gap longer than this and three periods removes the track's power there and ends a segment [s]."""


@dataclass(frozen=True, slots=True)
class TimeWindow:
    """A span of a run that is dropped, or kept (then only such spans are kept)."""

    run: str = "*"
    """Pattern of the runs: the name of the log, or a run_id; * is any text."""
    action: Literal["drop", "keep"] = "drop"
    """Whether the span is dropped or kept."""
    start: Offset | str | None = None
    """Seconds from the start of the track, or UTC as "2025-11-18T21:40:00"; default: its start."""
    end: Offset | str | None = None
    """The same; default: the end of the track."""

    def contradictions(self) -> Iterator[tuple[str, str]]:
        """Yield each key with an invalid value, and the expected value."""
        is_read = True
        for key in ("start", "end"):
            try:
                _find_ns(getattr(self, key), 0, 0)
            except ValueError:
                is_read = False
                yield key, "seconds, or UTC as 2025-11-18T21:40:00"
        if is_read and isinstance(self.start, str) == isinstance(self.end, str):
            start_ns, end_ns = self.find_bounds_ns(0)
            if start_ns >= end_ns:
                yield "end", "a time after start"

    def is_for(self, run_id: str) -> bool:
        """Return whether it is for a run: the pattern fits its id, or the name of its log."""
        return any(fnmatchcase(name, self.run) for name in (run_id, run_id.rpartition("-")[0]))

    def find_bounds_ns(self, first_ns: int) -> tuple[int, int]:
        """Return start and end [ns] in a track that starts at ``first_ns``."""
        return _find_ns(self.start, first_ns, -(2**62)), _find_ns(self.end, first_ns, 2**62)


def _find_ns(at: float | str | None, first_ns: int, default_ns: int) -> int:
    if isinstance(at, str):
        return parse_utc_ns(at)
    return default_ns if at is None else first_ns + round(at * 1e9)


@dataclass(frozen=True, slots=True)
class MaskConfig(_Section):
    """Limits of steady driving; all other rows are masked, never deleted."""

    max_acceleration_mps2: Limit = 0.3
    """Largest steady acceleration without a command topic [m/s²]."""
    acceleration_window_s: Window = 0.45
    """Acceleration is the slope of the forward velocity over this long, centred [s]."""
    ramp_acceleration_mps2: Limit = 0.1
    """A ramp after or before a stop or a turn in place lasts while the speed changes faster than this [m/s²]."""
    min_event_s: Window = 0.2
    """An acceleration or rotation shorter than this is noise [s]."""
    dilate_s: Widening = 0.25
    """Masks of acceleration are widened by this on both sides [s]."""
    command_step_mps: Limit = 0.1
    """A command change larger than this within `command_window_s` is a change (a joystick jitters) [m/s]."""
    command_window_s: Window = 0.5
    """See `command_step_mps` [s]."""
    command_settle_s: Widening = 2.0
    """Rows this long after a commanded change are masked [s]."""
    require_full_speed: bool = True
    """With commands: mask rows commanded below `full_speed_fraction` of maximum speed, where terrain is no limit."""
    full_speed_fraction: Fraction = 0.95
    """See `require_full_speed`."""
    max_velocity_mps: Limit | None = None
    """Maximum speed of the robot; default: from the profile [m/s]."""
    max_plausible_mps: PlausibleSpeed | None = omit()
    """No labels where the track is faster; the run fails if most of a minute is. Default: from the profile [m/s]."""
    stationary_velocity_mps: Limit = 0.05
    """Slower than this (and not turning) is stationary [m/s]."""
    stationary_yaw_rate_radps: Limit = 0.05
    """See `stationary_velocity_mps` [rad/s]."""
    stuck_wheel_velocity_mps: Limit = 0.2
    """Wheels faster than this while the robot does not move are stuck [m/s]."""
    turning_velocity_mps: Limit = 0.10
    """Slower than this while turning is turning in place [m/s]."""
    turning_yaw_rate_radps: Limit = 0.10
    """See `turning_velocity_mps` [rad/s]."""
    min_turn_radius_m: Limit = 0.5
    """Turning tighter than this is turning in place [m]."""
    keep_reversing: bool = False
    """Keep sections driven backwards."""
    max_relative_position_std_m: Deviation = 0.10
    """A section is a gap where the standard deviation of the distance over one chord exceeds this [m]."""
    max_position_std_m: Deviation | None = omit()
    """Rows whose horizontal position has a larger standard deviation (DRMS) are masked; default: no limit [m]."""
    windows: list[TimeWindow] = omit([])
    """Spans of runs that are kept or dropped, as {run = "farm_*", action = "drop", start = 0, end = 30}."""


@dataclass(frozen=True, slots=True)
class SegmentConfig(_Section):
    """How the track is cut."""

    chord_m: Annotated[float, Bounds(ge=0.05, le=1000)] = 1.0
    """d: straight-line length of a segment in the horizontal plane [m]."""
    max_arc_to_chord: ArcToChord = 1.02
    """Largest arc over chord of a segment; more curved ones are excluded (radius below 1.5 m for 1 m)."""


@dataclass(frozen=True, slots=True)
class LabelConfig(_Section):
    """How labels are computed."""

    velocity: Literal["ground", "fused"] = "ground"
    """Velocity used as label: ground is chord / duration; fused is the mean fused forward velocity (the paper's v*)."""
    integration: Literal["exact", "right_endpoint"] = "exact"
    """exact integrates the product of two piecewise-linear signals; right_endpoint is the paper's sum."""
    flag_arc_to_chord: ArcToChord = 1.01
    """A segment more curved than this is flagged."""
    flag_position_std_m: Deviation = 0.10
    """A segment with an end whose absolute position is less certain than this is flagged weak_gnss [m]."""
    power_gain_std_fraction: Fraction | None = omit()
    """σ of the power sensor's gain; default: from the power source."""
    power_offset_std_amp: Annotated[float, Bounds(ge=0, le=1e4)] | None = omit()
    """σ of the zero of each rail's current; default: from the power source and the current at rest [A]."""


@dataclass(frozen=True, slots=True)
class SampleConfig(_Section):
    """How a patch is taken from a map."""

    patch_m: Annotated[float, Bounds(ge=0.05, le=100)] = 1.0
    """Side of the patch on the ground [m]."""
    patch_px: Annotated[int, Bounds(ge=2, le=1024)] = 40
    """Side of the patch in pixels; its pixel size is patch_m / patch_px, independent of the map."""
    min_valid_fraction: Fraction = 1.0
    """Smallest share of valid pixels of a patch."""
    max_position_std_m: Deviation = 0.10
    """Largest standard deviation of the absolute position of a sample [m]."""
    align: bool = False
    """Whether each run is shifted so that its heights fit the map's ground; its σ counts in max_position_std_m."""


@dataclass(frozen=True, slots=True)
class SplitConfig(_Section):
    """How samples are split into train and test."""

    holdout: Literal["block", "sample", "run", "tag"] = "block"
    """Unit held out for test: block (spatial), sample (random, as in the paper), run, or tag (runs by tag value)."""
    holdout_tag: str = ""
    """With the holdout tag: which tag, for example season."""
    test_fraction: Annotated[float, Bounds(ge=0, lt=1)] = 0.2
    """Share of test among the samples inside the region."""
    block_m: Annotated[float, Bounds(ge=0.1, le=1e6)] = 10.0
    """Side of a spatial block [m]."""
    buffer_m: Annotated[float, Bounds(ge=0, le=1e6)] | None = None
    """A footprint nearer than this to the border of a region is in no split; default: sqrt(2) times the chord [m]."""
    folds: Annotated[int, Bounds(ge=2, le=100)] = 5
    """Cross-validation folds of train and test; a fold has whole blocks, or whole runs (or tags) with that holdout."""
    seed: Annotated[int, Bounds(ge=0, le=2**32 - 1)] = 0
    """Seed of the split and of the row order."""


@dataclass(frozen=True, slots=True)
class CovariateConfig(_Section):
    """How tables of weather, soil or snow are joined to samples by time (`tcpipe build-dataset --covariates FILE`)."""

    time_column: str | None = None
    """Column of stamps; default: the only one named time, stamp, timestamp, date or datetime, a unit may follow."""
    time_unit: Literal["auto", "s", "ms", "us", "ns"] = "auto"
    """Unit of numeric stamps since 1970: auto uses the name's ending, or the unit that gives dates of this century."""
    max_age_s: Annotated[float, Bounds(ge=1e-3, le=1e9)] = 7200.0
    """Each sample uses the last row before its start; largest age of this row [s]."""

    def __post_init__(self) -> None:
        validate_fields(self, "covariates")


@dataclass(frozen=True, slots=True)
class TrainConfig(_Section):
    """Settings of `tcpipe train`; its options override them."""

    epochs: Annotated[int, Bounds(ge=1, le=100_000)] = 100
    """ResNet-18: most epochs."""
    patience: Annotated[int, Bounds(ge=1, le=100_000)] = 12
    """ResNet-18: epochs without a better held-out loss."""
    batch_size: Annotated[int, Bounds(ge=1, le=65_536)] = 64
    """ResNet-18."""
    learning_rate: Annotated[float, Bounds(gt=0, le=1)] = 1e-4
    """ResNet-18."""
    width: Annotated[int, Bounds(ge=16, le=512)] = 64
    """ResNet-18: filters of the first stage, a multiple of 16."""
    mirror: bool = True
    """ResNet-18: mirror every other patch."""
    trees: Annotated[int, Bounds(ge=1, le=10_000)] = 150
    """Boosting: most trees of an output."""
    tree_learning_rate: Annotated[float, Bounds(gt=0, le=1)] = 0.1
    """Boosting (LightGBM)."""
    tree_leaves: Annotated[int, Bounds(ge=2, le=4096)] = 15
    """Boosting: num_leaves."""
    tree_depth: Annotated[int, Bounds(ge=1, le=63)] = 6
    """Boosting: max_depth."""
    leaf_samples: Annotated[int, Bounds(ge=1, le=1_000_000)] = 10
    """Boosting: min_data_in_leaf."""


@dataclass(frozen=True, slots=True)
class DatasetConfig(_Section):
    """Description of the dataset."""

    name: str = "terrain-cost"
    """Name in the card."""
    description: str = ""
    """Description in the card."""
    licence: str = ""
    """Licence of the data (SPDX identifier)."""
    creator: str = ""
    """Creator of the dataset."""
    compression: Literal["zstd", "lz4"] = "zstd"
    """Compression of patches in Zarr: zstd is smaller, lz4 is two to three times as fast to read."""


@dataclass(frozen=True, slots=True)
class TableMapping:
    """A table in a folder of CSV, text or Parquet files: its role, columns, units and stamps."""

    file: str = ""
    """File name, relative to the ingested folder; a * (imu_*.csv) stands for the number of a run."""
    role: Role | None = None
    """Role of the table; default: its name. Power may have several tables."""
    columns: dict[str, str] = field(default_factory=dict)
    """Column by field (latitude, linear_x, …: docs/how-to/tables.md), or an expression, as "(velL + velR) / 2"."""
    units: dict[str, str] = field(default_factory=dict)
    """Units by field: "km/h", "mV", …; default: from the column's name, else deg, m, m/s, rad/s, m/s2, V, A, W, J."""
    nominal_voltage_volt: Volt | None = omit()
    """Assumed voltage of a current [V]."""
    nominal_voltage_std_fraction: Share = omit(NOMINAL_STD_FRACTION)
    """Its σ, as a fraction: one error of a run."""
    stamp: str | None = None
    """Column of the stamps; default: the first."""
    stamp_unit: Literal["auto", "s", "ms", "us", "ns", "ms_today"] = "auto"
    """Unit of numeric stamps; auto infers it from their size (from 1970) or name. ms_today counts from midnight."""
    stamp_format: str = omit("")
    """Format of stamps that are text, as "%d.%m.%Y %H:%M:%S%.f"; "": one of the usual."""
    stamp_zone: str = omit("")
    """Time zone of stamps without one, as "Europe/Vienna" or "UTC"; also of the tables that state none."""
    stamp_date: str = omit("")
    """Date of times of day: a column, or as "2025-07-09"; "": of the file's name, else its last change, with a note."""
    stamp_utc: str = omit("")
    """Column of UTC, also in whole seconds: the stamps of a faster clock are shifted onto it by one constant."""
    offset_s: Offset = 0.0
    """Added to the stamps [s]."""

    def make_power_source(self, name: str) -> PowerSource | None:
        """Return the power source of a table of power or energy, or with a nominal voltage; None for others."""
        if (self.role or name) != "power" or (
            self.nominal_voltage_volt is None and not {"power", "energy"} & set(self.columns)
        ):
            return None
        return PowerSource(
            TABLE_POWER,
            **{
                quantity: quantity for quantity in ("voltage", "current", "power", "energy") if quantity in self.columns
            },  # type: ignore[arg-type]
            topic=f"/{name}",
            sign="drawn_positive" if "energy" in self.columns else "auto",
            nominal_voltage_volt=self.nominal_voltage_volt,
            nominal_voltage_std_fraction=self.nominal_voltage_std_fraction,
        )


@dataclass(frozen=True, slots=True)
class IngestSections:
    """Sections of a recipe that decide a run's files, with its log and robot; `recipe_id` is their hash."""

    read: ReadConfig
    fuse: FuseConfig
    mask: MaskConfig
    segment: SegmentConfig
    label: LabelConfig
    robots: dict[str, Robot] = omit({})
    power_sources: list[PowerSource] = omit([])
    tables: dict[str, TableMapping] = omit({})


@dataclass(frozen=True, slots=True)
class Recipe:
    """All keys of tcpipe.toml."""

    robot: str | None = None
    """Robot profile; default: found by message types and topic names."""
    read: ReadConfig = field(default_factory=ReadConfig)
    fuse: FuseConfig = field(default_factory=FuseConfig)
    mask: MaskConfig = field(default_factory=MaskConfig)
    segment: SegmentConfig = field(default_factory=SegmentConfig)
    label: LabelConfig = field(default_factory=LabelConfig)
    sample: SampleConfig = field(default_factory=SampleConfig)
    split: SplitConfig = field(default_factory=SplitConfig)
    covariates: CovariateConfig = field(default_factory=CovariateConfig)
    dataset: DatasetConfig = field(default_factory=DatasetConfig)
    train: TrainConfig = field(default_factory=TrainConfig)
    robots: dict[str, Robot] = omit({})
    """Your own robot profiles by name; a profile with a built-in name replaces the built-in one."""
    power_sources: list[PowerSource] = omit([])
    """Power sources of your own message types, one table per rail; they replace the built-in ones of the same type."""
    tables: dict[str, TableMapping] = omit({})
    """Tables of a log that is a folder of CSV, text or Parquet files, by role or by any name."""

    def __post_init__(self) -> None:
        validate_fields(self, "")

    @property
    def ingest(self) -> IngestSections:
        """The sections that determine a run's files."""
        return IngestSections(
            self.read, self.fuse, self.mask, self.segment, self.label, self.robots, self.power_sources, self.tables
        )
