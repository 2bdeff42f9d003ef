"""Compare labels with the truth of small worlds whose sensors break an assumption of fusion; no simulator of tcpipe is used.

    python benchmarks/fusion_worlds.py --seeds 2 --out A.json           # all kinds
    python benchmarks/fusion_worlds.py --kinds "step" --seeds 1         # some, by a regular expression; clean always runs
    python benchmarks/fusion_worlds.py --compare A.json B.json          # two versions on the same worlds

Each world is a drive of 150 to 240 s over gentle slopes at 0.5 to 3 m/s, in straight lines, arcs and stops. Its sensors
(fixes, wheels, IMU, power, and a camera in every second world) become `Streams`, which go through the stages of ingest.
A kind changes the sensors.

A flag is a quality bit that doubts the quantity: weak_gnss doubts only the place, bits about power only w and E; bits
that describe the drive doubt nothing. The columns of a row, over all seeds; "–": no label without a flag, or nothing
has to be named:

    labels; >3σ: per cent of labels whose T, w or E errs by more than 3σ without a flag; pos: the same of start points,
    beyond the circle that holds 99.73 %; T, w, E: per cent inside 2σ, starts: per cent inside the 95 % circle, both
    without a flag; doubted: per cent of good quantities (error below 2σ of the run without fault) that have a flag;
    lost: per cent of the labels of the run without fault that are missing; length: track over truth, worst run;
    changes: changes, offsets and exclusions that tcpipe found, per run; named: per cent of the runs where the fault
    matters whose first line of findings names it; CPU of the stages, per run.
"""

from __future__ import annotations

import argparse
import json
import re
import resource
import time
import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, field
from functools import cache, partial
from itertools import pairwise
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import pyproj
from scipy.spatial.transform import Rotation

from tcpipe.errors import TcpipeError
from tcpipe.formats.finding_lines import format_finding
from tcpipe.pipeline.ingest_run import run_stages
from tcpipe.recipe import Recipe
from tcpipe.tables.bits import Quality
from tcpipe.tables.columns import to_floats, to_integers, to_numbers
from tcpipe.tables.findings import WITNESSES_OF_LABEL, Finding, sort_findings
from tcpipe.tables.levels import STREAMS, LabelledSegments, Sensor, Streams, Track

Array: TypeAlias = np.ndarray
FIRST_SEED, START_NS, STEP_S = 301, 1_720_000_000_000_000_000, 0.005
ORIGIN_DEG_M, LEVER_M = (11.61, 48.27, 487.0), np.array([0.22, -0.13, 0.92])
GRAVITY_MPS2, MASS_KG, IDLE_WATT, BATTERY_OHM = 9.80665, 85.0, 60.0, 0.05
AXES, WHITE_M, SLOW_M = np.array([1.0, 1.0, 1.7]), 0.008, 0.012
"""Standard deviations of the white and the slow error of a fix [m], and how much larger those of the height are."""
MEMORY_BYTES = 12 * 2**30
"""More than any of these runs needs: an array over a span without data fails instead of stopping the machine."""
TO_GEODETIC = pyproj.Transformer.from_pipeline(
    "+proj=pipeline +step +inv +proj=topocentric +ellps=WGS84 +lon_0={} +lat_0={} +h_0={} +step +inv +proj=cart "
    "+ellps=WGS84 +step +proj=unitconvert +xy_in=rad +xy_out=deg".format(*ORIGIN_DEG_M)
)
_DRIVE = Quality.CURVED | Quality.POWER_MEAN_MISMATCH | Quality.BELOW_FULL_SPEED | Quality.NO_COMMAND
_DRIVE |= Quality.LOW_POWER_RATE
_POWER = Quality.VOLTAGE_OUT_OF_RANGE | Quality.UNPOWERED
_CIRCLE, _FAR = np.sqrt(-np.log([1.0 - 0.95, 1.0 - 0.9973]))
QUANTITIES = {
    "T": ("duration_s", "duration_std_s", 2.0, 3.0, _DRIVE | Quality.WEAK_GNSS | _POWER),
    "w": ("power_watt", "power_std_watt", 2.0, 3.0, _DRIVE | Quality.WEAK_GNSS),
    "E": ("energy_joule", "energy_std_joule", 2.0, 3.0, _DRIVE | Quality.WEAK_GNSS),
    "start": ("", "position_std_m", _CIRCLE, _FAR, _DRIVE | _POWER),
}
"""Columns of value and σ; errors over σ that are good, and that are wrong (for places: over DRMS); bits that do not doubt it."""


# The drive and its sensors


