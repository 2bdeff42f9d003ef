"""Facts that each stage records; the manifest of a run has all of them, under the same names.

Counts and metres are by role, by reason or by entry of the distance breakdown. A number that is None is unknown.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

from tcpipe.tables.findings import StageReport, omit


@dataclass(frozen=True, slots=True)
class TopicClock:
    """Source of a topic's stamps, its reason, median header minus log time, and correction by clock epoch [s]."""

    source: str
    why: str
    offset_s: float | None
    moved_s: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class TopicFacts:
    """Messages and rows of a topic, counts of dropped messages by reason, and of unusable values inside used rows."""

    type: str
    messages: int
    rows: int
    rate_hz: float | None
    dropped: Mapping[str, int]
    notes: Mapping[str, int]
    time: TopicClock


@dataclass(frozen=True, slots=True)
class ClockStep:
    """A step of header minus log time: its log time [ns], size [s] and topics; without topics a step of all clocks."""

    log_time_ns: int
    step_s: float
    topics: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class PowerSign:
    """Sign of a drawn current and its source; whether the power source averages over its message period.

    ``includes``: known loads other than the drives (computers, payload). ``gain_std_fraction``, ``offset_std_amp``: σ
    of gain and zero of a sensor of this kind. ``rest_current_amp``: possible currents of a rail of it at rest, None if
    unknown. ``zero_amp``: zero of each current that the recipe states [A]. ``charging``: something charges the battery.
    """

    current_sign: str
    averaged: bool
    includes: tuple[str, ...] = omit(())
    gain_std_fraction: float | None = omit()
    offset_std_amp: float | None = omit()
    rest_current_amp: tuple[float, float] | None = omit()
    zero_amp: float = omit(0.0)
    charging: bool = omit(False)
    charge_ratio: float | None = omit()
    """Integral of the current over the fall of the battery's charge."""
    meter_slope: float | None = omit()
    """Slope of a second meter's power over the power."""
    side_share: float | None = omit()
    """Share of one side in the current in straight driving; 0.5 where both sides draw the same."""


@dataclass(frozen=True, slots=True)
class GateReset:
    """Gate reset of fixes: rejected since ``start_ns``, accepted again at ``end_ns``, ``size`` off the track [m]."""

    start_ns: int
    end_ns: int
    size: float


FIX_ERRORS = frozenset({"noise", "slow", "step"})
"""Kinds of changes that only increase the errors of fixes."""


@dataclass(frozen=True, slots=True)
class ChangeFacts:
    """Change that explains a contradiction: kind (``varies`` or of `stages.fuse_findings.CHANGES`), sensor and span.

    ``size``: in the unit of the changed quantity; 0 if unknown.
    """

    kind: str
    role: str
    start_ns: int
    end_ns: int
    size: float


@dataclass(frozen=True, slots=True)
class ParameterFacts:
    """Estimate of a parameter in a section: difference from its prior, with σ, and σ of the prior.

    ``variation``: RMS of its changes over the section.
    """

    value: tuple[float, ...]
    std: tuple[float, ...]
    prior_std: tuple[float, ...]
    variation: tuple[float, ...] = ()


@dataclass(frozen=True, slots=True)
class SectionFacts:
    """One section that was fused in one pass: counts and estimates of the filter, then its span and initial state.

    ``nis_mean`` is the normalised innovation squared over degrees of freedom, without rejected measurements.
    """

    nis_mean: Mapping[str, float | None]
    measurements: Mapping[str, int]
    rejected: Mapping[str, int]
    gate_resets: tuple[GateReset, ...] = omit(())
    common_scale_std: float | None = omit()
    """σ of the unobservable common odometry scale, included in σ of distances, speeds and labels."""
    changes: tuple[ChangeFacts, ...] = omit(())
    parameters: Mapping[str, ParameterFacts] = omit({})
    clock_epoch: int = 0
    start_ns: int = 0
    end_ns: int = 0
    rows: int = 0
    sensors: tuple[str, ...] = ()
    gyro_noise_radps: float | None = None
    heading_from: str = ""

    def is_explained(self, max_rejected_fraction: float, max_change_count: float) -> bool:
        """Return whether the estimate explains its sensors with few rejected measurements of each and few changes."""
        return self.count_changes() <= max_change_count and all(
            self.rejected[role] <= max_rejected_fraction * count for role, count in self.measurements.items()
        )

    def count_changes(self) -> int:
        """Return the number of changes that explain the sensors, without `FIX_ERRORS`, which only inflate σ."""
        return sum(each.kind not in FIX_ERRORS for each in self.changes)


