"""Cells of the campaign: sets of sensors, rates, and faults; a cell is one set at one rate with one fault.

To add a fault, write an entry of `FAULTS` (see `Fault` in `campaign_drives.py`) and, if it needs a set of sensors or a
rate other than all sensors at 10 Hz, a line in `_ELSEWHERE`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any

import numpy as np
from campaign_drives import Drive, Fault, Messages, Readings

from tcpipe.formats.logs.writing import MessageStream
from tcpipe.geometry.rotation import invert, rotate
from tcpipe.simulation.messages import TOPICS
from tcpipe.simulation.sensors import Doppler, Gnss, Mounting, Power, Reading, Sensors

MINUTE_S = (90.0, 150.0)
"""The window of faults that last a minute."""
_TOPICS = TOPICS["ros2"]
_APART_M = 0.03
"""How far ahead or behind base_link a skid-steered robot turns: an antenna found by the turns is found against that point."""
_ASIDE = np.array([0.4, 0.3, 0.0])
"""Half a metre, neither along nor across any axis."""

SETS: dict[str, frozenset[str]] = {
    "all": frozenset(),
    "no visual": frozenset({"visual"}),
    "no wheels": frozenset({"wheels"}),
    "no IMU": frozenset({"imu"}),
    "GNSS, wheels": frozenset({"imu", "visual"}),
    "GNSS, visual": frozenset({"imu", "wheels"}),
    "GNSS, IMU": frozenset({"wheels", "visual"}),
    "GNSS alone": frozenset({"imu", "wheels", "visual"}),
    "no GNSS": frozenset({"gnss"}),
    "wheels, IMU": frozenset({"gnss", "visual"}),
    "wheels alone": frozenset({"gnss", "imu", "visual"}),
    "visual, IMU": frozenset({"gnss", "wheels"}),
    "visual alone": frozenset({"gnss", "imu", "wheels"}),
}
"""By name, the sensors left out."""
DOPPLER = ", Doppler"
"""End of the name of a set whose receiver also reports velocity."""
SETS |= {f"{name}{DOPPLER}": left for name, left in SETS.items() if "gnss" not in left}


@dataclass(frozen=True)
class Cell:
    """A set of sensors, at a rate of GNSS, under a fault."""

    sensors: str
    gnss_hz: float
    fault: Fault
    without: frozenset[str] = frozenset()
    """Left out beside: what one who knows the faulty sensor would leave out."""

    @property
    def name(self) -> str:
        """Text that ``--cells`` is matched with."""
        rate = "" if "gnss" in SETS[self.sensors] else f" {self.gnss_hz:g} Hz"
        return f"{self.sensors}{rate}: {self.fault.name}"

    @property
    def fitted(self) -> Sensors:
        """The robot's sensors before the fault."""
        left = dict.fromkeys(SETS[self.sensors] | self.without)
        doppler = Doppler(rate_hz=self.gnss_hz) if self.sensors.endswith(DOPPLER) else None
        return replace(Sensors(), **({"gnss": Gnss(rate_hz=self.gnss_hz), "doppler": doppler} | left))


def alter(role: str, change: Callable[[Reading, Drive], Reading]) -> Callable[[Readings, Drive], Readings]:
    """Return a change of what one sensor measured, where it is there."""
    return lambda readings, drive: {
        name: change(reading, drive) if name == role else reading for name, reading in readings.items()
    }


def replace_values(reading: Reading, **values: Any) -> Reading:
    return replace(reading, values={**reading.values, **values})


def is_inside(reading: Reading, drive: Drive, window_s: tuple[float, float]) -> np.ndarray:
    at_s = drive.seconds(reading.stamp_ns)
    return (at_s >= window_s[0]) & (at_s < window_s[1])


def move_fixes(reading: Reading, drive: Drive, enu_m: np.ndarray) -> Reading:
    """Return fixes moved by metres, shape (N, 3)."""
    place = drive.site.enu_m(*(reading.values[name] for name in ("lon_deg", "lat_deg", "alt_m")))
    lon, lat, alt = drive.site.lonlatalt(place + enu_m)
    return replace_values(reading, lon_deg=lon, lat_deg=lat, alt_m=alt)