@dataclass(frozen=True)
class World:
    """True motion of base_link and power every `STEP_S`, arrays of shape (N,) or (N, 3)."""

    seed: int
    t: Array
    enu_m: Array
    velocity_mps: Array
    rotation: Rotation
    rate_radps: Array
    force_mps2: Array
    speed_mps: Array
    watt: Array
    joule: Array

    def at(self, t: Array, values: Array) -> Array:
        """Return values of the steps at other times [s], shape (N,) or (N, 3)."""
        if values.ndim == 1:
            return np.interp(t, self.t, values)
        return np.stack([np.interp(t, self.t, column) for column in values.T], -1)

    def find_cost(self, start_s: Array) -> tuple[Array, Array]:
        """Return duration [s] and energy [J] of the horizontal metre that begins at each time; NaN after the last whole metre."""
        duration_s = np.full(start_s.size, np.nan)
        for k, (begin_s, place) in enumerate(zip(start_s, self.at(start_s, self.enu_m), strict=True)):
            first = int(np.searchsorted(self.t, begin_s))
            away_m = np.hypot(*(self.enu_m[first:, :2] - place[:2]).T)
            if begin_s >= 0.0 and (away_m >= 1.0).any():
                last = int(np.argmax(away_m >= 1.0))
                part = (1.0 - away_m[last - 1]) / (away_m[last] - away_m[last - 1])
                duration_s[k] = self.t[first] + (last - 1 + part) * STEP_S - begin_s
        return duration_s, self.at(start_s + duration_s, self.joule) - self.at(start_s, self.joule)


def slow_noise(rng: np.random.Generator, t: Array, tau_s: float, columns: int) -> Array:
    """Return noise of first order with unit standard deviation, correlated by exp(-t / tau_s), shape (N, columns)."""
    kept = np.exp(-np.diff(t, prepend=t[0] - 50.0 * tau_s) / tau_s)
    noise = rng.standard_normal((t.size, columns)) * np.sqrt(1.0 - kept[:, None] ** 2)
    for k in range(1, t.size):
        noise[k] += kept[k] * noise[k - 1]
    return noise


def _plan(rng: np.random.Generator, long_s: float) -> Iterator[tuple[float, float, float]]:
    """Yield durations [s], speeds [m/s] and curvatures [1/m]."""
    yield 7.0, 0.0, 0.0
    at_s, speed, stopped_s = 7.0, rng.uniform(0.8, 1.8), 0.0
    while at_s < long_s - 6.0:
        radius_m = max(rng.uniform(4.0, 14.0), speed**2 / 0.8)
        straight_s, arc_s = rng.uniform(6.0, 14.0), np.deg2rad(rng.uniform(40.0, 150.0)) * radius_m / speed
        stop_s = rng.uniform(4.0, 6.0) if at_s - stopped_s > 45.0 else 0.0
        yield from ((straight_s, speed, 0.0), (arc_s, speed, rng.choice([-1.0, 1.0]) / radius_m), (stop_s, 0.0, 0.0))
        at_s += straight_s + arc_s + stop_s
        stopped_s = at_s if stop_s else stopped_s
        speed = speed if rng.random() < 0.5 else float(np.exp(rng.uniform(*np.log([0.5, 3.0]))))
    yield 6.0, 0.0, 0.0


def _integrate(values: Array) -> Array:
    return np.concatenate([[0.0], np.cumsum(0.5 * STEP_S * (values[1:] + values[:-1]))])


