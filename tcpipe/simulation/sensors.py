"""Simulated sensors: their measurements of the truth, and the times at which the recorder receives them.

A sensor samples at its own rate and phase. Its reading contains the time of measurement in the header, the time of
recording, and columns in SI units in the sensor's own frame. Each sensor and fault has a named random stream.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable
from dataclasses import dataclass, field, fields, replace
from functools import partial
from typing import Any, Literal

import numpy as np

from tcpipe.arrays import Floats, Ints, Mask, accumulate
from tcpipe.geometry.rotation import invert, multiply, quat_from_rotation_vector, quat_from_rpy, rotate, rpy_from_quat
from tcpipe.simulation.robot import GRAVITY_MPS2, make_correlated_noise
from tcpipe.simulation.truth import Truth
from tcpipe.simulation.world import Site

CLOCK_STEP_NS = 2_500_000_000
"""Size of the jump of header stamps with the fault ``clock_step``."""

Triple = tuple[float, float, float]
Values = dict[str, Any]
"""Arrays by name, one row a message."""


@dataclass(frozen=True, slots=True)
class Faults:
    """Switches of independent faults of sensors (own random streams); all off is a perfect set at base_link."""

    gnss_noise: bool = False  # position noise, most of it correlated in time
    gnss_lever_arm: bool = False  # the antenna is not at base_link
    gnss_outliers: bool = False  # multipath: some fixes are metres off, with the same covariance
    gnss_outage: bool = False  # no fix for ten seconds (half with status -1, half without messages)
    gnss_stamp_jitter: bool = False  # the stamp is not quite the time of measurement
    wheel_noise: bool = False  # white noise of speed and yaw rate
    wheel_scale: bool = False  # a wrong wheel radius, and a yaw rate that a skid-steered robot overstates
    wheel_slip: bool = False  # the wheels run faster than the ground passes
    imu_noise: bool = False  # white noise of gyroscope and accelerometer
    imu_bias: bool = False  # constant biases that wander
    imu_vibration: bool = False  # shaking while driving
    imu_mounting: bool = False  # the unit is turned, and not at base_link
    imu_yaw_offset: bool = False  # its orientation, where it gives one, has a magnetic yaw error
    visual_noise: bool = False  # white noise of the velocity
    visual_scale: bool = False  # a wrong scale
    visual_outliers: bool = False  # single frames that are far off
    visual_dropouts: bool = False  # spans without visual odometry
    power_noise: bool = False  # white noise and quantisation of voltage and currents
    power_gap: bool = False  # a span without power messages
    command_jitter: bool = False  # a joystick that is never still
    transport_delay: bool = False  # messages reach the recorder late, each by another time
    duplicates: bool = False  # some messages are recorded twice
    clock_step: bool = False  # in the middle all header stamps jump ahead for good, while the recorder's clock runs on
    gnss_clock_offset: bool = False  # the receiver's header stamps are late by a constant
    wheel_clock_offset: bool = False  # the wheels' header stamps are late by a constant
    imu_clock_offset: bool = False  # the inertial unit's header stamps are late by a constant
    visual_clock_offset: bool = False  # the camera's header stamps are late by a constant
    power_clock_offset: bool = False  # the header stamps of voltage and currents are late by a constant

    @classmethod
    def every(cls) -> Faults:
        """Return all faults switched on, except those of clocks, with which stamps differ from the truth."""
        return cls(**{field.name: "clock" not in field.name for field in fields(cls)})

    @classmethod
    def only(cls, *names: str) -> Faults:
        """Return the named faults switched on, all others off."""
        return cls(**dict.fromkeys(names, True))


@dataclass(frozen=True, slots=True)
class Reading:
    """Messages of one sensor, one a row."""

    stamp_ns: Ints
    log_time_ns: Ints
    values: Values


@dataclass(frozen=True, slots=True)
class Mounting:
    """base_link_from_sensor."""

    xyz_m: Triple = (0.0, 0.0, 0.0)
    rpy_rad: Triple = (0.0, 0.0, 0.0)

    def quat_xyzw(self) -> Floats:
        """Return base_link_from_sensor as a quaternion."""
        return quat_from_rpy(*self.rpy_rad)


@dataclass(frozen=True, slots=True)
class Gnss:
    """RTK receiver; its covariance is that of both parts of its noise."""

    rate_hz: float = 10.0
    std_m: float = 0.005  # white, east and north
    vertical_std_m: float = 0.0085
    lasting_std_m: tuple[float, float] = (0.008, 0.020)
    """Range of σ of the time-correlated part, east and north; each drive draws one. (0, 0): all noise is white."""
    lasts_s: tuple[float, float] = (5.0, 60.0)  # range of its correlation time, of which each drive draws one
    covariance: Literal["known", "unknown"] = "known"  # whether the message states its standard deviation
    mounting: Mounting = Mounting((0.1, 0.0, 0.9))
    stated_off_m: float = 0.05
    """Largest error of the position that the log states; each drive draws its direction."""
    outlier_share: float = 0.01
    outlier_m: float = 1.5
    outage_s: float = 10.0
    stamp_jitter_s: float = 0.002
    delay_s: float = 0.06
    clock_offset_s: float = 0.25


EXACT_GNSS = Gnss(std_m=0.015, vertical_std_m=0.025, lasting_std_m=(0.0, 0.0), stated_off_m=0.0)
"""White noise, and an antenna at the position that the log states: better than real receivers."""


@dataclass(frozen=True, slots=True)
class Doppler:
    """The receiver's own velocity: east, north, up of its antenna."""

    rate_hz: float = 10.0
    std_mps: float = 0.03  # white, east and north; twice that up
    lasting_std_mps: float = 0.04  # of the part that the receiver's filter and multipath make last
    lasts_s: float = 1.5
    mounting: Mounting = Mounting((0.1, 0.0, 0.9))
    delay_s: float = 0.06


