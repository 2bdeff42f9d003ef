"""Bits of ``dropped_by`` (track rows) and ``quality`` (segments), entries of the distance breakdown; released bits keep their value."""

from __future__ import annotations

from enum import IntFlag


def flag_name(bit: IntFlag) -> str:
    """Return a flag's name as files and pages have it."""
    return str(bit.name).lower()


def flag_names(bits: int, flags: type[IntFlag]) -> tuple[str, ...]:
    """Return the names of the set flags of a number, in order."""
    return tuple(flag_name(bit) for bit in flags if int(bits) & bit)


class DropReason(IntFlag):
    """Why a row of the track is not used; 0 means kept. Order is precedence in the loss ledger."""

    GAP = 1 << 0
    """No usable motion or power estimate: sensor gap, power gap, clock epoch, a jump, or relative position error too large."""
    STANDING = 1 << 1
    """|v| < 0.05 m/s and |yaw rate| < 0.05 rad/s."""
    STUCK = 1 << 2
    """The wheels turn but the ground speed is about zero."""
    TURNING_IN_PLACE = 1 << 3
    """|v| < 0.10 m/s and |yaw rate| > 0.10 rad/s for 0.2 s, or a turn radius below 0.5 m."""
    REVERSING = 1 << 4
    """Driving backwards."""
    ACCELERATING = 1 << 5
    """A commanded change of speed (2 s after it), or, without commands, |dv/dt| > 0.3 m/s² for 0.2 s; start and stop ramps."""
    BELOW_LIMIT = 1 << 6
    """Commanded below 0.95 of the robot's maximum: the speed is not the terrain's limit."""


class Quality(IntFlag):
    """What a user may want to know of a label; 0 means clean."""

    LOW_POWER_RATE = 1 << 0
    """Current sampled below 10 Hz (instantaneous) or 2 Hz (averaged by the source), or a voltage that varies by 2 %."""
    NEAR_GAP = 1 << 1
    """A gap begins or ends within one chord of the segment."""
    HIGH_SLIP = 1 << 2
    """Wheel speed and ground speed differ by more than 20 %."""
    WEAK_GNSS = 1 << 3
    """Deviation of the horizontal position (DRMS, `position_std_m`) above `label.flag_position_std_m` at either end."""
    CURVED = 1 << 4
    """Arc over chord above 1.01."""
    MEAN_POWER_DIFFERS = 1 << 5
    """The plain mean of the power samples differs from energy / duration by more than 5 %."""
    NO_COMMAND = 1 << 6
    """No command topic: it cannot be known whether the robot was driven at its maximum."""
    VOLTAGE_OUT_OF_RANGE = 1 << 7
    """The voltage leaves the range of the robot profile."""
    CLOCK_DOUBTFUL = 1 << 8
    """A clock of the segment's run stepped, drifts or seems off (an IMU's by more than 0.15 s), or the recorder's time had to be used."""
    PHYSICS_OUTLIER = 1 << 9
    """The power is more than four robust standard deviations from what physics, fitted on the run, predicts."""
    NOT_AT_LIMIT = 1 << 10
    """Commanded on average below `full_speed_fraction` of the robot's maximum: the speed is not the terrain's limit."""
    SENSORS_DISAGREE = 1 << 11
    """A sensor says another position, way or turn there than the track, beyond what both claim, and nothing tells which is right."""


class Loss(IntFlag):
    """Entries of the loss ledger beyond the bits of `DropReason`: metres that are no kept row's fault."""

    CURVED = 1 << 16
    """Arc over chord above 1.02: cut, but not straight enough to be a segment."""
    LEFTOVER = 1 << 17
    """The end of a steady stretch, shorter than a chord."""
    OUTSIDE_MAP = 1 << 18
    """The patch leaves every map."""
    NODATA = 1 << 19
    """A pixel of the patch, or one of its taps, has no data."""
    NOT_TRAVERSABLE = 1 << 20
    """The class under the chord is not traversable."""
    POSITION_UNCERTAIN = 1 << 21
    """Absolute position standard deviation above `sample.max_position_std_m` when sampling."""
    SPLIT_BUFFER = 1 << 22
    """The footprint straddles, or is nearer than the buffer to, a region's border."""
    NO_POWER = 1 << 23
    """A segment without a label: the run has no power source, or none over this stretch."""
    SPLIT_EXCLUDED = 1 << 24
    """The footprint lies in a region whose `split` is `exclude`."""
    RECORDED_TWICE = 1 << 25
    """Another run of the dataset has the same stretch of the same drive."""