@cache
def make_world(seed: int, long_s: float) -> World:
    """Return the drive of a seed, about ``long_s`` long; 0: 150 to 240 s."""
    rng = np.random.default_rng([seed, 1])
    plan = np.array(list(_plan(rng, long_s or rng.uniform(150.0, 225.0))))
    t = np.arange(0.0, plan[:, 0].sum(), STEP_S)
    _, wanted, curve = plan[np.searchsorted(np.cumsum(plan[:, 0]), t, "right")].T
    speed, turn = np.zeros((2, t.size))
    for k in range(1, t.size):  # at most 0.6 m/s², with smooth ends
        speed[k] = speed[k - 1] + STEP_S * np.clip((wanted[k] - speed[k - 1]) / 0.4, -0.6, 0.6)
        turn[k] = turn[k - 1] + STEP_S * (curve[k] - turn[k - 1]) / 0.5
    yaw = rng.uniform(-np.pi, np.pi) + _integrate(speed * turn)
    ahead = np.stack([np.cos(yaw), np.sin(yaw)], -1)
    xy = np.stack([_integrate(speed * ahead[:, k]) for k in (0, 1)], -1)
    waves = rng.uniform(0.06, 0.11, 2)[:, None] * np.array([[1.0, 0.3], [-0.2, 1.0]])
    phase, high_m = xy @ waves.T + rng.uniform(0.0, 6.0, 2), rng.uniform(0.3, 0.7, 2)
    slope = (high_m * np.cos(phase)) @ waves
    climb, flat = np.sum(slope * ahead, axis=1), np.ones(t.size)
    forward = np.column_stack([ahead, climb]) / np.sqrt(1.0 + climb**2)[:, None]
    up = np.column_stack([-slope, flat]) / np.sqrt(1.0 + np.sum(slope**2, axis=1))[:, None]
    rotation = Rotation.from_matrix(np.stack([forward, np.cross(up, forward), up], -1))
    rate = np.zeros((t.size, 3))
    rate[1:-1] = (rotation[:-2].inv() * rotation[2:]).as_rotvec() / (2.0 * STEP_S)
    velocity = speed[:, None] * np.column_stack([ahead, climb])
    force, along = np.gradient(velocity, STEP_S, axis=0), np.linalg.norm(velocity, axis=1)
    force[:, 2] += GRAVITY_MPS2
    pull = 90.0 * (1.0 + 0.15 * slow_noise(rng, t, 2.0, 1)[:, 0]) + MASS_KG * np.sum(force * forward, axis=1)
    watt = np.maximum(IDLE_WATT + pull * along + 25.0 * np.abs(rate[:, 2]), 25.0)
    enu, force = np.column_stack([xy, np.sin(phase) @ high_m]), rotation.inv().apply(force)
    return World(seed, t, enu, velocity, rotation, rate, force, along, watt, _integrate(watt))


@dataclass
class Log:
    """Measurements by sensor, which kinds change in place; ``t`` are true times, ``stamp_s`` the times of its clock [s].

    The robot's clock reads ``start_ns`` at 0 s, and ``shift_s`` more after ``split_s``, where ``is_epoch`` in another
    clock epoch. Labels before ``judged_from_s`` are not judged.
    """

    columns: dict[str, dict[str, Array]]
    lever_m: Array = field(default_factory=lambda: LEVER_M)
    start_ns: int = START_NS
    split_s: float = np.inf
    shift_s: int = 0
    is_epoch: bool = True
    judged_from_s: float = 0.0

    def make_ns(self, seconds: Array, after: Array) -> Array:
        """Return stamps [ns]; ``after``: which are after the split."""
        return self.start_ns + np.rint(seconds * 1e9).astype(np.int64) + after * self.shift_s * 10**9

    def find_true_s(self, stamp_ns: Array) -> Array:
        """Return the true times [s] of stamps of the robot's clock."""
        after = stamp_ns - self.start_ns > (self.split_s + self.shift_s) * 1e9
        return (stamp_ns - self.start_ns - after * self.shift_s * 10**9) * 1e-9

    def keep(self, role: str, kept: Array) -> None:
        """Keep only some measurements of a sensor."""
        self.columns[role] = {name: values[kept] for name, values in self.columns[role].items()}


def make_log(world: World) -> Log:
    """Return what the sensors of a world without fault measure."""
    rng, log = np.random.default_rng([world.seed, 2]), Log({})
    rates_hz = {"gnss": rng.choice([5, 10]), "imu": 100, "wheel_odometry": rng.choice([20, 50]), "power": 20}
    for role, hz in {**rates_hz, **({"visual_odometry": 15} if world.seed % 2 else {})}.items():
        t = np.arange(rng.uniform(0.05, 0.2), world.t[-1] - 0.1, 1.0 / hz)
        rate, speed, white = (
            world.at(t, world.rate_radps),
            world.at(t, world.speed_mps),
            rng.standard_normal((t.size, 6)),
        )
        if role == "gnss":
            slow = slow_noise(rng, t, rng.uniform(10.0, 40.0), 3)
            place = world.at(t, world.enu_m + world.rotation.apply(LEVER_M))
            of = {"enu_m": place + AXES * (WHITE_M * white[:, :3] + SLOW_M * slow)}
            of["variance"] = np.tile((AXES * np.hypot(WHITE_M, SLOW_M)) ** 2, (t.size, 1))
        elif role == "imu":
            bias, drift = rng.standard_normal(6) * [*[0.002] * 3, *[0.03] * 3], slow_noise(rng, t, 60.0, 3)
            rough = (0.02 + 0.04 * speed)[:, None]
            of = {"rate": rate + bias[:3] + 0.002 * white[:, :3] + 0.0003 * drift}
            of["force"] = world.at(t, world.force_mps2) + bias[3:] + rough * white[:, 3:]
        elif role == "power":
            open_volt = 26.2 - 0.004 * t
            volt = 0.5 * (open_volt + np.sqrt(open_volt**2 - 4.0 * BATTERY_OHM * world.at(t, world.watt)))
            gain, zero = 1.0 + 0.015 * rng.standard_normal(), 0.1 * rng.standard_normal()
            of = {"volt": volt + 0.01 * white[:, 0]}
            of["amp"] = gain * (open_volt - volt) / BATTERY_OHM + zero + 0.05 * white[:, 1]
        else:
            noise, scale_std = (0.015, 0.015) if role == "wheel_odometry" else (0.03, 0.008)
            scale = 1.0 + scale_std * rng.standard_normal() + 0.004 * slow_noise(rng, t, 10.0, 1)[:, 0]
            of = {"speed": speed * scale + noise * white[:, 0] * np.minimum(speed / 0.1, 1.0)}
            of["yaw_rate"] = rate[:, 2] * (1.0 + 0.02 * rng.standard_normal()) + 0.02 * white[:, 1] * (speed > 0.0)
        log.columns[role] = {"t": t, "stamp_s": t.copy(), **of}
    return log