@dataclass(frozen=True, slots=True)
class WheelOdometry:
    """Wheel odometry; its pose is its own dead reckoning."""

    rate_hz: float = 50.0
    std_mps: float = 0.03
    yaw_rate_std_radps: float = 0.02
    covariance: Literal["known", "unknown"] = "known"  # unknown: all zero in the message
    scale: float = 1.015
    yaw_scale: float = 1.08
    delay_s: float = 0.006
    clock_offset_s: float = 0.15


@dataclass(frozen=True, slots=True)
class Imu:
    """Inertial unit."""

    rate_hz: float = 100.0
    gyro_std_radps: float = 0.002
    accelerometer_std_mps2: float = 0.04
    gyro_bias_radps: float = 0.004
    accelerometer_bias_mps2: float = 0.06
    vibration_mps2: float = 0.25  # at full speed
    mounting: Mounting = Mounting((0.05, -0.1, 0.3), (np.pi, 0.0, np.pi / 2))
    orientation: bool = True
    yaw_offset_rad: float = 0.14
    orientation_std_rad: float = 0.01
    delay_s: float = 0.004
    clock_offset_s: float = -0.10


@dataclass(frozen=True, slots=True)
class Visual:
    """Visual odometry, in its own child frame."""

    rate_hz: float = 30.0
    says: Literal["twist", "pose"] = "twist"  # pose leaves the twist empty, as the ZED wrapper for ROS 1 does
    covariance: Literal["known", "unknown"] = "known"  # unknown: all zero in the message
    std_mps: float = 0.03
    yaw_rate_std_radps: float = 0.01
    scale: float = 0.97
    outlier_share: float = 0.004
    outlier_mps: float = 2.0
    dropout_s: float = 3.0
    mounting: Mounting = Mounting((0.32, 0.06, 0.42), (0.0, 0.1, 0.0))
    delay_s: float = 0.045
    clock_offset_s: float = 0.20


@dataclass(frozen=True, slots=True)
class Power:
    """Voltage and driver currents."""

    rate_hz: float = 20.0
    averaged: bool = False  # over the period that ends at the stamp, rather than sampled at it
    reading_hz: float | None = None
    """Rate at which the device is read; messages repeat its last value; None: it is read for every message."""
    voltage_std_volt: float = 0.02
    current_std_amp: float = 0.08
    voltage_step_volt: float = 0.01
    current_step_amp: float = 0.05
    gap_s: float = 1.5
    electronics_watt: float = 38.0  # power of computer and user ports, reported separately
    delay_s: float = 0.01
    clock_offset_s: float = 0.25


@dataclass(frozen=True, slots=True)
class Joystick:
    """The operator's joystick."""

    rate_hz: float = 20.0
    jitter: float = 0.012
    delay_s: float = 0.004