def _claiming(reading: Reading, std_m: float, where: np.ndarray) -> Reading:
    """Return fixes with a stated standard deviation, twice as large in height, if one is given."""
    covariance = reading.values["covariance"].copy()
    covariance[np.ix_(where, [0, 4, 8])] = np.square([std_m, std_m, 2 * std_m])
    return replace_values(reading, covariance=covariance)


def _wandering(reading: Reading, drive: Drive, name: str, std_m: float, tau_s: float) -> np.ndarray:
    """Return a first-order Gauss-Markov error of each fix [m], shape (N, 3), twice as large in height."""
    white = drive.noise(name).standard_normal((reading.stamp_ns.size, 3)) * std_m * [1.0, 1.0, 2.0]
    steps_s = np.diff(reading.stamp_ns, prepend=reading.stamp_ns[:1]) * 1e-9
    found = np.zeros_like(white)
    for k, step_s in enumerate(steps_s):
        kept = np.exp(-max(step_s, 0.0) / tau_s) if k else 0.0
        found[k] = kept * found[k - 1] + np.sqrt(1.0 - kept**2) * white[k]
    return found


def _wrong_fix(ramp_s: float) -> Callable[[Reading, Drive], Reading]:
    def change(reading: Reading, drive: Drive) -> Reading:
        since_s = drive.seconds(reading.stamp_ns) - MINUTE_S[0]
        size = np.clip(since_s / ramp_s, 0.0, 1.0) if ramp_s else (since_s >= 0.0).astype(float)
        return move_fixes(reading, drive, (size * is_inside(reading, drive, MINUTE_S))[:, None] * _ASIDE)

    return change


def _float(reading: Reading, drive: Drive) -> Reading:
    inside = is_inside(reading, drive, MINUTE_S)
    return _claiming(
        move_fixes(reading, drive, inside[:, None] * _wandering(reading, drive, "float", 0.3, 30.0)), 0.3, inside
    )


def _metre_level(claimed_m: float | None, std_m: float) -> Callable[[Reading, Drive], Reading]:
    def change(reading: Reading, drive: Drive) -> Reading:
        moved = move_fixes(reading, drive, _wandering(reading, drive, "metres", std_m, 60.0))
        if claimed_m is None:
            unknown = np.zeros(reading.stamp_ns.size, np.uint8)
            return replace_values(
                moved, covariance=np.zeros_like(reading.values["covariance"]), covariance_type=unknown
            )
        return _claiming(moved, claimed_m, np.ones(reading.stamp_ns.size, bool))

    return change


def _noisy_minute(reading: Reading, drive: Drive) -> Reading:
    more = drive.noise("more noise").standard_normal((reading.stamp_ns.size, 3)) * [0.015, 0.015, 0.025]
    return move_fixes(reading, drive, is_inside(reading, drive, MINUTE_S)[:, None] * more * np.sqrt(4.0**2 - 1.0))


def shift_stamps(seconds: float) -> Callable[[Reading, Drive], Reading]:
    return lambda reading, _: replace(reading, stamp_ns=reading.stamp_ns + round(seconds * 1e9))


def _scaled(name: str, factor: float, window_s: tuple[float, float] | None = None) -> Callable[..., Reading]:
    def change(reading: Reading, drive: Drive) -> Reading:
        hit = np.ones(reading.stamp_ns.size, bool) if window_s is None else is_inside(reading, drive, window_s)
        values = reading.values[name]
        wide = hit.reshape(-1, *[1] * (values.ndim - 1))
        return replace_values(reading, **{name: np.where(wide, values * factor, values)})

    return change


def _bias_jump(reading: Reading, drive: Drive) -> Reading:
    after = (drive.seconds(reading.stamp_ns) >= MINUTE_S[0])[:, None]
    rate = reading.values["angular_velocity_radps"] + after * np.array([0.01, -0.01, 0.03])
    force = reading.values["specific_force_mps2"] + after * np.array([0.3, 0.2, 0.1])
    return replace_values(reading, angular_velocity_radps=rate, specific_force_mps2=force)