def make_streams(log: Log) -> Streams:
    """Return the streams of a log, as the stage that reads would."""
    tables, sensors = {}, {}
    for role, of in log.columns.items():
        after, schema = of["t"] >= log.split_s, STREAMS[role]
        columns: dict[str, Any] = dict.fromkeys(schema.names(), np.full(after.size, np.nan))
        columns |= {"stamp_ns": log.make_ns(of["stamp_s"], after), "log_time_ns": log.make_ns(of["t"] + 0.004, after)}
        columns["clock_epoch"] = (after & log.is_epoch).astype(np.int16)
        if role == "gnss":
            lon, lat, alt = TO_GEODETIC.transform(*of["enu_m"].T)
            if "decimals" in of:
                lon, lat = np.round(lon, 6), np.round(lat, 6)
            columns |= {"lon_deg": lon, "lat_deg": lat, "alt_m": alt, "fix_status": np.full(after.size, 2, np.int8)}
            columns |= {f"{axis}_var_m2": of["variance"][:, k] for k, axis in enumerate(("east", "north", "up"))}
        elif role == "imu":
            columns |= {f"angular_velocity_{axis}_radps": of["rate"][:, k] for k, axis in enumerate("xyz")}
            columns |= {f"linear_acceleration_{axis}_mps2": of["force"][:, k] for k, axis in enumerate("xyz")}
        elif role == "power":
            columns |= {"rail": np.full(after.size, "drive"), "voltage_volt": of["volt"], "current_amp": of["amp"]}
        else:
            columns |= {"velocity_x_mps": of["speed"], "velocity_y_mps": 0.0 * of["speed"]}
            columns["angular_velocity_z_radps"] = of["yaw_rate"]
        order = np.lexsort((columns["stamp_ns"], columns["clock_epoch"]))
        tables[role] = schema.table(**{name: values[order] for name, values in columns.items()})
        arm_m = log.lever_m if role == "gnss" else np.zeros(3)
        sensors[role] = Sensor(f"/{role}", "", role, "made", tuple(arm_m.tolist()), placed_by="tf_static")
    return Streams(tables, sensors, "generic")


# Kinds

Change: TypeAlias = Callable[[Log, World, np.random.Generator], object]
FixError: TypeAlias = Callable[[Array, float, np.random.Generator], Array]
"""Error of fixes [m], shape (N, 3), at times [s] of a drive of some length [s]."""


def _aside(part: Array, rng: np.random.Generator) -> Array:
    """Return a horizontal error of size ``part`` [m] in a direction, shape (N, 3)."""
    angle = rng.uniform(0.0, 2.0 * np.pi)
    return part[:, None] * np.array([np.cos(angle), np.sin(angle), 0.0])


def step(size_m: float) -> FixError:
    return lambda t, end_s, rng: _aside(size_m * (t > rng.uniform(0.3, 0.7) * end_s), rng)


def ramps(t: Array, end_s: float, rng: np.random.Generator) -> Array:
    """Return two ramps to 0.25 m within 20 s to 30 s, which then reset."""
    error = np.zeros((t.size, 3))
    for begin_s in rng.uniform([0.15, 0.5], [0.3, 0.65]) * end_s:
        part = (t - begin_s) / rng.uniform(20.0, 30.0)
        error += _aside(0.25 * np.clip(part, 0.0, 1.0) * (part < 1.2), rng)
    return error