@dataclass(frozen=True, slots=True)
class Sensors:
    """The whole set; None leaves a sensor out."""

    gnss: Gnss | None = field(default_factory=Gnss)
    wheels: WheelOdometry | None = field(default_factory=WheelOdometry)
    imu: Imu | None = field(default_factory=Imu)
    visual: Visual | None = field(default_factory=Visual)
    power: Power | None = field(default_factory=Power)
    command: Joystick | None = field(default_factory=Joystick)
    doppler: Doppler | None = None

    def mounted(self, faults: Faults) -> Sensors:
        """Return the sensors with their true extrinsics: at base_link unless the fault that moves them is on."""
        in_place = {"gnss": faults.gnss_lever_arm, "doppler": faults.gnss_lever_arm, "imu": faults.imu_mounting}
        names = [name for name, kept in in_place.items() if not kept and getattr(self, name) is not None]
        return replace(self, **{name: replace(getattr(self, name), mounting=Mounting()) for name in names})

    def stated(self, faults: Faults, noise: Noise) -> Sensors:
        """Return the sensors with the extrinsics in the log; the antenna's are wrong by up to ``stated_off_m``."""
        if self.gnss is None or not faults.gnss_lever_arm:
            return self
        rng, mounting = noise("gnss.stated"), self.gnss.mounting
        direction = rng.standard_normal(3)
        off_m = rng.uniform(0.0, self.gnss.stated_off_m) * direction / np.linalg.norm(direction)
        x_m, y_m, z_m = np.add(mounting.xyz_m, off_m).tolist()
        return replace(self, gnss=replace(self.gnss, mounting=replace(mounting, xyz_m=(x_m, y_m, z_m))))


def record(truth: Truth, site: Site, sensors: Sensors, faults: Faults, noise: Noise) -> dict[str, Reading]:
    """Return a drive's readings by sensor (gnss, imu, wheels, visual, power, command, doppler), as mounted."""
    readers: dict[str, Callable[..., Reading]] = {
        "gnss": partial(read_gnss, site=site), "imu": read_imu, "wheels": read_wheels, "visual": read_visual,
        "power": read_power_meters, "command": read_joystick, "doppler": read_doppler,
    }  # fmt: skip
    middle_ns = (int(truth.stamp_ns[0]) + int(truth.stamp_ns[-1])) // 2
    readings = {}
    for name, read in readers.items():
        if (sensor := getattr(sensors, name)) is not None:
            readings[name] = reading = read(truth, sensor, faults, noise)
            stamp_ns = reading.stamp_ns
            if getattr(faults, f"{'wheel' if name == 'wheels' else name}_clock_offset", False):
                stamp_ns = stamp_ns + round(1e9 * sensor.clock_offset_s)
            if faults.clock_step:
                stamp_ns = np.where(stamp_ns < middle_ns, stamp_ns, stamp_ns + CLOCK_STEP_NS)
            readings[name] = replace(reading, stamp_ns=stamp_ns)
    return readings


class Noise:
    """Random streams by name, all from one seed; the same name gives the same numbers."""

    def __init__(self, seed: int, drive: int) -> None:
        self._key = (seed, drive)

    def __call__(self, name: str) -> np.random.Generator:
        """Return the stream called ``name``, from its beginning."""
        return np.random.default_rng([*self._key, zlib.crc32(name.encode())])


