"""What each stage noticed, as dataclasses: JSON holds them under the same names, in run.json those of reading, in manifest.json all.

Counts and metres are by the names of roles, of reasons or of the ledger's entries. A number that is None is not known.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from tcpipe.tables.findings import LEFT_OUT as LEFT_OUT  # noqa: PLC0414  facts are documents, too
from tcpipe.tables.findings import StageReport

ABSENT: Mapping[str, tuple[object, ...]] = {"json": (None,)}
"""Metadata of a field which, while it is None, is no key of the JSON object."""

Vector = tuple[float, float, float]


def make_vector(values: NDArray[np.float64]) -> Vector:
    """Return the three values of an array."""
    x, y, z = values.tolist()
    return x, y, z


@dataclass(frozen=True, slots=True)
class RobotChoice:
    """Which robot profile rules, and why."""

    name: str
    why: str


@dataclass(frozen=True, slots=True)
class TopicClock:
    """Which stamp of a topic is used and the reason, the median of header minus log time, and what was added to its stamps by epoch [s]."""

    source: str
    why: str
    offset_s: float | None
    moved_s: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class TopicFacts:
    """What became of a topic's messages: rows, and by reason what was dropped and what was set aside inside used rows."""

    type: str
    messages: int
    rows: int
    rate_hz: float | None
    dropped: Mapping[str, int]
    notes: Mapping[str, int]
    time: TopicClock


@dataclass(frozen=True, slots=True)
class RoleFacts:
    """Why a role went to its topics, and the frame of its sensor and what placed that."""

    why: str
    frame: str
    placed_by: str
    topics: Mapping[str, TopicFacts]


@dataclass(frozen=True, slots=True)
class ClockStep:
    """A step of header minus log time: at which log time [ns], how far [s], and on which topics."""

    log_time_ns: int
    step_s: float
    topics: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class PowerSign:
    """Which sign a drawn current has and what tells it; whether the source averages over its message period.

    ``includes``: what the currents feed besides the drives, as far as the tables of power messages know (computers, payload).
    """

    current_sign: str
    averaged: bool
    includes: tuple[str, ...] = field(default=(), metadata=LEFT_OUT)


@dataclass(frozen=True, slots=True)
class GateReset:
    """A sensor that its gate had refused since ``start_ns`` was heard again at ``end_ns``: it was off by ``size`` [m] or [m/s]."""

    role: str
    start_ns: int
    end_ns: int
    size: float


@dataclass(frozen=True, slots=True)
class StretchFacts:
    """One stretch that was fused for itself: what the filter counted and settled on, and then where the stretch lies and began.

    ``nis_mean`` is the normalised innovation squared over degrees of freedom, refused measurements left out; ``reopened`` and all from
    ``events`` on are the error-state filter's, ``recovered`` is the 15-state filter's.
    """

    nis_mean: Mapping[str, float | None]
    measurements: Mapping[str, int]
    rejected: Mapping[str, int]
    covariance_repairs: int
    recovered: Mapping[str, int] | None = field(default=None, metadata=LEFT_OUT)
    reopened: Mapping[str, int] | None = field(default=None, metadata=LEFT_OUT)
    events: int | None = field(default=None, metadata=LEFT_OUT)
    zero_velocity_updates: int | None = field(default=None, metadata=LEFT_OUT)
    gnss_lasting_error_m: float | None = field(default=None, metadata=LEFT_OUT)
    gate_resets: tuple[GateReset, ...] = field(default=(), metadata=LEFT_OUT)
    gyro_bias_radps: Vector | None = None
    turn_scale: float | None = None
    accelerometer_bias_mps2: Vector | None = field(default=None, metadata=LEFT_OUT)
    wheel_scale: float | None = field(default=None, metadata=LEFT_OUT)
    wheel_scale_std: float | None = field(default=None, metadata=LEFT_OUT)
    visual_scale: float | None = field(default=None, metadata=LEFT_OUT)
    visual_scale_std: float | None = field(default=None, metadata=LEFT_OUT)
    common_scale_std: float | None = field(default=None, metadata=LEFT_OUT)
    """How long a metre is, as far as nothing tells: one error of all ways, speeds and their labels, within their deviations."""
    clock_epoch: int = 0
    start_ns: int = 0
    end_ns: int = 0
    rows: int = 0
    sensors: tuple[str, ...] = ()
    gyro_noise_radps: float | None = None
    accelerometer_noise_mps2: float | None = None
    initial_yaw_rad: float | None = None
    initial_yaw_std_rad: float | None = None
    heading_from: str = ""


@dataclass(frozen=True, slots=True)
class FuseFacts:
    """All stretches together, and each; ``set_aside`` counts by role and reason, ``skipped_s`` is time that holds too little to fuse."""

    rows: int
    sensors: tuple[str, ...]
    measurements: Mapping[str, int]
    rejected: Mapping[str, int]
    nis_mean: Mapping[str, float | None]
    set_aside: Mapping[str, Mapping[str, int]]
    skipped_s: float
    stretches: tuple[StretchFacts, ...]