def excursions(count: int) -> FixError:
    """Return smooth excursions of one size and direction: 0.1 m to 0.3 m away and back within 40 s to 120 s."""

    def make(t: Array, end_s: float, rng: np.random.Generator) -> Array:
        size_m, long_s = rng.uniform(0.1, 0.3), rng.uniform(40.0, min(120.0, 0.85 * end_s / count))
        first_s, every_s = rng.uniform(0.0, end_s / count - long_s), end_s / count
        parts = [np.clip((t - first_s - k * every_s) / long_s, 0.0, 1.0) for k in range(count)]
        return _aside(size_m * np.sum(np.sin(np.pi * np.array(parts)) ** 2, axis=0), rng)

    return make


def correction_age(t: Array, _: float, rng: np.random.Generator) -> Array:
    """Return errors that grow by 4 mm/s with the age of corrections, which come every 25 s to 60 s."""
    since_s, error = np.append(0.0, np.cumsum(rng.uniform(25.0, 60.0, 20))), np.zeros((t.size, 3))
    for begin_s, end_s in pairwise(since_s):
        error += _aside(0.004 * (t - begin_s) * ((t >= begin_s) & (t < end_s)), rng)
    return error


def put(role: str, name: str, change: Callable[[dict[str, Array], World, np.random.Generator], Array]) -> Change:
    """Return a change of one column of a sensor."""
    return lambda log, world, rng: log.columns[role].update({name: change(log.columns[role], world, rng)})


def err(make: FixError, std_m: float | None = None) -> Change:
    """Return a change of the fixes by an error, and of their stated standard deviation."""

    def change(log: Log, world: World, rng: np.random.Generator) -> None:
        of = log.columns["gnss"]
        of["enu_m"] = of["enu_m"] + make(of["t"], world.t[-1], rng)
        if std_m is not None:
            of["variance"][:] = (AXES * std_m) ** 2

    return change


def stamp(role: str, change: Callable[[Array, np.random.Generator], Array]) -> Change:
    """Return a change of the stamps of a sensor, which stay in order."""
    return put(
        role, "stamp_s", lambda of, _, rng: np.maximum.accumulate(change(of["t"], rng)) + 1e-6 * np.arange(of["t"].size)
    )


def smooth(of: dict[str, Array], _: World, __: np.random.Generator) -> Array:
    """Return places behind a first-order low-pass of 0.6 s."""
    kept, places = np.exp(-np.median(np.diff(of["t"])) / 0.6), of["enu_m"].copy()
    for k in range(1, of["t"].size):
        places[k] += kept * (places[k - 1] - places[k])
    return places


def slow_alone(log: Log, world: World, _: np.random.Generator, *, moving: bool = False) -> None:
    """Leave power and fixes at 1 Hz, from the beginning or from when the robot drives."""
    log.columns = {role: log.columns[role] for role in ("gnss", "power")}
    log.keep("gnss", slice(None, None, round(1.0 / np.median(np.diff(log.columns["gnss"]["t"])))))
    begin_s = world.t[int(np.argmax(world.speed_mps > 0.5))] + 4.0 if moving else 0.0
    for role, of in log.columns.items():
        log.keep(role, of["t"] >= begin_s)


def republish(log: Log, _: World, __: np.random.Generator) -> None:
    """Repeat each fix at 20 Hz, stamped when it is published, until the next one."""
    t = np.arange(*log.columns["gnss"]["t"][[0, -1]], 0.05)
    log.keep("gnss", np.searchsorted(log.columns["gnss"]["t"], t + 1e-9, "right") - 1)
    log.columns["gnss"] |= {"t": t, "stamp_s": t.copy()}


def two_epochs(log: Log, world: World, _: np.random.Generator) -> None:
    """Put the last 200 s into another clock epoch, three days later; in each the clock of GNSS drifts by 100 ppm."""
    log.split_s = log.judged_from_s = world.t[-1] - 200.0
    log.shift_s, t = 3 * 86400, log.columns["gnss"]["t"]
    log.columns["gnss"]["stamp_s"] = t + 1e-4 * (t - np.where(t >= log.split_s, log.split_s, 0.0))


def begin_in_1970(log: Log, _: World, __: np.random.Generator) -> None:
    """Begin in 1970; all clocks are set after 20 s, which looks like a pause in one clock epoch."""
    log.start_ns, log.split_s, log.shift_s, log.is_epoch = 10 * 10**9, 20.0, START_NS // 10**9, False


