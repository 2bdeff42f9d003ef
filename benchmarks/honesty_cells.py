"""Cells of `honesty.py`: families of errors that no estimator models exactly, their sizes, and the sets of sensors that they meet.

A family is a function from a drive to an error; its numbers come from a random stream of the drive, named like the
family. Every cell lies in an ordinary world: fixes whose error is correlated in time with an honest covariance, an
antenna stated some centimetres off, and a current sensor with a gain and an offset.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import product
from typing import Any, TypeAlias

import numpy as np
from campaign_drives import Drive, Fault, Messages, Readings
from campaign_faults import SETS, alter, edit_messages, move_fixes, remove_antenna_frame, replace_values, shift_stamps

from tcpipe.formats.logs.writing import MessageStream
from tcpipe.geometry.rotation import rotate
from tcpipe.simulation.messages import TOPICS
from tcpipe.simulation.robot import make_correlated_noise
from tcpipe.simulation.sensors import Gnss, Imu, Joystick, Mounting, Power, Reading, Sensors, Visual, WheelOdometry
from tcpipe.simulation.truth import Truth

FixError: TypeAlias = Callable[[Truth, np.random.Generator], np.ndarray]
"""East, north, up [m], shape (N, 3), of fixes at the times of the truth."""
Scale: TypeAlias = Callable[[Truth, np.random.Generator], np.ndarray]
"""By what an odometry's velocity is multiplied, shape (N,)."""

UP = 1.7
"""How much larger errors of the height are than those of east and north."""
_AXES = np.array([1.0, 1.0, UP])
_WHITE_M = 0.005
_STEEP_RAD = 0.2
_LONGEST_RAMP_S = 45.0
_TOPICS = TOPICS["ros2"]


def _seconds(at: Truth) -> np.ndarray:
    return np.asarray((at.stamp_ns - at.stamp_ns[0]) * 1e-9)


def _direction(rng: np.random.Generator) -> np.ndarray:
    """Return a unit vector of the horizontal plane, shape (3,)."""
    angle = rng.uniform(0.0, 2.0 * np.pi)
    return np.array([np.cos(angle), np.sin(angle), 0.0])


def _begin_s(drive_s: float, length_s: float, rng: np.random.Generator) -> float:
    """Return when something of that length begins, in the middle half of the drive where it fits."""
    return float(rng.uniform(0.25, 0.75) * max(drive_s - length_s, 0.0))


# Errors of fixes


def gauss_markov(std_m: float, tau_s: float) -> FixError:
    """Return an error of first order: std_m east and north, correlated by exp(-t / tau_s)."""

    def make(at: Truth, rng: np.random.Generator) -> np.ndarray:
        kept = float(np.exp(-np.median(np.diff(at.stamp_ns)) * 1e-9 / tau_s))
        white = rng.standard_normal((3, at.stamp_ns.size))
        return std_m * _AXES * np.stack([make_correlated_noise(row, kept) for row in white], axis=-1)

    return make