def read_gnss(truth: Truth, sensor: Gnss, faults: Faults, noise: Noise, *, site: Site) -> Reading:
    """Return fixes: lon_deg, lat_deg, alt_m, covariance (N, 9), known, status (-1: no fix)."""
    stamp = _sample_times(truth, sensor.rate_hz, noise("gnss.phase"))
    at = truth.at(stamp)
    enu = at.enu_m + rotate(at.quat_xyzw, np.array(sensor.mounting.xyz_m))
    white_m = np.array([sensor.std_m, sensor.std_m, sensor.vertical_std_m])
    of_drive = noise("gnss.drive")
    lasting_m = of_drive.uniform(*sensor.lasting_std_m) * np.array([1.0, 1.0, 1.7])  # satellites are all above
    lasts_s = float(np.exp(of_drive.uniform(*np.log(sensor.lasts_s))))
    if faults.gnss_noise:
        enu = enu + white_m * noise("gnss.noise").standard_normal(enu.shape)
        enu = enu + lasting_m * _make_lasting_noise(stamp.size, 1.0 / (sensor.rate_hz * lasts_s), noise("gnss.lasting"))
    if faults.gnss_outliers:
        rng = noise("gnss.outliers")
        hit = rng.random(stamp.size) < sensor.outlier_share
        enu = enu + hit[:, None] * sensor.outlier_m * rng.standard_normal(enu.shape)
    lon, lat, alt = site.lonlatalt(enu)
    status, keep = np.full(stamp.size, 2, dtype=np.int8), np.ones(stamp.size, dtype=bool)
    if faults.gnss_outage:
        begin = _draw_begin_ns(truth, noise("gnss.outage"), sensor.outage_s)
        half = round(sensor.outage_s * 0.5e9)
        status[(stamp >= begin) & (stamp < begin + half)] = -1
        keep = (stamp < begin + half) | (stamp >= begin + 2 * half)
    lon, lat, alt = (np.where(status < 0, np.nan, values) for values in (lon, lat, alt))
    known = sensor.covariance == "known"
    covariance = np.zeros((stamp.size, 9))
    covariance[:, [0, 4, 8]] = white_m**2 + lasting_m**2 if known else 0.0
    values = {"lon_deg": lon, "lat_deg": lat, "alt_m": alt, "covariance": covariance, "status": status}
    values["covariance_type"] = np.full(stamp.size, 2 if known else 0, dtype=np.uint8)
    messages = _finish(stamp, sensor.delay_s, values, faults, noise, name="gnss", keep=keep)
    if not faults.gnss_stamp_jitter:
        return messages
    jitter_s = sensor.stamp_jitter_s * noise("gnss.jitter").standard_normal(stamp.size)
    row = np.searchsorted(stamp, messages.stamp_ns)
    return replace(messages, stamp_ns=messages.stamp_ns + np.round(1e9 * jitter_s).astype(np.int64)[row])


def _make_lasting_noise(count: int, step: float, rng: np.random.Generator) -> Floats:
    """Return Gauss-Markov series of unit variance, shape (count, 3); ``step`` is between rows, in correlation times."""
    white = rng.standard_normal((3, count))
    return np.stack([make_correlated_noise(np.ascontiguousarray(row), float(np.exp(-step))) for row in white], axis=-1)


def read_doppler(truth: Truth, sensor: Doppler, faults: Faults, noise: Noise) -> Reading:
    """Return the antenna's velocity in ENU [m/s], shape (N, 3), and the covariance that the receiver states, (N, 36)."""
    stamp = _sample_times(truth, sensor.rate_hz, noise("gnss.phase"))
    place = truth.enu_m + rotate(truth.quat_xyzw, np.array(sensor.mounting.xyz_m))
    velocity = _interpolate(np.gradient(place, truth.stamp_ns * 1e-9, axis=0), truth, stamp)
    axes = np.array([1.0, 1.0, 2.0])
    if faults.gnss_noise:
        lasting = _make_lasting_noise(stamp.size, 1.0 / (sensor.rate_hz * sensor.lasts_s), noise("doppler.lasting"))
        scatter = noise("doppler.noise").standard_normal((stamp.size, 3))
        velocity = velocity + axes * (sensor.lasting_std_mps * lasting + sensor.std_mps * scatter)
    covariance = np.zeros((stamp.size, 36))
    covariance[:, [0, 7, 14]] = np.square(axes * np.hypot(sensor.std_mps, sensor.lasting_std_mps))
    covariance[:, [21, 28, 35]] = -1.0  # a receiver measures no turns
    values = {"velocity_enu_mps": velocity, "covariance": covariance}
    return _finish(stamp, sensor.delay_s, values, faults, noise, name="doppler")


def read_wheels(truth: Truth, sensor: WheelOdometry, faults: Faults, noise: Noise) -> Reading:
    """Return velocity_mps and yaw_rate_radps by the wheels, and their dead reckoning x_m, y_m, yaw_rad."""
    stamp = _sample_times(truth, sensor.rate_hz, noise("wheels.phase"))
    at = truth.at(stamp)
    velocity = at.wheel_velocity_mps if faults.wheel_slip else at.forward_velocity_mps
    yaw_rate = at.angular_velocity_radps[:, 2]
    if faults.wheel_scale:
        velocity, yaw_rate = velocity * sensor.scale, yaw_rate * sensor.yaw_scale
    if faults.wheel_noise:
        rng = noise("wheels.noise")
        # The encoders of a stationary robot are exactly constant.
        turning = (np.abs(velocity) > 1e-6) | (np.abs(yaw_rate) > 1e-6)
        velocity = velocity + turning * sensor.std_mps * rng.standard_normal(stamp.size)
        yaw_rate = yaw_rate + turning * sensor.yaw_rate_std_radps * rng.standard_normal(stamp.size)
    x, y, yaw = _dead_reckon(velocity, yaw_rate, 1.0 / sensor.rate_hz)
    values = {"velocity_mps": velocity, "yaw_rate_radps": yaw_rate, "x_m": x, "y_m": y, "yaw_rad": yaw}
    return _finish(stamp, sensor.delay_s, values, faults, noise, name="wheels")


