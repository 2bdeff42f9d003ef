"""Bits of ``dropped_by`` (track rows) and ``quality`` (segments), entries of the distance breakdown; values stay."""

from enum import IntFlag


def flag_name(bit: IntFlag) -> str:
    """Return a flag's name as files and pages have it."""
    return str(bit.name).lower()


def flag_names(bits: int, flags: type[IntFlag]) -> tuple[str, ...]:
    """Return the names of the set flags of a number, in order."""
    return tuple(flag_name(bit) for bit in flags if int(bits) & bit)


class DropReason(IntFlag):
    """Why a row of the track is not used; 0 means kept. The order is the precedence in the distance breakdown."""

    GAP = 1 << 0
    """No usable motion or power: sensor gap, power gap, clock epoch, jump, or too large relative position error."""
    STATIONARY = 1 << 1
    """|v| < 0.05 m/s and |yaw rate| < 0.05 rad/s."""
    STUCK = 1 << 2
    """The wheels turn but the ground speed is about zero."""
    TURNING_IN_PLACE = 1 << 3
    """|v| < 0.10 m/s and |yaw rate| > 0.10 rad/s for 0.2 s, or a turn radius below 0.5 m."""
    REVERSING = 1 << 4
    """Driving backwards."""
    ACCELERATING = 1 << 5
    """Commanded change of speed (and 2 s after it), else |dv/dt| > 0.3 m/s² for 0.2 s; start and stop ramps."""
    BELOW_FULL_SPEED = 1 << 6
    """Commanded below 0.95 of the robot's maximum: the terrain does not limit the speed."""
    TIME_WINDOW = 1 << 7
    """Outside the time windows of the recipe (`mask.windows`); no other reason counts there."""
    POSITION_UNCERTAIN = 1 << 8
    """Standard deviation of the horizontal position (DRMS) above `mask.max_position_std_m`; off without a limit."""


class Quality(IntFlag):
    """Limitations of a label; 0 means none."""

    LOW_POWER_RATE = 1 << 0
    """Current sampled below 10 Hz (instantaneous) or 2 Hz (averaged by the source), or a voltage that varies by 2 %."""
    NEAR_GAP = 1 << 1
    """A gap begins or ends within one chord of the segment."""
    HIGH_SLIP = 1 << 2
    """Wheel speed and ground speed differ by more than 20 %."""
    WEAK_GNSS = 1 << 3
    """Standard deviation of the horizontal position (DRMS) above `label.flag_position_std_m` at either end."""
    CURVED = 1 << 4
    """Arc over chord above 1.01."""
    POWER_MEAN_MISMATCH = 1 << 5
    """The plain mean of the power samples differs from energy / duration by more than 5 %."""
    NO_COMMAND = 1 << 6
    """No command is known: it is unknown whether the robot was driven at its maximum speed."""
    VOLTAGE_OUT_OF_RANGE = 1 << 7
    """The voltage leaves the range of the robot profile."""
    CLOCK_DOUBTFUL = 1 << 8
    """A clock of the run stepped, two clocks differ, or log time replaces the stamps."""
    # 1 << 9 is unassigned.
    BELOW_FULL_SPEED = 1 << 10
    """Commanded on average below `full_speed_fraction` of the robot's maximum: the terrain does not limit the speed."""
    SENSORS_DISAGREE = 1 << 11
    """The track contradicted the fixes for seconds, or does not explain its sensors."""
    UNPOWERED = 1 << 12
    """The robot moves with its idle power over several segments, though their speed and slope need clearly more."""
    MAP_CONTRADICTS_TRACK = 1 << 13
    """Samples only: slope, cross slope or heights of the patch differ from the track (`map-contradicts-track`)."""


class Loss(IntFlag):
    """Entries of the distance breakdown beyond the bits of `DropReason`: losses after the mask."""

    CURVED = 1 << 16
    """Arc over chord above 1.02: cut, but not straight enough to be a segment."""
    LEFTOVER = 1 << 17
    """The end of a steady section, shorter than a chord."""
    OUTSIDE_MAP = 1 << 18
    """The patch leaves every map."""
    NODATA = 1 << 19
    """A pixel of the patch, or one of its taps, has no data."""
    NOT_TRAVERSABLE = 1 << 20
    """The class under the chord is not traversable."""
    POSITION_UNCERTAIN = 1 << 21
    """Standard deviation of the horizontal position above `sample.max_position_std_m` when sampling."""
    SPLIT_BUFFER = 1 << 22
    """The footprint crosses the border of a region, or is nearer to it than the buffer."""
    NO_POWER = 1 << 23
    """A segment without a label: the run has no power source, or none over this segment."""
    SPLIT_EXCLUDED = 1 << 24
    """The footprint is in a region whose `split` is `exclude`."""
    RECORDED_TWICE = 1 << 25
    """Another run of the dataset has the same section of the same drive."""
    NO_LABEL = 1 << 27
    """A segment without a label that was asked for (``--labels``), but for the energy: that is `NO_POWER`."""
    NO_POSITION = 1 << 28
    """A segment without longitude and latitude, in a dataset without patches whose other runs have them."""
