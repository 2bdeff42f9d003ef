"""An autopilot's log behind the face of a log: each message name is a topic with its own fields, and what roles can use a topic beside it.

``/sensor_combined`` has PX4's own fields, which the recipe can map; ``/sensor_combined/imu`` has them as sensor_msgs/Imu.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from contextlib import ExitStack
from functools import partial
from pathlib import Path

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from tcpipe.formats.logs.autopilot_records import AutopilotRecords, Messages, read_records
from tcpipe.formats.logs.message_tables import TableLog, TopicMessages, make_message_table, make_stamp_fields
from tcpipe.logs.autopilot import (
    CONVERTED,
    Autopilot,
    RoleMessages,
    find_places,
    find_utc_offset_us,
    make_role_messages,
    select_fields,
)
from tcpipe.logs.roles import ODOMETRY, TRANSFORMS
from tcpipe.logs.topics import AutopilotKind, Topic, find_damage
from tcpipe.tables.arrays import make_column
from tcpipe.tables.findings import Subject, make_finding

_OWN_TYPES = {"ulog": "px4", "dataflash": "ardupilot"}


def open_autopilot_log(path: Path, kind: AutopilotKind, stack: ExitStack) -> TableLog:
    """Read a ``ulog`` or ``dataflash`` log; ``stack`` is closed with it. `LogError`: it cannot be read."""
    records = read_records(path, kind)
    known = {name: of for name, of in records.messages.items() if _find_base(name) in CONVERTED}
    messages = {name: (of.time_us, select_fields(of.read_columns(records.data))) for name, of in known.items()}
    log = Autopilot(kind, messages, records.parameters)
    with np.errstate(all="ignore"):  # what is not finite is counted where the values are used
        converted, findings = make_role_messages(log)
        offset_us, places = find_utc_offset_us(log), find_places(log.parameters)
    own = [_make_own(records, name, of, _OWN_TYPES[kind], offset_us) for name, of in records.messages.items()]
    of_roles = [_make_of_role(of, places, offset_us) for of in converted]
    findings += find_damage(records.damage)
    if records.dropouts:
        findings.append(make_finding("logger-dropouts", Subject("file", path.name), dropouts_count=records.dropouts))
    transforms = [_make_transforms(places, of_roles[0].topic.start_ns or 0)] if places and of_roles else []
    return TableLog(path, kind, [*own, *of_roles, *transforms], [path], findings=findings, stack=stack)


def _find_base(name: str) -> str:
    """Return the name of messages without the number of their instance."""
    return re.sub(r"_\d+$", "", name)


def _make_own(records: AutopilotRecords, name: str, of: Messages, package: str, offset_us: int) -> TopicMessages:
    """Return a topic of the autopilot's own messages."""
    stamp_ns = (of.time_us + offset_us) * 1000
    type_name = f"{package}/msg/{_find_base(name)}"
    return _make_topic(
        f"/{name}", type_name, stamp_ns, lambda: make_message_table(stamp_ns, of.read_columns(records.data))
    )


def _make_of_role(of: RoleMessages, places: dict[str, tuple[float, float, float]], offset_us: int) -> TopicMessages:
    """Return a topic that a role can use; what its messages are given in is base_link where nothing places an IMU."""
    stamp_ns = (of.time_us + offset_us) * 1000
    frame = "base_link" if of.frame == "imu" and of.frame not in places else of.frame
    return _make_topic(of.topic, of.type_name, stamp_ns, partial(_make_stamped, of, stamp_ns, frame))


def _make_stamped(of: RoleMessages, stamp_ns: NDArray[np.int64], frame: str) -> pa.Table:
    table = make_message_table(stamp_ns, {**make_stamp_fields(stamp_ns), **of.columns})
    column = "child_frame_id" if of.type_name == ODOMETRY else "header.frame_id"
    return table.append_column(column, pa.repeat(frame, len(stamp_ns)))


def _make_topic(name: str, type_name: str, stamp_ns: NDArray[np.int64], make: Callable[[], pa.Table]) -> TopicMessages:
    return TopicMessages(Topic(name, type_name, len(stamp_ns), int(stamp_ns[0]), int(stamp_ns[-1]), "table", ""), make)


_VECTOR, _QUATERNION = (pa.struct([(axis, pa.float64()) for axis in axes]) for axes in ("xyz", "xyzw"))
_TRANSFORM = pa.struct(
    [
        ("header", pa.struct([("frame_id", pa.string())])),
        ("child_frame_id", pa.string()),
        ("transform", pa.struct([("translation", _VECTOR), ("rotation", _QUATERNION)])),
    ]
)


def _make_transforms(places: dict[str, tuple[float, float, float]], start_ns: int) -> TopicMessages:
    """Return the places of sensors as a static transform."""
    rows = [
        {
            "header": {"frame_id": "base_link"},
            "child_frame_id": frame,
            "transform": {
                "translation": dict(zip("xyz", xyz_m, strict=True)),
                "rotation": dict(zip("xyzw", (0.0, 0.0, 0.0, 1.0), strict=True)),
            },
        }
        for frame, xyz_m in places.items()
    ]
    stamp_ns = np.array([start_ns])
    table = make_message_table(stamp_ns, {}).append_column("transforms", make_column([rows], pa.list_(_TRANSFORM)))
    return _make_topic("/tf_static", TRANSFORMS[0], stamp_ns, lambda: table)