def read_imu(truth: Truth, sensor: Imu, faults: Faults, noise: Noise) -> Reading:
    """Return angular_velocity_radps, specific_force_mps2, (N, 3), in the unit's frame, and orientation_xyzw in ENU."""
    stamp = _sample_times(truth, sensor.rate_hz, noise("imu.phase"))
    at = truth.at(stamp)
    place = truth.enu_m + rotate(truth.quat_xyzw, np.array(sensor.mounting.xyz_m))
    dt_s, acceleration = float(truth.stamp_ns[1] - truth.stamp_ns[0]) * 1e-9, np.zeros_like(place)
    acceleration[1:-1] = (place[2:] - 2.0 * place[1:-1] + place[:-2]) / dt_s**2
    acceleration = _interpolate(acceleration, truth, stamp)
    unit_from_base = invert(sensor.mounting.quat_xyzw())
    enu_from_unit = multiply(at.quat_xyzw, sensor.mounting.quat_xyzw())
    force = rotate(invert(enu_from_unit), acceleration + np.array([0.0, 0.0, GRAVITY_MPS2]))
    rate = rotate(unit_from_base, at.angular_velocity_radps)
    if faults.imu_bias:
        rate = rate + _make_wandering_bias(stamp, sensor.gyro_bias_radps, noise("imu.gyro_bias"))
        force = force + _make_wandering_bias(stamp, sensor.accelerometer_bias_mps2, noise("imu.accelerometer_bias"))
    if faults.imu_noise:
        rate = rate + sensor.gyro_std_radps * noise("imu.gyro_noise").standard_normal(rate.shape)
        force = force + sensor.accelerometer_std_mps2 * noise("imu.accelerometer_noise").standard_normal(force.shape)
    if faults.imu_vibration:
        size = sensor.vibration_mps2 * np.abs(at.wheel_velocity_mps)
        force = force + size[:, None] * noise("imu.vibration").standard_normal(force.shape)
    roll, pitch, yaw = rpy_from_quat(at.quat_xyzw).T
    if faults.imu_yaw_offset:
        yaw = yaw + sensor.yaw_offset_rad
    if faults.imu_noise:
        error = sensor.orientation_std_rad * noise("imu.orientation").standard_normal((3, stamp.size))
        roll, pitch, yaw = roll + error[0], pitch + error[1], yaw + error[2]
    orientation = multiply(quat_from_rpy(roll, pitch, yaw), sensor.mounting.quat_xyzw())
    values = {"angular_velocity_radps": rate, "specific_force_mps2": force, "orientation_xyzw": orientation}
    return _finish(stamp, sensor.delay_s, values, faults, noise, name="imu")


def read_visual(truth: Truth, sensor: Visual, faults: Faults, noise: Noise) -> Reading:
    """Return the twist (linear, angular, (N, 3) each, camera frame) and the camera's pose in its odometry frame."""
    stamp = _sample_times(truth, sensor.rate_hz, noise("visual.phase"))
    at = truth.at(stamp)
    base_from_camera = sensor.mounting.quat_xyzw()
    lever = np.array(sensor.mounting.xyz_m)
    body_velocity = rotate(invert(at.quat_xyzw), at.velocity_enu_mps) + np.cross(at.angular_velocity_radps, lever)
    linear = rotate(invert(base_from_camera), body_velocity)
    angular = rotate(invert(base_from_camera), at.angular_velocity_radps)
    wrong = np.zeros_like(linear)
    if faults.visual_scale:
        linear = linear * sensor.scale
    if faults.visual_noise:
        rng = noise("visual.noise")
        wrong = wrong + sensor.std_mps * rng.standard_normal(linear.shape)
        angular = angular + sensor.yaw_rate_std_radps * rng.standard_normal(angular.shape)
    if faults.visual_outliers:
        rng = noise("visual.outliers")
        hit = rng.random(stamp.size) < sensor.outlier_share
        wrong = wrong + hit[:, None] * sensor.outlier_mps * rng.standard_normal(linear.shape)
    linear = linear + wrong
    keep = _remove_span(stamp, truth, noise("visual.dropouts"), sensor.dropout_s) if faults.visual_dropouts else None
    position, orientation = _make_camera_pose(at, sensor, faults, wrong, noise)
    values: Values = {"linear_mps": linear, "angular_radps": angular}
    values |= {"position_m": position, "orientation_xyzw": orientation}
    return _finish(stamp, sensor.delay_s, values, faults, noise, name="visual", keep=keep)