def _add_by_speed(of: dict[str, Array], world: World, _: np.random.Generator) -> Array:
    return of["force"] + 0.1 * np.outer(world.at(of["t"], world.speed_mps), [1.0, 0.0, 1.0])


_FIXES, _CLOCK = r"^(sensor-changed gnss|gnss-contradicts-odometry|position-jumps|fixes-\S+)", r"^(time-|clock)\S* "
KINDS: dict[str, tuple[Change, str]] = {
    "clean": (lambda *_: None, ""),
    "step of fixes 0.20 m": (err(step(0.20), 0.025), _FIXES),
    "step of fixes 0.30 m": (err(step(0.30), 0.025), _FIXES),
    "ramp of fixes": (err(ramps), _FIXES),
    "smooth excursion": (err(excursions(1)), _FIXES),
    "two excursions": (err(excursions(2)), _FIXES),
    "age of corrections": (err(correction_age), _FIXES),
    "clock of GNSS 3.7 s": (stamp("gnss", lambda s, _: s + 3.7), rf"{_CLOCK}gnss.*\b3\.[678]"),
    "clock of GNSS 18 s": (stamp("gnss", lambda s, _: s + 18.0), rf"{_CLOCK}gnss.*\b1[78]"),
    "receiver smoothing 0.6 s": (put("gnss", "enu_m", smooth), rf"smooth|section-|{_CLOCK}gnss"),
    "six decimals": (put("gnss", "decimals", lambda of, *_: of["t"]), "resolution|decimal|rounded"),
    "accelerometer bias by speed": (put("imu", "force", _add_by_speed), r"^\S+ imu"),
    "stamp jitter of GNSS 150 ms": (stamp("gnss", lambda s, rng: s + rng.exponential(0.15, s.size)), "jitter"),
    "clock of IMU 2000 ppm": (stamp("imu", lambda s, _: 1.002 * s), rf"{_CLOCK}imu"),
    "gyro scale 5 %": (put("imu", "rate", lambda of, *_: 1.05 * of["rate"]), r"^\S+ imu"),
    "antenna 0.65 m too high": (lambda log, *_: setattr(log, "lever_m", LEVER_M + [0, 0, 0.65]), "^lever-arm"),  # noqa: RUF005
    "fixes at 1 Hz alone": (slow_alone, ""),
    "1 Hz alone, moving start": (partial(slow_alone, moving=True), ""),
    "mixed covariances": (
        put(
            "gnss",
            "variance",
            lambda of, _, rng: np.where(rng.random((of["t"].size, 1)) < 0.43, np.nan, of["variance"]),
        ),
        "",
    ),
    "stale fixes at 20 Hz": (republish, "repeat|stale|republish"),
    "float fixes, 0.2 m of 0.3 m": (err(lambda t, _, rng: 0.2 * slow_noise(rng, t, 80.0, 3), 0.30), ""),
    "drift over two epochs": (two_epochs, rf"{_CLOCK}gnss"),
    "log begins in 1970": (begin_in_1970, ""),
}
"""Change of the sensors by name, and a regular expression that ``code subject: line`` of the first finding holds."""
LENGTHS_S = {"drift over two epochs": 2200.0}
"""Durations of drives that have to be longer [s]: a drift is estimated from three windows of 600 s."""


# Runs


@dataclass(frozen=True)
class Outcome:
    """Labels of a run against the truth, one value a label; without labels the reason is the first line."""

    start_s: list[float] = field(default_factory=list)
    error: dict[str, list[float]] = field(default_factory=dict)
    std: dict[str, list[float]] = field(default_factory=dict)
    bits: list[int] = field(default_factory=list)
    lines: list[str] = field(default_factory=lambda: [""])
    length: float = float("nan")
    changes: int = 0
    cpu_s: float = 0.0

    def judge(self, name: str) -> tuple[Array, Array, Array]:
        """Return absolute errors, the same over σ, and which have a flag that doubts the quantity."""
        error, std = (np.array(of.get(name, []), float) for of in (self.error, self.std))
        flagged = (np.array(self.bits, np.int64) & ~int(QUANTITIES[name][-1])) != 0
        return np.abs(error), np.abs(error) / std, flagged

    @property
    def matters(self) -> bool:
        """Whether a fault harms: no labels, more than 5 % of a quantity flagged, or more than 1 % wrong."""
        each = [(self.judge(name), wrong) for name, (_, _, _, wrong, _) in QUANTITIES.items()]
        return not self.bits or any(np.mean(flag) > 0.05 or np.mean(ratio > k) > 0.01 for (_, ratio, flag), k in each)


