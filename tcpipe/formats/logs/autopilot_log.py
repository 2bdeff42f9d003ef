"""An autopilot's log behind the face of a log: each message name is a topic with its own fields, and what roles can use a topic beside it.

``/sensor_combined`` has PX4's own fields, which the recipe can map; ``/sensor_combined/imu`` has them as sensor_msgs/Imu.
"""

from __future__ import annotations

import re
from contextlib import ExitStack
from functools import partial
from pathlib import Path

import numpy as np
import pyarrow as pa

from tcpipe.formats.logs.autopilot_records import read_records
from tcpipe.formats.logs.message_tables import Fields, TableLog, make_stamp_fields, make_topic
from tcpipe.logs.autopilot import (
    CONVERTED,
    Autopilot,
    Int64,
    LeverArms,
    RoleMessages,
    find_lever_arms,
    find_utc_offset_us,
    make_role_messages,
    select_fields,
)
from tcpipe.logs.roles import ODOMETRY, TRANSFORMS
from tcpipe.logs.topics import AutopilotKind, find_damage
from tcpipe.tables.findings import Subject, make_finding

_OWN_PACKAGES = {"ulog": "px4", "dataflash": "ardupilot"}


def open_autopilot_log(path: Path, kind: AutopilotKind, stack: ExitStack) -> TableLog:
    """Read a ``ulog`` or ``dataflash`` log; ``stack`` is closed with it. `LogError`: it cannot be read."""
    records = read_records(path, kind)
    known = {name: message for name, message in records.messages.items() if _find_base(name) in CONVERTED}
    messages = {
        name: (message.time_us, select_fields(message.read_columns(records.data))) for name, message in known.items()
    }
    log = Autopilot(kind, messages, records.parameters)
    with np.errstate(all="ignore"):  # what is not finite is counted where the values are used
        converted, findings = make_role_messages(log)
        offset_us, lever_arms = find_utc_offset_us(log), find_lever_arms(log.parameters)
    topics = [
        make_topic(
            f"/{name}",
            f"{_OWN_PACKAGES[kind]}/msg/{_find_base(name)}",
            (message.time_us + offset_us) * 1000,
            partial(message.read_columns, records.data),
        )
        for name, message in records.messages.items()
    ]
    for role in converted:
        stamp_ns = (role.time_us + offset_us) * 1000
        topics.append(
            make_topic(role.topic, role.type_name, stamp_ns, partial(_make_stamped, role, stamp_ns, lever_arms))
        )
    if lever_arms and converted:
        start_ns = (converted[0].time_us[:1] + offset_us) * 1000
        topics.append(make_topic("/tf_static", TRANSFORMS[0], start_ns, partial(_make_transforms, lever_arms)))
    findings += find_damage(records.damage)
    if records.dropouts:
        findings.append(make_finding("logger-dropouts", Subject("file", path.name), dropouts_count=records.dropouts))
    return TableLog(path, kind, topics, [path], findings=findings, stack=stack)


def _find_base(name: str) -> str:
    """Return the name of messages without the number of their instance."""
    return re.sub(r"_\d+$", "", name)


def _make_stamped(messages: RoleMessages, stamp_ns: Int64, lever_arms: LeverArms) -> Fields:
    """Return a message's fields with stamp and frame; what its values are given in is base_link where nothing places an IMU."""
    frame = "base_link" if messages.frame == "imu" and messages.frame not in lever_arms else messages.frame
    column = "child_frame_id" if messages.type_name == ODOMETRY else "header.frame_id"
    return {**make_stamp_fields(stamp_ns), **messages.columns, column: pa.repeat(frame, len(stamp_ns))}


_NO_TURN = {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}


def _make_transforms(lever_arms: LeverArms) -> Fields:
    """Return the lever arms of sensors as one message of static transforms."""
    rows = [
        {
            "header": {"frame_id": "base_link"},
            "child_frame_id": frame,
            "transform": {"translation": dict(zip("xyz", xyz_m, strict=True)), "rotation": _NO_TURN},
        }
        for frame, xyz_m in lever_arms.items()
    ]
    return {"transforms": pa.array([rows])}