def read_power_meters(truth: Truth, sensor: Power, faults: Faults, noise: Noise) -> Reading:
    """Return voltage_volt, left_amp and right_amp (the drivers), electronics_amp (all else); drawn positive."""
    stamp = _sample_times(truth, sensor.rate_hz, noise("power.phase"))
    read_ns = stamp if sensor.reading_hz is None else _sample_times(truth, sensor.reading_hz, noise("power.reading"))
    right = truth.current_amp * truth.right_share
    series = {"voltage_volt": truth.voltage_volt, "left_amp": truth.current_amp - right, "right_amp": right}
    period_ns = round(1e9 / (sensor.reading_hz or sensor.rate_hz)) if sensor.averaged else 0
    values = {name: _mean_before(truth, each, read_ns, period_ns) for name, each in series.items()}
    if faults.power_noise:
        volt, amp = (
            (sensor.voltage_std_volt, sensor.voltage_step_volt),
            (sensor.current_std_amp, sensor.current_step_amp),
        )
        for name, each in values.items():
            std, step = volt if name == "voltage_volt" else amp
            noisy = each + std * noise(f"power.{name}").standard_normal(read_ns.size)
            values[name] = np.round(noisy / step) * step
    if sensor.reading_hz is not None:
        last = np.maximum(np.searchsorted(read_ns, stamp, side="right") - 1, 0)
        values = {name: reading[last] for name, reading in values.items()}
    values["electronics_amp"] = sensor.electronics_watt / values["voltage_volt"]
    keep = _remove_span(stamp, truth, noise("power.gap"), sensor.gap_s) if faults.power_gap else None
    return _finish(stamp, sensor.delay_s, values, faults, noise, name="power", keep=keep)


def read_joystick(truth: Truth, sensor: Joystick, faults: Faults, noise: Noise) -> Reading:
    """Return velocity_mps and yaw_rate_radps as commanded."""
    stamp = _sample_times(truth, sensor.rate_hz, noise("command.phase"))
    before = np.maximum(np.searchsorted(truth.stamp_ns, stamp, side="right") - 1, 0)
    velocity, yaw_rate = truth.command_velocity_mps[before], truth.command_yaw_rate_radps[before]
    if faults.command_jitter:
        rng = noise("command.jitter")
        velocity = velocity * (1.0 - sensor.jitter * np.abs(rng.standard_normal(stamp.size)))
        yaw_rate = yaw_rate + sensor.jitter * rng.standard_normal(stamp.size) * (velocity != 0.0)
    values: Values = {"velocity_mps": velocity, "yaw_rate_radps": yaw_rate}
    return _finish(stamp, sensor.delay_s, values, faults, noise, name="command")


def _finish(
    stamp: Ints, delay_s: float, values: Values, faults: Faults, noise: Noise, *,
    name: str, keep: Mask | None = None,
) -> Reading:  # fmt: skip
    """Return the recorded messages: with exponential tail delays, without lost ones, with some of them twice."""
    times = np.ones(stamp.size, np.int64) if keep is None else keep.astype(np.int64)
    log_time = stamp
    if faults.transport_delay:
        late_s = delay_s * (0.7 + 0.3 * noise(f"{name}.delay").exponential(1.0, stamp.size))
        log_time = stamp + np.round(late_s * 1e9).astype(np.int64)
    if faults.duplicates:
        times[times > 0] += noise(f"{name}.duplicates").random(int(times.sum())) < 0.002
    values = {column: np.repeat(each, times, axis=0) for column, each in values.items()}
    return Reading(np.repeat(stamp, times), np.repeat(log_time, times), values)