def _placed(role: str, turn_rad: tuple[float, float, float], shift_m: tuple[float, float, float]) -> Callable[..., Any]:
    """Return what the log says where a sensor sits elsewhere than it does."""

    def change(sensors: Sensors) -> Sensors:
        sensor = getattr(sensors, role)
        if sensor is None:
            return sensors
        xyz_m = tuple(a + b for a, b in zip(sensor.mounting.xyz_m, shift_m, strict=True))
        rpy_rad = tuple(a + b for a, b in zip(sensor.mounting.rpy_rad, turn_rad, strict=True))
        return replace(sensors, **{role: replace(sensor, mounting=Mounting(xyz_m, rpy_rad))})

    return change


def _on(role: str, change: Callable[[MessageStream], MessageStream]) -> Callable[[Messages, Drive], Messages]:
    """Return a change of what one topic recorded."""
    return lambda messages, _: [change(m) if m.topic == _TOPICS[role] else m for m in messages]


def edit_messages(m: MessageStream, columns: dict[str, Any] | None = None, **constants: Any) -> MessageStream:
    named = {name.replace("__", "."): value for name, value in constants.items()}
    gone = {name: values for name, values in m.columns.items() if name not in named}
    return replace(m, columns={**gone, **(columns or {})}, constants={**m.constants, **named})


def remove_antenna_frame(messages: Messages, _: Drive) -> Messages:
    def change(m: MessageStream) -> MessageStream:
        return edit_messages(m, transforms=[t for t in m.constants["transforms"] if t["child_frame_id"] != "gps_link"])

    return [change(m) if m.topic == _TOPICS["tf_static"] else m for m in messages]


def _planar(m: MessageStream) -> MessageStream:
    covariance = np.diag([9e-4, 9e-4, 1e6, 1e6, 1e6, 1e-4]).ravel()
    still = np.zeros(m.log_time_ns.size)
    flat = {f"twist.twist.{name}": still for name in ("linear.z", "angular.x", "angular.y")}
    return edit_messages(m, flat, twist__covariance=covariance)


def _receipt_beside_laggy(messages: Messages, drive: Drive) -> Messages:
    """GNSS stamped when it was received, and the only odometry an estimator's output that lags."""
    found = []
    for m in messages:
        if m.topic == _TOPICS["gnss"]:
            sec, nanosec = np.divmod(m.log_time_ns, 1_000_000_000)
            found.append(edit_messages(m, {"header.stamp.sec": sec, "header.stamp.nanosec": nanosec}))
        elif m.topic == _TOPICS["wheels"]:
            lag = drive.truth.at(m.publish_time_ns - 180_000_000)
            columns = {
                "twist.twist.linear.x": lag.forward_velocity_mps,
                "twist.twist.angular.z": lag.angular_velocity_radps[:, 2],
            }
            found.append(replace(edit_messages(m, columns), topic="/a200_0000/platform/odom/filtered"))
        else:
            found.append(m)
    return found


def _slow_simulation(messages: Messages, drive: Drive) -> Messages:
    """Headers count simulated seconds from one on, while the recorder's clock runs three times as fast."""

    def change(m: MessageStream) -> MessageStream:
        if m.publish_time_ns is None:
            return replace(m, log_time_ns=drive.first_ns + 3 * (m.log_time_ns - drive.first_ns))
        sec, nanosec = np.divmod(m.publish_time_ns - drive.first_ns + 1_000_000_000, 1_000_000_000)
        slow_ns = drive.first_ns + 3 * (m.log_time_ns - drive.first_ns)
        return replace(
            edit_messages(m, {"header.stamp.sec": sec, "header.stamp.nanosec": nanosec}), log_time_ns=slow_ns
        )

    return [change(m) for m in messages]


def _from_simulated(stamp_ns: np.ndarray, drive: Drive) -> np.ndarray:
    """Return true times of simulated ones; times of the recorder are left as they are."""
    return np.where(stamp_ns < 10**18, stamp_ns + drive.first_ns - 1_000_000_000, stamp_ns)


def _few_rows(m: MessageStream, rows: np.ndarray) -> MessageStream:
    publish_ns = None if m.publish_time_ns is None else m.publish_time_ns[rows]
    columns = {name: values[rows] for name, values in m.columns.items()}
    return replace(m, columns=columns, log_time_ns=m.log_time_ns[rows], publish_time_ns=publish_ns)


