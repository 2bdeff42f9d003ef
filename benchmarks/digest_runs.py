"""The logs that `table_digests.py` ingests: simulated drives, copies of them with other messages, and third-party logs.

`tcpipe.simulation` makes the drives. `mcap` and `rosbags` change the messages, so that this module uses no internal
name of tcpipe. Add a new drive at the end of its table: the noise of a drive depends on its place there.
"""

from __future__ import annotations

import json
import tarfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, fields, replace
from functools import reduce
from pathlib import Path
from typing import Any

import numpy as np
from mcap.reader import make_reader
from mcap.writer import Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from tcpipe.simulation import Faults, find_scenario, make_tiny, simulate
from tcpipe.simulation.sensors import Doppler

SEED = 41
QUICK_DRIVES = 3
_LENGTH_M = 45.0
_STARTS_M = ((14.0, 34.0), (110.0, 30.0), (90.0, 55.0), (30.0, 60.0), (60.0, 30.0), (40.0, 20.0))
_NOISE = frozenset(f.name for f in fields(Faults) if f.name.endswith("_noise"))
_EVERY = frozenset(f.name for f in fields(Faults) if "clock" not in f.name)


@dataclass(frozen=True)
class Drive:
    """A simulated drive: what differs from the first drive of the scenario ``demo``."""

    sensors: dict[str, Any] = field(default_factory=dict)
    """By sensor: None leaves it out, a dict changes some of its fields, another value replaces it."""
    faults: frozenset[str] = _NOISE
    recorder: dict[str, Any] = field(default_factory=dict)
    container: str = "mcap"
    like: tuple[str, int] = ("demo", 0)
    """A scenario and the number of its drive."""
    keep_plan: bool = False


_ROS1 = {"dialect": "ros1", "power": "husky_status"}
_ONLY = {name: dict.fromkeys({"gnss", "wheels", "imu", "visual"} - set(name.split())) for name in (
    "gnss", "wheels", "visual", "gnss imu", "gnss wheels", "wheels imu", "visual imu",
)}  # fmt: skip
_UNKNOWN = {name: {"covariance": "unknown"} for name in ("gnss", "wheels", "visual")}

DRIVES: dict[str, Drive] = {
    "all sensors": Drive(),
    "every fault, ROS 1 bag": Drive(faults=_EVERY, recorder=_ROS1, container="bag"),
    "no visual": Drive({"visual": None}),
    "no faults": Drive(faults=frozenset()),
    "no wheels": Drive({"wheels": None}),
    "no IMU": Drive({"imu": None}),
    "GNSS alone": Drive(_ONLY["gnss"]),
    "GNSS alone 1 Hz": Drive({**_ONLY["gnss"], "gnss": {"rate_hz": 1.0}}),
    "GNSS, IMU": Drive(_ONLY["gnss imu"]),
    "GNSS 5 Hz, wheels": Drive({**_ONLY["gnss wheels"], "gnss": {"rate_hz": 5.0}}),
    "wheels, IMU": Drive(_ONLY["wheels imu"]),
    "wheels alone": Drive(_ONLY["wheels"]),
    "visual alone": Drive(_ONLY["visual"]),
    "visual, IMU": Drive(_ONLY["visual imu"]),
    "Doppler": Drive({"doppler": Doppler()}),
    "GNSS and Doppler alone": Drive({**_ONLY["gnss"], "doppler": Doppler()}),
    "no command": Drive({"command": None}),
    "no power": Drive({"power": None}),
    "ROS 1 in MCAP": Drive(recorder=_ROS1),
    "ROS 2 bag of sqlite3": Drive(container="rosbag2"),
    "ROS 2 bag of MCAP": Drive(container="rosbag2_mcap"),
    "power averaged at 1 Hz": Drive({"power": {"averaged": True, "rate_hz": 1.0}}),
    "power readings at 1 Hz repeated at 20 Hz": Drive({"power": {"reading_hz": 1.0}}),
    "visual pose, IMU without orientation": Drive({"visual": {"says": "pose"}, "imu": {"orientation": False}}),
    "covariances unknown": Drive(_UNKNOWN),
    "no placements": Drive(faults=_NOISE | {"gnss_lever_arm", "imu_mounting"}, recorder={"placements": False}),
    "the paper's robot": Drive(like=("paper_quick", 0)),
    "every manoeuvre": Drive(like=("manoeuvres", 0), keep_plan=True),
} | {f"fault {name}": Drive(faults=_NOISE | {name}) for name in sorted(_EVERY - _NOISE)} | {
    f"fault {f.name}": Drive(faults=_NOISE | {f.name}) for f in fields(Faults) if "clock" in f.name
}  # fmt: skip
"""By name. The first six also make the datasets."""