@dataclass(frozen=True, slots=True)
class AxisFacts:
    """About which axis of the IMU another sensor turns, and how many times as fast."""

    axis: Vector
    scale: float


@dataclass(frozen=True, slots=True)
class SensorChecks:
    """What the sensors were held against, and the codes of the findings on those that are not fused.

    ``distance_m`` are median chords over ten seconds, ``up`` is gravity in the robot's axes, ``looks_rad`` the yaw of the IMU by each
    odometry and how sure it is, ``specific_force_median`` in the unit that the IMU tells.
    """

    excluded: Mapping[str, str] = field(default_factory=dict)
    distance_m: Mapping[str, float] | None = field(default=None, metadata=LEFT_OUT)
    specific_force_median: float | None = field(default=None, metadata=LEFT_OUT)
    up: Vector | None = field(default=None, metadata=LEFT_OUT)
    yaw_axis: Mapping[str, AxisFacts] | None = field(default=None, metadata=LEFT_OUT)
    looks_rad: Mapping[str, tuple[float, ...]] | None = field(default=None, metadata=LEFT_OUT)


@dataclass(frozen=True, slots=True)
class MountingFacts:
    """What was mended: by how much the antenna was moved in base_link, how well its place is known, roll and pitch of the IMU.

    ``odometry_scale`` is by odometry how many times as far as the track it went, which is taken out.
    """

    antenna_moved_m: Vector | None = field(default=None, metadata=LEFT_OUT)
    antenna_std_m: Vector | None = field(default=None, metadata=LEFT_OUT)
    imu_tilt_rad: tuple[float, float] | None = field(default=None, metadata=LEFT_OUT)
    odometry_scale: Mapping[str, float] | None = field(default=None, metadata=LEFT_OUT)


@dataclass(frozen=True, slots=True)
class Disagreement:
    """A time in which a sensor says other than the track, beyond what both claim (`tcpipe.fusion.checks.audit`).

    ``what`` is position, displacement or turn; ``size`` the largest difference over a window in ``unit`` (m or rad), and
    ``expected_std`` what it was expected to be there. ``alone``: two other sensors contradict this one, so the track is believed; otherwise
    its deviations are raised, and segments there carry the bit sensors_disagree.
    """

    start_ns: int
    end_ns: int
    sensor: str
    what: str
    size: float
    unit: str
    expected_std: float
    alone: bool
    clock_epoch: int = 0


@dataclass(frozen=True, slots=True)
class AuditFacts:
    """The estimate held against what fed it: where they disagree, and which sensors contradict each other in most of the way undecided."""

    disagreements: tuple[Disagreement, ...] = ()
    undecided: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class ClockPair:
    """Two sensors' clocks compared (`tcpipe.fusion.checks.clock_offsets.Pair`), and whether that tells their offset."""

    late: str
    against: str
    by: str
    offset_s: float | None
    std_s: float | None
    explained: float | None
    drift_s_per_h: float | None
    drift_std_s_per_h: float | None
    windows: tuple[Vector, ...]
    determined: bool


@dataclass(frozen=True, slots=True)
class ClockOffset:
    """How late a sensor's stamps are (`tcpipe.fusion.checks.clock_offsets.RoleOffset`).

    Where it is not ``blamed``, only that it and the reference differ is known.
    """

    offset_s: float | None
    std_s: float | None
    noted: bool
    drift_s_per_h: float | None
    drift_std_s_per_h: float | None
    drifts: bool
    blamed: bool = True


@dataclass(frozen=True, slots=True)
class ClockFacts:
    """The sensors' clocks in one epoch: all pairs compared, and by role each one's offset from the reference.

    ``position_offset_s`` times the velocity is in the track's position deviations: by so much the fixes' clock may be off [s]. So is
    ``heading_offset_s`` times the yaw rate, over a metre: the IMU's clock is off by that, and labels rest on the others'.
    """

    clock_epoch: int
    reference: str
    pairs: tuple[ClockPair, ...]
    offsets: Mapping[str, ClockOffset]
    position_offset_s: float | None = field(default=None, metadata=LEFT_OUT)
    heading_offset_s: float | None = field(default=None, metadata=LEFT_OUT)


@dataclass(frozen=True, slots=True)
class MaskFacts:
    """Rows kept, by reason dropped, and by cause in a gap; the speed that is the robot's limit, and from which on it drives at that."""

    rows: int
    rows_kept: int
    gap_rows: Mapping[str, int]
    rows_dropped: Mapping[str, int]
    max_velocity_mps: float | None
    full_speed_mps: float | None


@dataclass(frozen=True, slots=True)
class SegmentFacts:
    """How many segments were cut from how many steady stretches; the track's length, and its time by ledger entry."""

    segments: int
    stretches: int
    odometer_m: float
    duration_by_reason_s: Mapping[str, float]


@dataclass(frozen=True, slots=True)
class SignalFacts:
    """Samples of a voltage [V] or a current [A], their rate, and the step in which they are told."""

    samples: int
    rate_hz: float | None
    resolution: float | None


@dataclass(frozen=True, slots=True)
class RailFacts:
    """The record of one rail in one clock epoch."""

    name: str
    voltage: SignalFacts
    current: SignalFacts