def _three_messages_beside(messages: Messages, _: Drive) -> Messages:
    """Give the wheels an unspecific topic name, and three messages over the whole log the most specific one."""
    wheels = [m for m in messages if m.topic == _TOPICS["wheels"]]
    others = [m for m in messages if m.topic != _TOPICS["wheels"]]
    few = [_few_rows(m, np.array([0, m.log_time_ns.size // 2, m.log_time_ns.size - 1])) for m in wheels]
    return [*others, *few, *(replace(m, topic="/a200_0000/odom") for m in wheels)]


def _five_seconds(messages: Messages, drive: Drive) -> Messages:
    begin_ns = drive.first_ns + 60 * 10**9
    found = []
    for m in messages:
        rows = np.flatnonzero((m.log_time_ns >= begin_ns) & (m.log_time_ns < begin_ns + 5 * 10**9))
        found.append(m if m.latched else _few_rows(m, rows))
    return [m for m in found if m.log_time_ns.size]


def _gnss_covariance(values: list[float]) -> Callable[[Messages, Drive], Messages]:
    return _on(
        "gnss", lambda m: edit_messages(m, {"position_covariance": np.tile(np.array(values), (m.log_time_ns.size, 1))})
    )


def _odometry_covariance(value: np.ndarray) -> Callable[[Messages, Drive], Messages]:
    return lambda messages, drive: _on("visual", lambda m: edit_messages(m, twist__covariance=value))(
        _on("wheels", lambda m: edit_messages(m, twist__covariance=value))(messages, drive), drive
    )


def _of_the_body(reading: Reading, drive: Drive) -> Reading:
    """Return a receiver's velocity as a driver would write it that turns it into the body's axes."""
    velocity = rotate(invert(drive.truth.at(reading.stamp_ns).quat_xyzw), reading.values["velocity_enu_mps"])
    return replace_values(reading, velocity_enu_mps=velocity)


def _down(reading: Reading, _: Drive) -> Reading:
    return replace_values(reading, velocity_enu_mps=reading.values["velocity_enu_mps"][:, [1, 0, 2]] * [1.0, 1.0, -1.0])


def _holes(reading: Reading, drive: Drive) -> Reading:
    keep = ~is_inside(reading, drive, (100.0, 110.0))
    values = {name: column[keep] for name, column in reading.values.items()}
    return Reading(reading.stamp_ns[keep], reading.log_time_ns[keep], values)


def _gnss(**changes: Any) -> Callable[[Sensors], Sensors]:
    return lambda sensors: sensors if sensors.gnss is None else replace(sensors, gnss=replace(sensors.gnss, **changes))


def _power(rate_hz: float, reading_hz: float | None = None) -> Callable[[Sensors], Sensors]:
    return lambda sensors: replace(sensors, power=Power(rate_hz=rate_hz, reading_hz=reading_hz))


_DEG = float(np.radians(1.0))
_NAN, _BAD = float("nan"), np.diag([-0.01, -1.0, -2.0, float("nan"), float("inf"), -1.0]).ravel()
_CLOCKS = "time-offset|clocks-differ|clock-drift"
_SLIPPING = _scaled("velocity_mps", 1.43, MINUTE_S)

FAULTS: dict[str, Fault] = {
    fault.name: fault
    for fault in (
        Fault("clean", calibrated=True),
        Fault("RTK of 5 cm", calibrated=True, sensors=_gnss(std_m=0.05, vertical_std_m=0.08)),
        *(
            Fault(f"power at {rate_hz:g} Hz", calibrated=True, sensors=_power(rate_hz))
            for rate_hz in (1.0, 5.0, 20.0)
        ),
        Fault("power read at 1 Hz in messages at 20 Hz", calibrated=True, sensors=_power(20.0, 1.0)),
        Fault("10 s without GNSS", ("gnss",), (100.0, 110.0), readings=alter("gnss", _holes)),
        # Fixes that lie
        Fault("wrong fix", ("gnss",), MINUTE_S, "gnss", readings=alter("gnss", _wrong_fix(0.0))),
        Fault("wrong fix by a ramp", ("gnss",), MINUTE_S, "gnss", readings=alter("gnss", _wrong_fix(10.0))),
        Fault("float minute", ("gnss",), MINUTE_S, readings=alter("gnss", _float)),
        Fault("noisy minute", ("gnss",), MINUTE_S, "gnss", readings=alter("gnss", _noisy_minute)),
        Fault("metres, none claimed", ("gnss",), None, "gnss", True, readings=alter("gnss", _metre_level(None, 1.0))),
        Fault("metres, claimed", ("gnss",), None, may_refuse=True, readings=alter("gnss", _metre_level(2.3, 2.3))),
        # Places that are not true
        Fault("IMU pitched by 5 deg", ("imu",), told=_placed("imu", (0.0, 5 * _DEG, 0.0), (0.0, 0.0, 0.0))),
        Fault("IMU pitched by 2 deg", ("imu",), told=_placed("imu", (0.0, 2 * _DEG, 0.0), (0.0, 0.0, 0.0))),
        Fault("IMU rolled by 5 deg", ("imu",), told=_placed("imu", (5 * _DEG, 0.0, 0.0), (0.0, 0.0, 0.0))),
        Fault("arm wrong fore-aft", ("gnss",), None, "lever-arm", unseen_m=_APART_M, told=_placed("gnss", (0, 0, 0), (0.5, 0, 0))),
        Fault("arm wrong sideways", ("gnss",), None, "lever-arm", unseen_m=_APART_M, told=_placed("gnss", (0, 0, 0), (0, 0.5, 0))),
        Fault("arm unknown", ("gnss",), None, "sensor-not-placed", unseen_m=_APART_M, messages=remove_antenna_frame),
        # Clocks
        Fault("GNSS 0.1 s late", ("gnss",), None, _CLOCKS, readings=alter("gnss", shift_stamps(0.1))),
        Fault("GNSS 0.2 s late", ("gnss",), None, _CLOCKS, readings=alter("gnss", shift_stamps(0.2))),
        Fault("IMU 0.1 s late", ("imu",), None, _CLOCKS, readings=alter("imu", shift_stamps(0.1))),
        Fault("straight ahead", route="straight", calibrated=True),
        Fault("receipt stamps, laggy odometry", ("wheels",), None, messages=_receipt_beside_laggy),
        Fault("slow simulated time", messages=_slow_simulation, true_ns=_from_simulated),
        # Odometry and IMU that lie
        Fault("wheels 1.3 too fast", ("wheels",), None, "wheel", True, readings=alter("wheels", _scaled("velocity_mps", 1.3))),
        Fault("wheels slip for a minute", ("wheels",), MINUTE_S, "wheel", readings=alter("wheels", _SLIPPING)),
        Fault("visual 1.3 too fast", ("visual",), None, "visual", True, readings=alter("visual", _scaled("linear_mps", 1.3))),
        Fault("wheels turn at 0", ("wheels",), None, readings=alter("wheels", _scaled("yaw_rate_radps", 0.0))),
        Fault("visual turns at 0", ("visual",), None, readings=alter("visual", _scaled("angular_radps", 0.0))),
        Fault("planar visual", ("visual",), None, messages=_on("visual", _planar)),
        Fault("gyro at 0", ("imu",), None, "imu", readings=alter("imu", _scaled("angular_velocity_radps", 0.0))),
        Fault("IMU biases jump", ("imu",), None, readings=alter("imu", _bias_jump)),
        # Logs that are odd
        Fault("three messages on the better name", ("wheels",), None, messages=_three_messages_beside),
        Fault("5 s", may_refuse=True, messages=_five_seconds),
        Fault("never moves", may_refuse=True, said="robot-did-not-move|no-motion|no-segments", route="standing"),
        Fault("GNSS covariance negative", messages=_gnss_covariance([-1e-4, 0, 0, 0, -1e-4, 0, 0, 0, -1e-3])),
        Fault("GNSS covariance NaN", messages=_gnss_covariance([_NAN] * 9)),
        Fault("GNSS covariance not symmetric", messages=_gnss_covariance([2e-4, 9e-4, 0, -9e-4, 2e-4, 0, 1, 0, 6e-4])),
        Fault("odometry covariance negative or NaN", messages=_odometry_covariance(_BAD)),
    )
}  # fmt: skip

_SAID = "gnss_velocity"
VELOCITY_FAULTS: dict[str, Fault] = {
    f"velocity {name}": Fault(f"velocity {name}", ("doppler",), window_s, said, readings=alter("doppler", change))
    for name, window_s, said, change in (
        ("frozen at 0", None, _SAID, _scaled("velocity_enu_mps", 0.0)),
        ("0 for a minute", MINUTE_S, _SAID, _scaled("velocity_enu_mps", 0.0, MINUTE_S)),
        ("north, east, down", None, _SAID, _down),
        ("of the body", None, _SAID, _of_the_body),
        ("0.2 s late", None, "", shift_stamps(0.2)),
    )
}
"""Faults of the receiver's velocity, in sets that have one."""

_PAIRED = ("wrong fix", "wheels 1.3 too fast", "IMU pitched by 5 deg", "GNSS 0.1 s late", "gyro at 0", "float minute")
_WITHOUT_VISUAL = (
    "wrong fix", "wrong fix by a ramp", "float minute", "noisy minute",
    "IMU pitched by 5 deg", "IMU pitched by 2 deg", "IMU rolled by 5 deg",
    "arm wrong fore-aft", "arm wrong sideways", "arm unknown", "GNSS 0.1 s late", "GNSS 0.2 s late", "straight ahead",
    "wheels 1.3 too fast", "wheels slip for a minute", "wheels turn at 0", "gyro at 0", "IMU biases jump",
)  # fmt: skip


_ELSEWHERE: tuple[tuple[str, float, tuple[str, ...]], ...] = (
    ("no visual", 5.0, _WITHOUT_VISUAL),
    ("all", 1.0, ("wrong fix", "float minute", "noisy minute", "GNSS 0.2 s late", "arm wrong fore-aft")),
    ("GNSS, wheels", 5.0, ("wrong fix", "float minute", "wheels 1.3 too fast", "wheels turn at 0")),
    ("GNSS, visual", 10.0, ("planar visual", "visual turns at 0", "visual 1.3 too fast")),
    ("no IMU", 10.0, ("planar visual", "wrong fix")),
    ("GNSS alone", 1.0, ("metres, claimed", "wrong fix", "float minute")),
    ("wheels, IMU", 10.0, ("wheels 1.3 too fast", "gyro at 0", "IMU pitched by 5 deg")),
    *(
        (f"{name}{DOPPLER}", 10.0, ("clean",))
        for name in ("all", "no visual", "no wheels", "no IMU", "GNSS, IMU", "GNSS, wheels")
    ),
    (f"GNSS alone{DOPPLER}", 1.0, ("clean", "metres, claimed", "float minute")),
    (f"no visual{DOPPLER}", 5.0, ("wrong fix", "wrong fix by a ramp", "float minute")),
    *(
        (f"{name}{DOPPLER}", hz, tuple(VELOCITY_FAULTS))
        for name, hz in (("all", 10.0), ("no visual", 5.0), ("GNSS alone", 1.0))
    ),
)
"""Set, rate of GNSS and faults of the cells beside clean ones and faults on all sensors at 10 Hz."""


def cells() -> Iterator[Cell]:
    """Yield every cell, the clean ones first."""
    for gnss_hz in (1.0, 5.0, 10.0, 20.0):
        for name in ("all", "no visual", "no wheels", "no IMU"):
            yield Cell(name, gnss_hz, FAULTS["clean"])
    for name in [name for name in SETS if not name.endswith(DOPPLER)][4:]:
        yield Cell(name, 10.0, FAULTS["clean"])
    yield Cell("GNSS alone", 1.0, FAULTS["clean"])
    for name, fault in FAULTS.items():
        if name != "clean":
            yield Cell("all", 10.0, fault)
    for sensors, gnss_hz, names in _ELSEWHERE:
        yield from (Cell(sensors, gnss_hz, (FAULTS | VELOCITY_FAULTS)[name]) for name in names)
    for first, second in combinations(_PAIRED, 2):
        if (first, second) != ("wrong fix", "float minute"):
            both = FAULTS[first] & FAULTS[second]
            yield Cell("no visual", 10.0, replace(both, may_refuse=True))