Change = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""From values, shape (messages, fields), or (messages, 1, elements) of an array field, and times since the log began
[s] to values.

Without fields: to a mask of the messages that stay."""
Edit = tuple[str, tuple[str, ...], Change]
"""The end of a topic's name, fields of its messages ("stamp": the header's, in nanoseconds), and their change."""

_GNSS, _IMU, _WHEELS, _VISUAL = "gps_0/fix", "imu_0/data", "platform/odom", "zed_node/odom"
_POWER, _COMMAND = "status/power", "platform/cmd_vel"
_PLACE = ("latitude", "longitude", "altitude")
_RATE = tuple(f"angular_velocity.{axis}" for axis in "xyz")
_FORCE = tuple(f"linear_acceleration.{axis}" for axis in "xyz")
_TWIST = tuple(f"twist.twist.{kind}.{axis}" for kind in ("linear", "angular") for axis in "xyz")
_SPEED, _TURN, _STAMP = ("twist.twist.linear.x",), ("twist.twist.angular.z",), ("stamp",)
_AMPS = ("measured_currents",)
_METRE_DEG = np.array([9e-6, 1.3e-5, 0.0])
_PITCH = np.array([[0.99619, 0.0, 0.08716], [0.0, 1.0, 0.0], [-0.08716, 0.0, 0.99619]])


def scale(factor: float, first_s: float = 0.0, last_s: float = np.inf) -> Change:
    return lambda v, t: np.where(_fit((t >= first_s) & (t < last_s), v), v * factor, v)


def shift(offset: Any, first_s: float = 0.0, last_s: float = np.inf) -> Change:
    return lambda v, t: v + (offset * _fit((t >= first_s) & (t < last_s), v)).astype(v.dtype)


def freeze(first_s: float) -> Change:
    return lambda v, t: np.where(_fit(t >= first_s, v), v[np.searchsorted(t, first_s)], v)


def scatter(value: float, share: float) -> Change:
    return lambda v, t: np.where(_fit(_make_random(6).random(t.size) < share, v), value, v)


def drop(first_s: float, last_s: float) -> Change:
    return lambda _, t: (t < first_s) | (t >= last_s)


def wander(step_m: float) -> Change:
    return lambda v, t: v + np.cumsum(_make_random(7).normal(0.0, step_m, (t.size, 3)), axis=0) * _METRE_DEG


def _make_random(seed: int) -> np.random.Generator:
    return np.random.default_rng(seed)


def _fit(where: np.ndarray, values: np.ndarray) -> np.ndarray:
    return where.reshape(-1, *[1] * (values.ndim - 1))


EDITS: dict[str, tuple[Edit, ...]] = {
    "wrong fixes for 20 s": ((_GNSS, _PLACE, shift(0.5 * _METRE_DEG, 25.0, 45.0)),),
    "fixes astray": ((_GNSS, _PLACE, wander(0.3)),),
    "frozen fixes": ((_GNSS, _PLACE, freeze(30.0)),),
    "fixes at zero": ((_GNSS, _PLACE, scatter(0.0, 0.2)),),
    "no altitude": ((_GNSS, _PLACE[2:], scatter(np.nan, 1.0)),),
    "exchanged axes": ((_GNSS, _PLACE[:2], lambda v, _: v[:, ::-1]),),
    "fixes of 2.3 m": ((_GNSS, _PLACE, wander(0.1)), (_GNSS, ("position_covariance",), lambda v, _: v * 2e4)),
    "fixes late by 0.2 s": ((_GNSS, _STAMP, shift(200_000_000)),),
    "fixes with a drifting clock": ((_GNSS, _STAMP, lambda v, t: v + (3e6 * t)[:, None].astype(np.int64)),),
    "fixes with stamps of zero": ((_GNSS, _STAMP, scatter(0, 1.0)),),
    "negative covariances": (
        (_GNSS, ("position_covariance",), scale(-1.0)),
        (_WHEELS, ("twist.covariance",), scale(-1.0)),
    ),
    "wheels 1.3 too fast": ((_WHEELS, _SPEED, scale(1.3)),),
    "wheels slip for 20 s": ((_WHEELS, _SPEED, scale(1.43, 25.0, 45.0)),),
    "wheels backwards": ((_WHEELS, _SPEED, scale(-1.0)),),
    "wheels in km/h": ((_WHEELS, _SPEED, scale(3.6)),),
    "wheels without turns": ((_WHEELS, _TURN, scale(0.0)),),
    "wheels late by 0.15 s in their second half": ((_WHEELS, _STAMP, shift(150_000_000, 40.0)),),
    "IMU in degrees": ((_IMU, _RATE, scale(57.29578)),),
    "IMU without force": ((_IMU, _FORCE, scale(0.0)),),
    "IMU pitched by 5 degrees": tuple((_IMU, names, lambda v, _: v @ _PITCH) for names in (_RATE, _FORCE)),
    "IMU biases jump": ((_IMU, _RATE, shift(0.03, 40.0)), (_IMU, _FORCE, shift(0.3, 40.0))),
    "visual dead": ((_VISUAL, _TWIST, scale(0.0)),),
    "visual 1.3 too fast": ((_VISUAL, _TWIST, scale(1.3)),),
    "currents of the other sign": ((_POWER, _AMPS, scale(-1.0)),),
    "currents without sign": ((_POWER, _AMPS, lambda v, _: np.abs(v)),),
    "currents off by 50 A": ((_POWER, _AMPS, shift(50.0)),),
    "currents NaN here and there": ((_POWER, _AMPS, scatter(np.nan, 0.01)),),
    "a gap in each sensor": tuple(
        (topic, (), drop(20.0 + 4.0 * k, 22.5 + 4.0 * k))
        for k, topic in enumerate((_GNSS, _IMU, _WHEELS, _VISUAL, _POWER, _COMMAND))
    ),
    "a gap in all sensors": tuple(
        (topic, (), drop(30.0, 36.0)) for topic in (_GNSS, _IMU, _WHEELS, _VISUAL, _POWER, _COMMAND)
    ),
    "5 s": tuple((topic, (), drop(5.0, np.inf)) for topic in (_GNSS, _IMU, _WHEELS, _POWER, _COMMAND)),
}
"""Copies, by name: of the drive "all sensors" where an edit is of the visual odometry, else of "no visual"."""

REAL = (
    "warthog_grass_a/run.mcap", "robot_localization/test1.bag", "robot_localization/test2.bag",
    "robot_localization/test1_2014.bag", "damaged/husky_test1.bag.active", "damaged/husky_test1_byteflip.bag",
    "damaged/husky_test1_crc_zstd.mcap", "damaged/husky_test1_crc_zstd_byteflip.mcap",
    "damaged/husky_test1_truncated.mcap", "damaged/husky_test1_truncated60.bag",
    "damaged/husky_test1_rosbag2_dirs.tar.xz/husky_test1_ros2_sqlite3",
    "damaged/husky_test1_rosbag2_dirs.tar.xz/husky_test1_ros2_truncdb3",
    "damaged/husky_test1_rosbag2_dirs.tar.xz/husky_test1_ros2_mcap",
    "damaged/husky_test1_rosbag2_dirs.tar.xz/husky_test1_ros2_nometadata",
    "peers/ros_amr_interop/rosbag_demo.bag", "peers/rosbag.js/fixtures/example.bag",
    "peers/rosbag.js/fixtures/empty-file.bag", "peers/rosbags-rs/tests/test_bags/test_bag_mcap",
    "peers/rosbags-rs/tests/test_bags/test_bag_sqlite3",
    "peers/rosbag2/rosbag2_cpp/test/rosbag2_cpp/bags/topics_and_services.db3",
)  # fmt: skip
"""Below $TCPIPE_TEST_DATA; ``A.tar.xz/B`` is B in the archive A."""


def make_drives(out: Path, *, quick: bool) -> dict[str, Path]:
    """Simulate the drives and copy some with changes, unless they exist below ``out``; return the logs by name."""
    listed = out / "logs.json"
    if listed.exists():
        found = list(json.loads(listed.read_text()).items())[: QUICK_DRIVES if quick else None]
        return {name: out / path for name, path in found}
    chosen = dict(list(DRIVES.items())[: QUICK_DRIVES if quick else None])
    specs = tuple(_specify(number, drive) for number, drive in enumerate(chosen.values()))
    site = simulate(out / "site", scenario=replace(make_tiny(), drives=specs), seed=SEED)
    logs = dict(zip(chosen, site.logs, strict=True))
    (out / "changed").mkdir(exist_ok=True)
    for number, (name, edits) in enumerate({} if quick else EDITS.items()):
        base = "all sensors" if any(topic == _VISUAL for topic, _, _ in edits) else "no visual"
        logs[name] = out / "changed" / f"{number:02d}_changed.mcap"
        change_log(logs[base], logs[name], edits)
    listed.write_text(json.dumps({name: str(log.relative_to(out)) for name, log in logs.items()}, indent=1))
    return logs


def _specify(number: int, drive: Drive) -> Any:
    name, of = drive.like
    spec = find_scenario(name).drives[of]
    sensors = {
        name: replace(getattr(spec.sensors, name), **change) if isinstance(change, dict) else change
        for name, change in drive.sensors.items()
    }
    start_m = spec.start_m if drive.keep_plan else _STARTS_M[number % len(_STARTS_M)]
    plan = spec.plan if drive.keep_plan else replace(spec.plan, length_m=_LENGTH_M, start_m=start_m)
    return replace(
        spec, name=f"{number:02d}_drive", plan=plan, start_m=start_m, container=drive.container,
        sensors=replace(spec.sensors, **sensors), faults=Faults.only(*drive.faults),
        recorder=replace(spec.recorder, **drive.recorder),
    )  # fmt: skip


def change_log(log: Path, out: Path, edits: tuple[Edit, ...]) -> None:
    """Write a copy of a ROS 2 MCAP log with some messages changed or left out."""
    with log.open("rb") as stream:
        rows = list(make_reader(stream).iter_messages())
    types, first_ns = get_typestore(Stores.ROS2_HUMBLE), rows[0][2].log_time
    for schema in {schema.name: schema for schema, _, _ in rows}.values():
        if schema.name not in types.types:
            types.register(get_types_from_msg(schema.data.decode(), schema.name))
    data = [message.data for _, _, message in rows]
    keep = np.ones(len(rows), bool)
    for topic, names, change in edits:
        places = [k for k, (_, channel, _) in enumerate(rows) if channel.topic.endswith(topic)]
        at_s = np.array([rows[k][2].log_time - first_ns for k in places]) * 1e-9
        if not names:
            keep[places] &= change(at_s, at_s)
            continue
        kind = rows[places[0]][0].name
        messages = [types.deserialize_cdr(data[k], kind) for k in places]
        values = np.stack([[_get(message, name) for name in names] for message in messages])
        for k, message, row in zip(places, messages, change(values, at_s), strict=True):
            for name, value in zip(names, row, strict=True):
                _put(message, name, value)
            data[k] = bytes(types.serialize_cdr(message, kind))
    with out.open("wb") as stream:
        writer, ids = Writer(stream), {}
        writer.start(profile="ros2", library="changed")
        for kept, payload, (schema, channel, message) in zip(keep, data, rows, strict=True):
            if kept and channel.topic not in ids:
                known = writer.register_schema(schema.name, schema.encoding, schema.data)
                ids[channel.topic] = writer.register_channel(channel.topic, channel.message_encoding, known)
            if kept:
                writer.add_message(ids[channel.topic], message.log_time, payload, message.publish_time)
        writer.finish()


def _get(message: Any, name: str) -> Any:
    if name == "stamp":
        return message.header.stamp.sec * 1_000_000_000 + message.header.stamp.nanosec
    return reduce(getattr, name.split("."), message)


def _put(message: Any, name: str, value: Any) -> None:
    if name == "stamp":
        _put(message, "header.stamp.sec", value // 1_000_000_000)
        _put(message, "header.stamp.nanosec", value % 1_000_000_000)
        return
    *parents, leaf = name.split(".")
    owner = reduce(getattr, parents, message)
    old = getattr(owner, leaf)
    object.__setattr__(owner, leaf, value.astype(old.dtype) if isinstance(old, np.ndarray) else value.item())


def find_real_logs(data: Path, out: Path) -> Iterator[tuple[str, Path]]:
    """Yield the third-party logs that exist here by name, unpacked from their archives."""
    for name in REAL:
        archive, packed, inside = name.partition(".tar.xz/")
        if packed and (data / f"{archive}.tar.xz").exists():
            with tarfile.open(data / f"{archive}.tar.xz") as tar:
                members = [member for member in tar if member.name.split("/")[0] == inside]
                tar.extractall(out / "unpacked", members, filter="data")
            yield name, out / "unpacked" / inside
        else:
            yield name, data / name