def flicker(std_m: float) -> FixError:
    """Return an error whose power spectral density falls as 1 / f; std_m over twice the drive."""

    def make(at: Truth, rng: np.random.Generator) -> np.ndarray:
        count = 2 * at.stamp_ns.size
        size = np.zeros(count // 2 + 1)
        size[1:] = np.arange(1, size.size) ** -0.5
        parts = rng.standard_normal((2, 3, size.size))
        series = np.fft.irfft(size * (parts[0] + 1j * parts[1]), count) * count / (2.0 * np.sqrt(np.sum(size**2)))
        return std_m * _AXES * series[:, : at.stamp_ns.size].T

    return make


def multipath(std_m: float) -> FixError:
    """Return an error that is a function of the place alone: waves of 2 m to 20 m over the ground."""

    def make(at: Truth, rng: np.random.Generator) -> np.ndarray:
        count = 16
        length_m = np.exp(rng.uniform(*np.log([2.0, 20.0]), (3, count)))
        angle, phase = rng.uniform(0.0, 2.0 * np.pi, (2, 3, count))
        x, y = (values[:, None, None] for values in (at.x_map_m, at.y_map_m))
        waves = np.cos(2.0 * np.pi / length_m * (x * np.cos(angle) + y * np.sin(angle)) + phase)
        return std_m * _AXES * np.sqrt(2.0 / count) * waves.sum(axis=-1)

    return make


def steps(std_m: float, every_s: float = 25.0) -> FixError:
    """Return an error that is drawn anew whenever the constellation changes, after every_s on average."""

    def make(at: Truth, rng: np.random.Generator) -> np.ndarray:
        seconds = _seconds(at)
        times = np.cumsum(rng.exponential(every_s, 10 + int(4 * seconds[-1] / every_s)))
        return std_m * _AXES * rng.standard_normal((times.size + 1, 3))[np.searchsorted(times, seconds)]

    return make


def ramps(size_m: float) -> FixError:
    """Return three ambiguities that drift off by size_m within 10 s to 30 s, last for some seconds, and are fixed again."""

    def make(at: Truth, rng: np.random.Generator) -> np.ndarray:
        seconds, error = _seconds(at), np.zeros((at.stamp_ns.size, 3))
        for begin_s in (seconds[-1] - _LONGEST_RAMP_S) * (np.arange(3) + rng.uniform(0.0, 0.3, 3)) / 3.0:
            since_s, ramp_s, lasts_s = seconds - begin_s, rng.uniform(10.0, 30.0), rng.uniform(5.0, 15.0)
            part = np.clip(since_s / ramp_s, 0.0, 1.0) * (since_s < ramp_s + lasts_s)
            error += size_m * part[:, None] * _direction(rng)
        return error

    return make


def excursion(size_m: float, length_s: float) -> FixError:
    """Return one smooth excursion: away by size_m and back within length_s."""

    def make(at: Truth, rng: np.random.Generator) -> np.ndarray:
        seconds = _seconds(at)
        part = np.clip((seconds - _begin_s(seconds[-1], length_s, rng)) / length_s, 0.0, 1.0)
        return size_m * np.sin(np.pi * part[:, None]) ** 2 * _direction(rng)

    return make


def wrong_fix(size_m: float, length_s: float) -> FixError:
    """Return fixes that lie size_m aside for length_s."""

    def make(at: Truth, rng: np.random.Generator) -> np.ndarray:
        since_s = _seconds(at) - _begin_s(_seconds(at)[-1], length_s, rng)
        return size_m * ((since_s >= 0.0) & (since_s < length_s))[:, None] * _direction(rng)

    return make


def moved_antenna(size_m: float) -> FixError:
    """Return what an antenna errs that slips by size_m on the robot at half-time."""

    def make(at: Truth, rng: np.random.Generator) -> np.ndarray:
        after = _seconds(at) >= 0.5 * _seconds(at)[-1]
        return after[:, None] * rotate(at.quat_xyzw, size_m * _direction(rng))

    return make


# Scales of odometry


def by_slope(depth: float) -> Scale:
    """Return a scale that changes by up to depth uphill and as much the other way downhill."""
    return lambda at, rng: 1.0 + rng.choice([-1.0, 1.0]) * depth * np.clip(at.slope_rad / _STEEP_RAD, -1.0, 1.0)


def by_terrain(depth: float) -> Scale:
    """Return a scale of its own for each terrain class, within depth of 1."""
    return lambda at, rng: 1.0 + depth * rng.permutation(np.linspace(-1.0, 1.0, 4))[at.terrain_class % 4]


def by_load(depth: float) -> Scale:
    """Return a scale that falls by up to depth with the power of the last seconds, and grows as much without load."""

    def make(at: Truth, _: np.random.Generator) -> np.ndarray:
        count = max(round(2e9 / float(np.median(np.diff(at.stamp_ns)))), 1)
        load = np.convolve(at.power_watt, np.full(count, 1.0 / count))[: at.power_watt.size]
        return 1.0 - depth * np.tanh((load - load.mean()) / load.std())

    return make


def err(family: FixError) -> Callable[[Readings, Drive], Readings]:
    """Return a change of fixes by a family; the receiver knows nothing of it."""
    return alter("gnss", lambda reading, drive: _moved_by(reading, drive, family, "fault"))


def scale(role: str, family: Scale) -> Callable[[Readings, Drive], Readings]:
    """Return a change of the speed by a family."""
    name = {"wheels": "velocity_mps", "visual": "linear_mps"}[role]

    def change(reading: Reading, drive: Drive) -> Reading:
        factor = family(drive.truth.at(reading.stamp_ns), drive.noise(f"scale.{role}"))
        values = reading.values[name]
        return replace_values(reading, **{name: values * factor.reshape(-1, *[1] * (values.ndim - 1))})

    return alter(role, change)


def _moved_by(reading: Reading, drive: Drive, family: FixError, name: str) -> Reading:
    stamp_ns, row = np.unique(reading.stamp_ns, return_inverse=True)  # a fix that was recorded twice errs once
    return move_fixes(reading, drive, family(drive.truth.at(stamp_ns), drive.noise(name))[row])


def claim_noise(name: str, std_m: float, family: FixError) -> Callable[[Readings, Drive], Readings]:
    """Return a change of fixes by a family of that standard deviation, which the covariance states beside the white part."""

    def change(reading: Reading, drive: Drive) -> Reading:
        covariance = reading.values["covariance"].copy()
        covariance[:, [0, 4, 8]] += np.square(std_m * _AXES)
        return replace_values(_moved_by(reading, drive, family, name), covariance=covariance)

    return alter("gnss", change)


def _ordinary_noise(readings: Readings, drive: Drive) -> Readings:
    rng = drive.noise("ordinary")
    std_m, tau_s = rng.uniform(0.008, 0.020), float(np.exp(rng.uniform(*np.log([5.0, 60.0]))))
    return claim_noise("ordinary.fixes", std_m, gauss_markov(std_m, tau_s))(readings, drive)


# What a log says of the antenna, clocks, power


def state_arm(shift_m: Callable[[np.random.Generator], np.ndarray]) -> Callable[[Messages, Drive], Messages]:
    """Return a change of the antenna's transform by a vector in base_link, shape (3,)."""

    def moved(transform: Mapping[str, Any], drive: Drive) -> Mapping[str, Any]:
        if transform["child_frame_id"] != "gps_link":
            return transform
        placed = transform["transform"]
        shift = zip("xyz", shift_m(drive.noise("stated arm")).tolist(), strict=True)
        xyz_m = {axis: placed["translation"][axis] + metres for axis, metres in shift}
        return {**transform, "transform": {**placed, "translation": xyz_m}}

    def change(messages: Messages, drive: Drive) -> Messages:
        return [
            edit_messages(m, transforms=[moved(of, drive) for of in m.constants["transforms"]])
            if m.topic == _TOPICS["tf_static"] else m
            for m in messages
        ]  # fmt: skip

    return change


def some_centimetres(rng: np.random.Generator) -> np.ndarray:
    """Return an error of a stated arm: 0 to 10 cm, in any direction."""
    direction = rng.standard_normal(3)
    return np.asarray(rng.uniform(0.0, 0.10) * direction / np.linalg.norm(direction))


def _higher(size_m: float) -> Callable[[np.random.Generator], np.ndarray]:
    return lambda rng: np.array([0.0, 0.0, size_m * rng.choice([-1.0, 1.0])])


def _aside(size_m: float) -> Callable[[np.random.Generator], np.ndarray]:
    return lambda rng: size_m * _direction(rng)


def _half_ns(drive: Drive) -> int:
    return int(drive.truth.stamp_ns[0] + drive.truth.stamp_ns[-1]) // 2


def step_host_clock(seconds: float) -> Fault:
    """Return a step of the clock that stamps every message and the recording, by NTP at half-time."""
    step_ns = round(seconds * 1e9)

    def stepped(times_ns: np.ndarray, drive: Drive) -> np.ndarray:
        return np.where(times_ns < _half_ns(drive), times_ns, times_ns + step_ns)

    def change(m: MessageStream, drive: Drive) -> MessageStream:
        if m.publish_time_ns is None:
            return replace(m, log_time_ns=stepped(m.log_time_ns, drive))
        stamp_ns = stepped(m.publish_time_ns, drive)
        sec, nanosec = np.divmod(stamp_ns, 1_000_000_000)
        header = {"header.stamp.sec": sec, "header.stamp.nanosec": nanosec}
        return replace(edit_messages(m, header), log_time_ns=stepped(m.log_time_ns, drive), publish_time_ns=stamp_ns)

    def true_ns(stamp_ns: np.ndarray, drive: Drive) -> np.ndarray:
        """Return true times; those that the clock passed twice or never are before all truth."""
        low_ns, high_ns = sorted((_half_ns(drive), _half_ns(drive) + step_ns))
        after = np.where(stamp_ns >= high_ns, stamp_ns - step_ns, 0)
        return np.where(stamp_ns < low_ns, stamp_ns, after)

    fault = ORDINARY & Fault("", messages=lambda messages, drive: [change(m, drive) for m in messages], true_ns=true_ns)
    return replace(fault, name=f"host clock steps by {seconds:+g} s", said="clock", route="valley")


def _late_from_half_time(seconds: float) -> Callable[[Reading, Drive], Reading]:
    def change(reading: Reading, drive: Drive) -> Reading:
        after = reading.stamp_ns >= _half_ns(drive)
        return replace(reading, stamp_ns=reading.stamp_ns + after * round(seconds * 1e9))

    return change


def _frozen(length_s: float) -> Callable[[Reading, Drive], Reading]:
    def change(reading: Reading, drive: Drive) -> Reading:
        rows, seconds = np.arange(reading.stamp_ns.size), drive.seconds(reading.stamp_ns)
        begin_s = _begin_s(seconds[-1], length_s, drive.noise("frozen"))
        first = int(np.searchsorted(seconds, begin_s))
        rows = np.where((rows >= first) & (seconds < begin_s + length_s), first, rows)
        return replace_values(reading, **{name: reading.values[name][rows] for name in ("lon_deg", "lat_deg", "alt_m")})

    return change


def cut_fixes(length_s: float, gyro_jump_radps: float = 0.0) -> Callable[[Readings, Drive], Readings]:
    def change(readings: Readings, drive: Drive) -> Readings:
        begin_s = _begin_s(drive.seconds(drive.truth.stamp_ns[-1:])[0], length_s, drive.noise("outage"))

        def cut(reading: Reading, _: Drive) -> Reading:
            since_s = drive.seconds(reading.stamp_ns) - begin_s
            kept = (since_s < 0.0) | (since_s >= length_s)
            values = {name: of[kept] for name, of in reading.values.items()}
            return Reading(reading.stamp_ns[kept], reading.log_time_ns[kept], values)

        def jump(reading: Reading, _: Drive) -> Reading:
            after = drive.seconds(reading.stamp_ns) >= begin_s + 0.4 * length_s
            rate = reading.values["angular_velocity_radps"] + after[:, None] * np.array([0.0, 0.0, gyro_jump_radps])
            return replace_values(reading, angular_velocity_radps=rate)

        return alter("imu", jump)(alter("gnss", cut)(readings, drive), drive)

    return change


def _currents(change: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> Callable[[Readings, Drive], Readings]:
    """Return a change of both drivers' currents [A], given whether it is after half-time."""

    def changed(reading: Reading, drive: Drive) -> Reading:
        after = reading.stamp_ns >= _half_ns(drive)
        return replace_values(
            reading, **{f"{side}_amp": change(reading.values[f"{side}_amp"], after) for side in ("left", "right")}
        )

    return alter("power", changed)


# Cells


def _ordinary_power(readings: Readings, drive: Drive) -> Readings:
    """Return currents with a gain within 3.5 % and an offset within 0.35 A, which no data sheet excludes."""
    rng = drive.noise("ordinary.power")
    gain, offset_amp = 1.0 + rng.uniform(-0.035, 0.035), rng.uniform(-0.35, 0.35)
    return _currents(lambda amp, _: gain * amp + offset_amp / 2.0)(readings, drive)


def _ordinary(readings: Readings, drive: Drive) -> Readings:
    return _ordinary_power(_ordinary_noise(readings, drive), drive)


ORDINARY = Fault("clean", readings=_ordinary, messages=state_arm(some_centimetres))


def _clean(route: str) -> Fault:
    return replace(ORDINARY, name="clean" if route == "valley" else f"clean, {route}", route=route, calibrated=True)


@dataclass(frozen=True)
class HonestCell:
    """A set of sensors under a fault; ``wide`` ones are no part of the gate."""

    sensors: str
    fault: Fault
    wide: bool = False

    @property
    def name(self) -> str:
        """Text that ``--cells`` is matched with."""
        return f"{self.sensors}: {self.fault.name}"

    @property
    def base(self) -> HonestCell:
        """The same drive with the same sensors without a fault."""
        return HonestCell(self.sensors, _clean(self.fault.route))

    def fitted(self, drive: Drive) -> Sensors:
        """Return the sensors of a drive, each robot's own: where they are mounted, rates, scales."""
        rng = drive.noise("sensors")
        arm_m = (rng.uniform(-0.4, 0.4), rng.uniform(-0.2, 0.2), rng.uniform(0.5, 1.4))
        imu = Mounting(tuple(rng.uniform(-0.2, 0.2, 3)), (rng.choice([0.0, np.pi]), 0.0, rng.integers(4) * np.pi / 2))
        camera = Mounting((rng.uniform(0.2, 0.5), rng.uniform(-0.1, 0.1), 0.5), (0.0, rng.uniform(0.0, 0.3), 0.0))
        sensors = Sensors(
            gnss=Gnss(
                rng.choice([5.0, 10.0]), _WHITE_M, UP * _WHITE_M, (0.0, 0.0), mounting=Mounting(arm_m), stated_off_m=0.0
            ),
            wheels=WheelOdometry(40.0, scale=rng.normal(1.0, 0.015), yaw_scale=rng.uniform(1.02, 1.15)),
            imu=Imu(mounting=imu, orientation=bool(rng.integers(2))),
            visual=Visual(20.0, scale=rng.normal(1.0, 0.02), mounting=camera),
            power=Power(),
            command=Joystick(),
        )
        return replace(sensors, **dict.fromkeys(SETS[self.sensors]))


def _fault(name: str, role: str, said: str, readings: Callable[[Readings, Drive], Readings]) -> Fault:
    """Return a fault of a sensor in an ordinary world; with an empty ``said``, no check can name it."""
    fault = Fault(name, (role,), readings=readings)
    return replace(ORDINARY & fault, name=name, at_fault=fault.at_fault, said=said, route="valley")


def _noise(name: str, std_m: float, family: FixError) -> Fault:
    """Return another noise of the fixes in place of the ordinary one; it is claimed."""
    noise = claim_noise("noise", std_m, family)
    readings = lambda readings, drive: _ordinary_power(noise(readings, drive), drive)  # noqa: E731
    return Fault(name, route="valley", readings=readings, messages=ORDINARY.messages)


def _arm(name: str, messages: Callable[[Messages, Drive], Messages], said: str, route: str = "valley") -> Fault:
    """Return another stated antenna in place of the ordinary one."""
    return Fault(name, ("gnss",), said=said, readings=_ordinary, messages=messages, route=route)


_OF_NO_FAULT = r"stamp-jitter|lever-arm-\w+|sensor-not-placed|odometry-scale|measurements-rejected"
_GNSS, _VISUAL, _WHEELS, _IMU = (
    rf"(?m)^{role}\b(?!.*\[({_OF_NO_FAULT})\])" for role in ("gnss", "visual_odometry", "wheel_odometry", "imu")
)
"""Findings about a sensor, but for those that the clean drives have as well."""
_ARM = "lever-arm|sensor-not-placed"
_POWER = r"(?m)\[(power|current)[\w-]*(offset|gain|sign|scale|contradict|inconsistent)[\w-]*\]"


_BY: Mapping[str, Callable[[float], Scale]] = {"slope": by_slope, "terrain": by_terrain, "load": by_load}
_SCALED = (("camera", "visual", _VISUAL, "all"), ("wheel", "wheels", "", "no visual"))
_IN_BOTH = ("all", "no visual")
_CLEAN_SETS = (*_IN_BOTH, "no wheels", "no IMU", "GNSS, wheels", "GNSS, visual", "no GNSS", "wheels, IMU")

FAULTS: tuple[tuple[Fault, tuple[str, ...]], ...] = (
    (Fault("white 1.5 cm, exact arm", route="valley", readings=claim_noise("noise", 0.0142, gauss_markov(0.0142, 1e-3))), _IN_BOTH),
    *(
        (_noise(f"noise {cm:g} cm over {tau_s} s", cm / 100, gauss_markov(cm / 100, tau_s)), gate)
        for cm, tau_s, gate in ((0.8, 15, ("all",)), (1.5, 10, _IN_BOTH), (2, 10, _IN_BOTH), (3, 5, _IN_BOTH), (3, 20, ("no visual",)))
    ),
    *((_noise(f"flicker noise {cm} cm", cm / 100, flicker(cm / 100)), _IN_BOTH) for cm in (1, 2)),
    *((_fault(f"multipath of places {cm} cm", "gnss", "", err(multipath(cm / 100))), _IN_BOTH) for cm in (1, 3)),
    (_fault("constellation steps 2 cm", "gnss", "", err(steps(0.02))), ("no visual",)),
    (_fault("constellation steps 5 cm", "gnss", "", err(steps(0.05))), ("all",)),
    (_fault("ambiguity ramps 0.1 m", "gnss", "", err(ramps(0.1))), ("all",)),
    (_fault("ambiguity ramps 0.3 m", "gnss", _GNSS, err(ramps(0.3))), ("all",)),
    (_fault("excursion 0.15 m in 60 s", "gnss", "", err(excursion(0.15, 60))), _IN_BOTH),
    (_fault("excursion 0.4 m in 40 s", "gnss", _GNSS, err(excursion(0.4, 40))), _IN_BOTH),
    (_fault("excursion 0.4 m in 120 s", "gnss", "", err(excursion(0.4, 120))), _IN_BOTH),
    (_fault("fix 0.2 m wrong for 30 s", "gnss", _GNSS, err(wrong_fix(0.2, 30))), ()),
    (_fault("fix 0.5 m wrong for 60 s", "gnss", _GNSS, err(wrong_fix(0.5, 60))), _IN_BOTH),
    (_fault("antenna moved by 0.1 m", "gnss", "", err(moved_antenna(0.1))), ("all",)),
    (_fault("antenna moved by 0.3 m", "gnss", _GNSS, err(moved_antenna(0.3))), ("all",)),
    *(
        (_fault(f"{of} scale by {by} {percent} %", role, said if percent > 5 else "", scale(role, family(percent / 100))), gate)
        for (of, role, said, sets), (by, family), percent in product(_SCALED, _BY.items(), (5, 10, 15))
        for gate in [(sets,) if by == "slope" or percent == 10 else ()]
    ),
    *((_arm(f"arm {m:g} m wrong in height", state_arm(_higher(m)), _ARM if m > 0.2 else ""), ("all",)) for m in (0.15, 0.30, 0.65)),
    *((_arm(f"arm {m:g} m wrong aside, one turn", state_arm(_aside(m)), "", "one turn"), ()) for m in (0.1, 0.5)),
    (_arm("arm 0.1 m wrong aside, two turns", state_arm(_aside(0.1)), "", "two turns"), ("all",)),
    (_arm("arm 0.5 m wrong aside, two turns", state_arm(_aside(0.5)), _ARM, "two turns"), ("all",)),
    *((_arm(f"arm not stated, {route}", remove_antenna_frame, _ARM, route), ("all",)) for route in ("one turn", "two turns")),
    (_fault("current offset 0.3 A", "power", "", _currents(lambda amp, _: amp + 0.15)), ("all",)),
    (_fault("current offset 1 A", "power", _POWER, _currents(lambda amp, _: amp + 0.5)), ("all",)),
    (_fault("regeneration unsigned", "power", _POWER, _currents(lambda amp, _: np.abs(amp))), ("all",)),
    (_fault("current gain +3 % at half-time", "power", "", _currents(lambda amp, after: amp * (1.0 + 0.03 * after))), ("all",)),
    (_fault("current gain +10 % at half-time", "power", _POWER, _currents(lambda amp, after: amp * (1.0 + 0.10 * after))), ("all",)),
    (_fault("fixes frozen for 10 s", "gnss", _GNSS, alter("gnss", _frozen(10.0))), _IN_BOTH),
    *((step_host_clock(seconds), ("all",)) for seconds in (-3.0, 3.0)),
    *(
        (_fault(f"GNSS clock {s:+g} s at half-time", "gnss", _GNSS, alter("gnss", _late_from_half_time(s))), ("all",))
        for s in (0.1, 0.3)
    ),
    (_fault("60 s outage", "gnss", "", cut_fixes(60.0)), _IN_BOTH),
    *(
        (_fault(f"60 s outage, gyro jumps by {rate:g} rad/s", "imu", _IMU, cut_fixes(60.0, rate)), gate)
        for rate, gate in ((0.01, ()), (0.03, _IN_BOTH))
    ),
    (_fault("wheels 0.13 s late", "wheels", _WHEELS, alter("wheels", shift_stamps(0.13))), ("no visual", "GNSS, wheels")),
    *((_clean(route), ("wheels alone",)) for route in ("plain", "valley")),
)  # fmt: skip
"""Faults, and the sets of sensors that meet them in the gate."""


def honest_cells() -> Iterator[HonestCell]:
    """Yield every cell, the clean ones first; none twice."""
    for sensors in _CLEAN_SETS:
        yield HonestCell(sensors, _clean("valley"))
    for sensors in (*_CLEAN_SETS, "wheels alone"):
        yield HonestCell(sensors, _clean("slow"), wide=True)
    coarse = replace(_noise("fixes 1 m over 100 s, slow", 1.0, gauss_markov(1.0, 100.0)), route="slow")
    yield from (HonestCell(sensors, coarse, wide=True) for sensors in _IN_BOTH)
    for fault, gate in FAULTS:
        yield from (HonestCell(sensors, fault) for sensors in gate)
        beyond = [sensors for sensors in _IN_BOTH if not fault.calibrated and not {*fault.at_fault} & SETS[sensors]]
        yield from (HonestCell(sensors, fault, wide=True) for sensors in beyond if sensors not in gate)