@dataclass(frozen=True, slots=True)
class FuseFacts:
    """All sections, and each; ``set_aside``: counts by role, reason; ``skipped_s``: time with too few measurements."""

    rows: int
    sensors: tuple[str, ...]
    measurements: Mapping[str, int]
    rejected: Mapping[str, int]
    nis_mean: Mapping[str, float | None]
    set_aside: Mapping[str, Mapping[str, int]]
    skipped_s: float
    sections: tuple[SectionFacts, ...]

    @property
    def longest(self) -> SectionFacts:
        """The longest section."""
        return max(self.sections, key=lambda section: section.end_ns - section.start_ns)


@dataclass(frozen=True, slots=True)
class SensorChecks:
    """The codes of the findings on excluded sensors, by role."""

    excluded: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class ClockPair:
    """Comparison of two sensors: method, delay of the first's stamps against the second's, explained share (0 to 1).

    ``determined``: whether the offset is known well enough to report; ``from_middle_s``: its time, from the middle of
    the run.
    """

    late: str
    against: str
    by: str
    offset_s: float
    std_s: float
    explained: float
    determined: bool
    from_middle_s: float = 0.0


@dataclass(frozen=True, slots=True)
class ClockOffset:
    """Delay of a sensor's stamps against the reference in the middle of the run, and its drift; 0 if not certain.

    ``is_significant``: a person should act on it. ``is_wrong``: this clock is wrong, since two others agree with each
    other and differ from it; if False, this clock and the reference differ, and it is unknown which is wrong.
    """

    offset_s: float
    std_s: float
    is_significant: bool
    is_wrong: bool = True
    drift_ppm: float = 0.0


@dataclass(frozen=True, slots=True)
class ClockFacts:
    """Sensor clocks in one clock epoch before correction: all pairs, and offsets of those linked to the reference."""

    clock_epoch: int
    reference: str
    pairs: tuple[ClockPair, ...]
    offsets: Mapping[str, ClockOffset]


@dataclass(frozen=True, slots=True)
class MaskFacts:
    """Rows kept, masked by reason, and in a gap by cause; the robot's maximum speed, and the least that counts so."""

    rows: int
    rows_kept: int
    gap_rows: Mapping[str, int]
    rows_dropped: Mapping[str, int]
    max_velocity_mps: float | None
    full_speed_mps: float | None


@dataclass(frozen=True, slots=True)
class SegmentFacts:
    """Counts of segments and of steady sections; length of the track, and its time by reason."""

    segments: int
    sections: int
    odometer_m: float
    duration_by_reason_s: Mapping[str, float]


CAUSES = ("position", "rate", "current", "voltage")
"""Displacement of both ends; the current between samples; noise and rounding of the current; those of the voltage."""


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
    """The total with power at 20 Hz."""
    common: float
    """The error that all segments of a run share, which is not part of the total."""
    delay: float | None = omit()
    """The error by the delay of power against motion, which is not part of the total."""


@dataclass(frozen=True, slots=True)
class Floor:
    """Repeatability of a label, in its unit: the standard deviation of one pass, with its 95 % interval."""

    pairs: int
    places: int
    """Number of blocks of ground that contain the pairs."""
    std: float
    std_low: float | None
    """None if there are too few places for an interval."""
    std_high: float | None
    share_of_variance: float
    """Share of the label's variance; a model can explain at most the rest."""


@dataclass(frozen=True, slots=True)
class HeldOut:
    """One held-out split against train; counts are of samples or of pairs of samples."""

    split: str
    """``test`` or ``unseen``."""
    samples: int
    """Samples in it."""
    overlapping_samples: int
    """Number of samples whose footprint shares ground with a train footprint."""
    overlapping_pairs: int
    """Pairs of footprints, one held out and one in train, that share ground."""
    same_track_pairs: int
    """Pairs that follow one another on one track, one held out and one in train."""
    repeated_place_samples: int
    """Those that share ground with a train footprint of another run."""
    nearest_train_min_m: float | None
    """Distance between the nearest footprints of the two splits [m]; None if one is empty."""
    nearest_train_median_m: float | None
    """Median over the held-out samples of the distance to the nearest train footprint [m]."""


@dataclass(frozen=True, slots=True)
class PhysicsTerm:
    """Coefficient, with σ, of P = idle + drivetrain v / cos(s) + rolling v + grade v tan(s) + turning |yaw rate|."""

    term: str
    """``idle``, ``drivetrain`` (motors and gears, paid on any grade), ``rolling``, ``grade`` or ``turning``."""
    terrain: str
    """The class of terrain, or ``all``."""
    value: float
    std: float
    unit: str


@dataclass(frozen=True, slots=True)
class PhysicsScore:
    """Accuracy of predicted energies per metre on held-out fifths of the drive."""

    r2: float
    """Share of their variance."""
    mape: float
    """Mean relative error of those of 10 J and more."""