def run_world(name: str, seed: int, long_s: float = 0.0) -> Outcome:
    """Return the outcome of a kind and a seed; an error becomes its first line."""
    world, begun_s = make_world(seed, long_s or LENGTHS_S.get(name, 0.0)), time.process_time()
    log = make_log(world)
    KINDS[name][0](log, world, np.random.default_rng([seed, zlib.crc32(name.encode())]))
    try:
        track, _, labelled = run_stages(make_streams(log), Recipe().ingest, run_id="run")
    except TcpipeError as error:
        return Outcome(lines=[*_describe(error.findings), *error.problems], cpu_s=time.process_time() - begun_s)
    except Exception as error:  # noqa: BLE001  a bug is a result here
        return Outcome(lines=[f"{type(error).__name__}: {error}"])
    return _compare_with_truth(world, log, track, labelled, time.process_time() - begun_s)


def _describe(findings: Sequence[Finding]) -> list[str]:
    printed = [of for of in sort_findings(findings) if of.severity != "note" and of.code != WITNESSES_OF_LABEL]
    return [f"{of.code} {of.subject.name}: {format_finding(of)}" for of in printed] or [""]


def _compare_with_truth(world: World, log: Log, track: Track, labelled: LabelledSegments, cpu_s: float) -> Outcome:
    table, rows, facts = labelled.table, track.table, labelled.info.report.facts
    table = table.filter(log.find_true_s(to_integers(table, "start_ns")) >= log.judged_from_s)
    start_s = log.find_true_s(to_integers(table, "start_ns"))
    duration_s, joule = world.find_cost(start_s)
    true = {"T": duration_s, "w": joule / duration_s, "E": joule}
    error = {name: to_floats(table, QUANTITIES[name][0]) - values for name, values in true.items()}
    lon, lat, _ = TO_GEODETIC.transform(*world.at(start_s, world.enu_m).T)
    found = to_floats(table, "start_lon_deg"), to_floats(table, "start_lat_deg")
    error["start"] = np.where(np.isfinite(duration_s), pyproj.Geod(ellps="WGS84").inv(lon, lat, *found)[2], np.nan)
    rows_s = log.find_true_s(to_integers(rows, "stamp_ns"))
    speed = np.hypot(to_floats(rows, "east_velocity_mps"), to_floats(rows, "north_velocity_mps"))
    true_speed = np.hypot(*world.at(rows_s, world.velocity_mps)[:, :2].T)
    changes = sum(len(section.changes) for section in facts.fuse.sections) + len(facts.sensor_checks.excluded)
    changes += sum(offset.is_significant for clocks in facts.clock_offsets or () for offset in clocks.offsets.values())
    return Outcome(
        start_s.tolist(), {name: values.tolist() for name, values in error.items()},
        {name: to_floats(table, column).tolist() for name, (_, column, *_) in QUANTITIES.items()},
        to_numbers(table["quality"]).tolist(), _describe(labelled.info.report.findings),
        float(speed.sum() / true_speed.sum()), changes, cpu_s,
    )  # fmt: skip


# Figures

Outcomes: TypeAlias = dict[tuple[str, int], Outcome]
FORMS = {
    "labels": "6.0f", ">3σ": "5.1f", "pos": "5.1f", "T": "4.0f", "w": "4.0f", "E": "4.0f", "start": "5.0f", "doubted": "7.1f",
    "lost": "5.1f", "length": "7.4f", "changes": "7.1f", "named": "5.0f", "CPU s": "5.1f",
}  # fmt: skip
"""Columns of the table."""


def _share(hits: Sequence[Array]) -> float:
    hit = np.concatenate(hits)
    return 100.0 * float(np.mean(hit)) if hit.size else float("nan")