@dataclass(frozen=True, slots=True)
class EnergyBudget:
    """The noise floor of E over some segments: shares of the mean energy, root mean square over the segments [1]."""

    segments: int
    """Segments with an energy."""
    mean_energy_joule: float
    """Mean of its absolute value [J]."""
    total: float
    """All `CAUSES` together."""
    position: float
    rate: float
    current: float
    voltage: float
    at_20_hz: float
    """What power at 20 Hz would leave of the total."""


@dataclass(frozen=True, slots=True)
class PhysicsTerm:
    """A coefficient of P = standing + drivetrain v / cos(s) + rolling v + grade v tan(s) + turning |yaw rate|, with its deviation."""

    term: str
    """``standing``, ``drivetrain`` (motors and gears, paid on any grade), ``rolling``, ``grade`` or ``turning``."""
    terrain: str
    """The class of terrain, or ``all``."""
    value: float
    std: float
    unit: str


@dataclass(frozen=True, slots=True)
class PhysicsScore:
    """How well energies a metre are predicted on fifths of the drive that were held out."""

    r2: float
    """Share of their variance."""
    mape: float
    """Mean relative error of those of 10 J and more."""


@dataclass(frozen=True, slots=True)
class PhysicsFit:
    """What standing, drivetrain, rolling, grade and turning take of a robot's power (`tcpipe.cost.physics`)."""

    segments: int
    terms: tuple[PhysicsTerm, ...]
    rolling_resistance: Mapping[str, tuple[float, float]]
    """Coefficient by class, with its standard deviation; empty where the slopes do not vary."""
    recovered_downhill: float
    residual_watt: float
    energy_share: Mapping[str, float]
    """Share of all energy by term; grade takes nearly none where as much is driven up as down."""
    held_out: PhysicsScore | None
    """None where too few segments are left to fit."""
    without_turning: PhysicsScore | None
    mean_turn_radpm: float
    """What a metre of the segments turns, both ways counted."""
    gain_of_turning: tuple[float, float] | None
    """By how much turning raises the held-out R²: 90 % interval over blocks of segments."""


@dataclass(frozen=True, slots=True)
class PhysicsFacts:
    """What physics explains of a run (`tcpipe.cost.physics`); where it could not be fitted, what is drawn while standing."""

    fitted: bool
    idle_watt: float | None
    weight_over_efficiency_newton: float | None = None
    rolling_resistance: float | None = None
    rolling_newton: float | None = field(default=None, metadata=LEFT_OUT)
    recovered_downhill: float | None = field(default=None, metadata=LEFT_OUT)
    residual_watt: float | None = field(default=None, metadata=LEFT_OUT)
    segments: int | None = field(default=None, metadata=LEFT_OUT)
    outliers: int | None = field(default=None, metadata=LEFT_OUT)
    fit: PhysicsFit | None = field(default=None, metadata=LEFT_OUT)


@dataclass(frozen=True, slots=True)
class LabelFacts:
    """The run's whole energy and where it went, the record of its power by epoch, and how sure and how clean its labels are."""

    distance_m: float
    energy_joule: float | None
    energy_by_entry_joule: Mapping[str, float] | None
    integration: str
    velocity: str
    rails: Mapping[str, tuple[RailFacts, ...]]
    segments: int
    segments_without_power: int
    median_power_watt: float | None
    relative_std_median: Mapping[str, float | None]
    energy_budget: EnergyBudget | None
    quality: Mapping[str, int]
    physics: PhysicsFacts


@dataclass(frozen=True, slots=True)
class StageFacts:
    """The facts of a run: those of reading, and under its name those of each stage that it has come through."""

    robot: RobotChoice | None = None
    roles: Mapping[str, RoleFacts] = field(default_factory=dict)
    left_out: Mapping[str, str] = field(default_factory=dict)
    """Why topics that could play a role do not."""
    epochs: int = 1
    clock_steps: tuple[ClockStep, ...] = ()
    time_offset_s: Mapping[str, float] = field(default_factory=dict)
    """What the recipe adds to a role's stamps."""
    odometry_scale: Mapping[str, float] | None = field(default=None, metadata=LEFT_OUT)
    """What the recipe multiplies a role's ways and velocities with."""
    power: PowerSign | None = field(default=None, metadata=LEFT_OUT)
    fuse: FuseFacts | None = field(default=None, metadata=LEFT_OUT)
    sensor_checks: SensorChecks | None = field(default=None, metadata=LEFT_OUT)
    mounting: MountingFacts | None = field(default=None, metadata=LEFT_OUT)
    audit: AuditFacts | None = field(default=None, metadata=LEFT_OUT)
    clock_offsets: ClockFacts | None = field(default=None, metadata=LEFT_OUT)
    mask: MaskFacts | None = field(default=None, metadata=LEFT_OUT)
    segment: SegmentFacts | None = field(default=None, metadata=LEFT_OUT)
    label: LabelFacts | None = field(default=None, metadata=LEFT_OUT)


NOTHING_FOUND = StageReport((), StageFacts())