@dataclass(frozen=True, slots=True)
class PhysicsFit:
    """Physics model of a robot's power: standing, drivetrain, rolling, grade and turning (`tcpipe.cost.physics`)."""

    segments: int
    terms: tuple[PhysicsTerm, ...]
    rolling_resistance: Mapping[str, tuple[float, float]]
    """Coefficient by class, with its standard deviation; empty if the slopes do not vary."""
    recovered_downhill: float
    residual_watt: float
    energy_share: Mapping[str, float]
    """Share of all energy by term."""
    held_out: PhysicsScore | None
    """None with too few segments to fit."""
    mean_turn_radpm: float
    """Mean turn per metre, both ways counted."""


@dataclass(frozen=True, slots=True)
class PhysicsFacts:
    """Idle power and physics model of a run (`tcpipe.cost.physics`); None if they cannot be determined."""

    idle_watt: float | None
    fit: PhysicsFit | None = omit()


@dataclass(frozen=True, slots=True)
class Smoothing:
    """Power values are means from ``before_s`` before the stamp to ``after_s`` after it, without the source's averaging."""

    before_s: float
    after_s: float

    @property
    def width_s(self) -> float:
        """Length of the mean of each value [s]."""
        return self.before_s + self.after_s

    @property
    def late_s(self) -> float:
        """Delay of the stamp after the middle of that time [s]."""
        return (self.before_s - self.after_s) / 2.0


@dataclass(frozen=True, slots=True)
class PowerSensorFacts:
    """Power sensor uncertainty: σ of its gain and of a rail's zero [A], and log observations (`tcpipe.power.audit`).

    ``rest_amp``: lowest and highest current of a rail in stops; ``battery_ohm``: resistance of the battery by its sag
    [ohm]; the gain changed by ``gain_ratio`` at ``gain_changed_ns``; ``lost_signs``: segments whose current flows back
    without a sign; ``smoothing``: None if power is not smoothed; ``delay_s``: of power behind the motion, with its σ;
    None if unobservable.
    """

    gain_std_fraction: float
    offset_std_amp: float
    rest_amp: tuple[float, float] | None = omit()
    battery_ohm: float | None = omit()
    gain_ratio: float | None = omit()
    gain_changed_ns: int | None = omit()
    lost_signs: int = 0
    smoothing: Smoothing | None = omit()
    delay_s: tuple[float, float] | None = omit()

    @property
    def unsettled_s(self) -> tuple[float, float]:
        """How long after a stop, and before a start, values still contain the power of driving [s]."""
        if self.smoothing is not None:
            return 2.0 * self.smoothing.before_s, self.smoothing.after_s  # a filter settles later than its mean
        delay_s = self.delay_s[0] if self.delay_s else 0.0
        return max(delay_s, 0.0), max(-delay_s, 0.0)


@dataclass(frozen=True, slots=True)
class LabelFacts:
    """The run's energy by entry of the distance breakdown, and uncertainty and flags of its labels."""

    distance_m: float
    energy_joule: float | None
    energy_by_entry_joule: Mapping[str, float] | None
    integration: str
    velocity: str
    segments: int
    segments_without_power: int
    median_power_watt: float | None
    relative_std_median: Mapping[str, float | None]
    energy_budget: EnergyBudget | None
    quality: Mapping[str, int]
    physics: PhysicsFacts
    power_sensor: PowerSensorFacts | None = omit()


@dataclass(frozen=True, slots=True)
class StageFacts:
    """The facts of a run: those of reading, and those of each later stage under its name."""

    roles: Mapping[str, Mapping[str, TopicFacts]] = field(default_factory=dict)
    """The topics of each role."""
    left_out: Mapping[str, str] = field(default_factory=dict)
    """By unused topic that fits a role: why it is unused."""
    epochs: int = 1
    clock_steps: tuple[ClockStep, ...] = ()
    time_offset_s: Mapping[str, float] = field(default_factory=dict)
    """Correction of a role's stamps by the recipe."""
    odometry_scale: Mapping[str, float] | None = field(default=None, metadata={"json": (None, {})})
    """Factor of a role's distances and velocities in the recipe."""
    power: PowerSign | None = omit()
    fuse: FuseFacts | None = omit()
    sensor_checks: SensorChecks | None = omit()
    clock_offsets: tuple[ClockFacts, ...] = omit(())
    """Time offsets between the sensors of each section, in order of clock epoch and time."""
    mask: MaskFacts | None = omit()
    segment: SegmentFacts | None = omit()
    label: LabelFacts | None = omit()


NOTHING_FOUND = StageReport((), StageFacts())