def find_figures(runs: Outcomes, clean: Outcomes) -> dict[str, float]:
    """Return the figures of some runs by `FORMS`; ``clean`` has the run without a fault of each seed."""
    f, doubted, wrong = {"labels": float(sum(len(of.bits) for of in runs.values()))}, [], {}
    for name, (_, _, good, far, _) in QUANTITIES.items():
        judged = [of.judge(name) for of in runs.values()]
        wrong[name] = [(ratio > far) & ~flagged for _, ratio, flagged in judged]
        f[name] = _share([ratio[~flagged & np.isfinite(ratio)] <= good for _, ratio, flagged in judged])
        for (_, seed), (error, _, flagged) in zip(runs, judged, strict=True):
            doubted.append(flagged[error <= good * np.median(clean["clean", seed].std.get(name) or [0.0])])
    f[">3σ"] = _share([np.any(each, axis=0) for each in zip(*(wrong[name] for name in "TwE"), strict=True)])
    f |= {"pos": _share(wrong["start"]), "doubted": _share(doubted)}
    f["lost"] = 100.0 - 100.0 * f["labels"] / max(sum(len(clean["clean", seed].bits) for _, seed in runs), 1)
    f["length"] = max((of.length for of in runs.values()), key=lambda length: abs(length - 1.0))
    f["changes"] = float(np.mean([of.changes for of in runs.values()]))
    told = [(KINDS[name][1], of) for (name, _), of in runs.items() if KINDS[name][1] and of.matters]
    f["named"] = _share([np.array([bool(re.search(said, of.lines[0])) for said, of in told])])
    return f | {"CPU s": float(np.mean([of.cpu_s for of in runs.values()]))}


def list_rows(outcomes: Outcomes) -> Iterator[str]:
    """Yield the table of outcomes and its summary."""
    yield f"{'kind':<28} {' '.join(name.rjust(int(form[0])) for name, form in FORMS.items())}  first line"
    groups = {kind: {key: of for key, of in outcomes.items() if key[0] == kind} for kind, _ in outcomes} | {
        "all": outcomes
    }
    for name, runs in groups.items():
        f, line = find_figures(runs, outcomes), "" if name == "all" else next(iter(runs.values())).lines[0]
        figures = " ".join(format(f[key], form).replace("nan", "  –") for key, form in FORMS.items())
        yield f"{name:<28} {figures}  {line[:80]}".rstrip()
    each = [find_figures({key: of}, outcomes) for key, of in outcomes.items()]
    met = [f["labels"] > 0 and not (min(f["T"], f["w"], f["E"]) < 92.0 or f["start"] < 90.0) for f in each]
    yield f"{np.mean(met):.0%} of {len(met)} runs have labels, T, w and E >= 92 %, and starts >= 90 % (wanted 85 %)."
    yield "Wanted of all: >3σ <= 0.3, doubted <= 5, named >= 85, no changes in clean runs."


def compare(first: Outcomes, second: Outcomes) -> Iterator[str]:
    """Yield how far the second's T, w and E of the same ground are from the first's, over the first's σ."""
    yield f"{'kind':<28} {'seed':>5} {'both':>5} {'median |Δ|/σ':>12} {'max':>7}"
    for key, a, b in ((key, a, second[key]) for key, a in first.items() if key in second and a.bits):
        apart_s = np.abs(np.array(a.start_s)[:, None] - np.array(b.start_s or [np.inf]))
        near, same = np.argmin(apart_s, axis=1), np.min(apart_s, axis=1) < 0.6
        moved = [(np.array(b.error.get(q) or [0.0])[near] - a.error[q])[same] / np.array(a.std[q])[same] for q in "TwE"]
        size = np.abs(np.concatenate(moved)) if same.any() else np.full(1, np.nan)
        yield f"{key[0]:<28} {key[1]:5d} {same.sum():5d} {np.nanmedian(size):12.2f} {np.nanmax(size):7.1f}"


def read(path: Path) -> Outcomes:
    """Return the outcomes of a file that this program wrote."""
    return {(run["kind"], run["seed"]): Outcome(**run["outcome"]) for run in json.loads(path.read_text())}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kinds", default="", metavar="REGEX", help="a regular expression that names of kinds hold")
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--first-seed", type=int, default=FIRST_SEED)
    parser.add_argument("--length", type=float, default=0.0, help="duration of a drive [s]; default: 150 to 240")
    parser.add_argument("--out", type=Path, help="a JSON file of all outcomes")
    parser.add_argument("--compare", type=Path, nargs=2, metavar=("A", "B"))
    given = parser.parse_args()
    if given.compare:
        print("\n".join(compare(*map(read, given.compare))))
        return
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY_BYTES, resource.RLIM_INFINITY))
    seeds = range(given.first_seed, given.first_seed + given.seeds)
    kinds = [name for name in KINDS if name == "clean" or re.search(given.kinds, name)]
    outcomes = {(name, seed): run_world(name, seed, given.length) for name in kinds for seed in seeds}
    if given.out:
        runs = [{"kind": kind, "seed": seed, "outcome": asdict(of)} for (kind, seed), of in outcomes.items()]
        given.out.write_text(json.dumps(runs))
    print("\n".join(list_rows(outcomes)))


if __name__ == "__main__":
    main()