def _sample_times(truth: Truth, rate_hz: float, rng: np.random.Generator) -> Ints:
    period_ns = 1e9 / rate_hz
    times = np.arange(rng.uniform(0.0, period_ns), truth.stamp_ns[-1] - truth.stamp_ns[0], period_ns)
    return np.asarray(truth.stamp_ns[0] + np.round(times).astype(np.int64))


def _draw_begin_ns(truth: Truth, rng: np.random.Generator, length_s: float) -> int:
    """Return when something of that length begins, somewhere in the middle half of the drive."""
    span = int(truth.stamp_ns[-1] - truth.stamp_ns[0])
    return int(truth.stamp_ns[0] + rng.uniform(0.25, 0.75) * max(span - length_s * 1e9, 0.0))


def _remove_span(stamp: Ints, truth: Truth, rng: np.random.Generator, length_s: float) -> Mask:
    """Return the remaining messages if a span of this length is missing."""
    begin = _draw_begin_ns(truth, rng, length_s)
    return (stamp < begin) | (stamp >= begin + round(length_s * 1e9))


def _dead_reckon(velocity: Floats, yaw_rate: Floats, dt_s: float) -> tuple[Floats, Floats, Floats]:
    yaw = accumulate(yaw_rate[1:] + yaw_rate[:-1]) * dt_s / 2
    step_x, step_y = velocity * np.cos(yaw) * dt_s, velocity * np.sin(yaw) * dt_s
    return np.cumsum(step_x) - step_x[0], np.cumsum(step_y) - step_y[0], (yaw + np.pi) % (2 * np.pi) - np.pi


def _interpolate(values: Floats, truth: Truth, stamp: Ints) -> Floats:
    return np.stack([np.interp(stamp, truth.stamp_ns, column) for column in values.T], axis=-1)


def _make_wandering_bias(stamp: Ints, size: float, rng: np.random.Generator) -> Floats:
    """Return a constant of about ``size`` an axis that drifts by a fifth, correlated over 100 s, shape (N, 3)."""
    constant = size * np.sign(rng.standard_normal(3)) * rng.uniform(0.6, 1.2, 3)
    step_s = float(np.median(np.diff(stamp))) * 1e-9
    return constant + 0.2 * size * _make_lasting_noise(stamp.size, step_s / 100.0, rng)


def _mean_before(truth: Truth, values: Floats, stamp: Ints, period_ns: int) -> Floats:
    """Return the mean of a series over the period that ends at each stamp; of no period the value there."""
    if not period_ns:
        return np.interp(stamp, truth.stamp_ns, values)
    steps_s = np.diff(truth.stamp_ns) * 1e-9
    integral = accumulate(0.5 * (values[1:] + values[:-1]) * steps_s)
    start = np.maximum(stamp - period_ns, truth.stamp_ns[0])
    area = np.interp(stamp, truth.stamp_ns, integral) - np.interp(start, truth.stamp_ns, integral)
    return np.asarray(area / np.maximum((stamp - start) * 1e-9, 1e-12))


def _make_camera_pose(
    at: Truth, sensor: Visual, faults: Faults, wrong_mps: Floats, noise: Noise
) -> tuple[Floats, Floats]:
    """Return the camera's drifting pose: increments of the true pose, scaled, with the velocity errors integrated."""
    base_from_camera = sensor.mounting.quat_xyzw()
    enu_from_camera = multiply(at.quat_xyzw, base_from_camera)
    place = at.enu_m + rotate(at.quat_xyzw, np.array(sensor.mounting.xyz_m))
    drift = np.zeros((at.stamp_ns.size, 3))
    if faults.visual_noise:
        white = noise("visual.rotation").standard_normal((at.stamp_ns.size, 3))
        drift = np.cumsum(white, axis=0) * sensor.yaw_rate_std_radps / sensor.rate_hz
    turned = multiply(enu_from_camera, quat_from_rotation_vector(drift))
    start_from_camera = multiply(invert(enu_from_camera[0]), turned)
    moved = rotate(invert(enu_from_camera[:-1]), np.diff(place, axis=0))
    moved = moved * (sensor.scale if faults.visual_scale else 1.0) + wrong_mps[:-1] / sensor.rate_hz
    steps = rotate(start_from_camera[:-1], moved)
    return np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)]), start_from_camera
