"""Autopilot logs with the interface of a log: one topic for each message name, and topics that roles can use.

``/sensor_combined`` has PX4's own fields, which the recipe can map; ``/sensor_combined/imu`` has them as
sensor_msgs/Imu.
"""

import re
import struct
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import numpy as np
import pyarrow as pa
from numpy.typing import DTypeLike

from tcpipe.arrays import AnyArray, Ints, Mask, gather_values
from tcpipe.errors import LogError
from tcpipe.formats.logs.log_file import MAX_COLUMNS, MAX_TOPICS
from tcpipe.formats.logs.log_part import gather_integers
from tcpipe.formats.logs.message_tables import Fields, TableLog, make_stamp_fields, make_topic
from tcpipe.logs.autopilot import (
    CONVERTED,
    LATEST_US,
    Autopilot,
    LeverArms,
    RoleMessages,
    find_lever_arms,
    find_utc_offset_us,
    make_role_messages,
    select_fields,
)
from tcpipe.logs.roles import ODOMETRY, TRANSFORMS
from tcpipe.logs.topics import AutopilotKind, Damage, find_damage
from tcpipe.tables.findings import Subject, make_finding

_HEAD = b"\xa3\x95"
_FORMAT, _FORMAT_BYTES = 0x80, 89
_STRAY_US, _LATE_US = 1_000_000, 3_600 * 10**6
_WINDOW = 5  # number of successive messages whose median reveals a wrong stamp
# Most digits of a list's length, and most levels of nested formats [1]; a format with more is damaged.
_MOST_DIGITS, _DEEPEST = 5, 5

Layout = np.dtype[np.void]


@dataclass(slots=True)
class AutopilotMessages:
    """Messages of one name and instance: times since boot [µs] and offsets in the file, shape (N,) each.

    ``scales`` maps a field to the size of one integer step in the field's unit.
    """

    name: str
    layout: Layout
    offsets: Ints
    time_us: Ints
    scales: Mapping[str, float]

    def read_columns(self, data: bytes) -> dict[str, AnyArray]:
        """Return the values of each field by its name, shape (N,) or (N, k)."""
        rows = gather_values(data, self.offsets, self.layout)
        return {
            name: rows[name] * self.scales[name] if name in self.scales else rows[name]
            for name in self.layout.names or ()
        }


def _gather_field(data: bytes, offsets: Ints, layout: Layout, name: str) -> Ints:
    """Return the integer field ``name`` of each message, shape (N,)."""
    offset: int = layout.fields[name][1]  # type: ignore[index]  # a layout that has the field has fields
    return gather_integers(data, offsets + offset, layout[name].str[1:].replace("u8", "i8"))


_CLOCKS = {"timestamp": 1, "TimeUS": 1, "T": 1000, "TimeMS": 1000}
"""Unit of a time field [µs], by name; ArduPilot wrote milliseconds before 2015; the TimeMS of a GPS counts from the start of the week."""


@dataclass(slots=True)
class AutopilotRecords:
    """Content of a log: messages by name (further instances end in ``_1`` …), parameters, damage, and lost messages.

    ``dropouts`` counts how often the logger could not keep up.
    """

    path: Path
    data: bytes
    messages: dict[str, AutopilotMessages] = field(default_factory=dict)
    parameters: dict[str, float] = field(default_factory=dict)
    damage: dict[Damage, None] = field(default_factory=dict)
    dropouts: int = 0

    def add_damage(
        self, cause: str, topic: str | None = None, lost: int | None = None, *, reason: str = "", places: int = 1
    ) -> None:
        """Add damage, up to a limit of some thousand entries."""
        self._note(Damage(cause, self.path.name, topic=topic, messages_lost=lost, reason=reason, places=places))

    def skip_to(self, start: int, end: int) -> int:
        """Record that the bytes from ``start`` to ``end`` cannot be read; return ``end``."""
        cause = "record-damaged" if end < len(self.data) else "file-cut"
        self._note(Damage(cause, self.path.name, offset=start, bytes_lost=end - start))
        return end

    def _note(self, damage: Damage) -> None:
        if len(self.damage) < MAX_TOPICS:
            self.damage[damage] = None

    def add(self, name: str, instance: int, layout: Layout, offsets: Ints, scales: Mapping[str, float]) -> None:
        """Add the messages of an instance; record damage instead if they have no time."""
        clock = next(
            (field for field in _CLOCKS if field in (layout.names or ()) and layout[field].str in ("<u8", "<u4")), None
        )
        if clock is None:
            self.add_damage("messages-not-decoded", f"/{name}", 0, reason=f"{name} has no time")
            return
        if len(self.messages) >= MAX_TOPICS:
            raise LogError(f"{self.path}: it contains more than {MAX_TOPICS} topics; tcpipe does not read such a log")
        stamps = _gather_field(self.data, offsets, layout, clock) * _CLOCKS[clock]
        self.messages[f"{name}_{instance}" if instance else name] = AutopilotMessages(
            name, layout, offsets, stamps, scales
        )

    def sort_by_time(self) -> None:
        """Sort messages by time; exclude and count times that are far from their neighbours' or the log's end."""
        ends = [
            float(np.median(message.time_us[-_WINDOW:]))
            for message in self.messages.values()
            if len(message.time_us) >= _WINDOW
        ]
        latest_us = min(max(ends, default=LATEST_US) + _LATE_US, LATEST_US)
        for name, message in list(self.messages.items()):
            is_valid = (message.time_us >= 0) & (message.time_us <= latest_us) & ~_find_stray(message.time_us)
            if lost := int(np.count_nonzero(~is_valid)):
                self.add_damage("time-invalid", f"/{name}", lost)
            message.offsets, message.time_us = message.offsets[is_valid], message.time_us[is_valid]
            if late := int(np.count_nonzero(np.diff(message.time_us) < 0)):
                self.add_damage("messages-unordered", f"/{name}", 0, places=late)
                order = np.argsort(message.time_us, kind="stable")
                message.offsets, message.time_us = message.offsets[order], message.time_us[order]
            if not len(message.time_us):
                del self.messages[name]


def _find_stray(time_us: Ints) -> Mask:
    """Mark times, in the order of the file, that are far from the median of their neighbours, shape (N,)."""
    steps = np.diff(time_us)
    if len(time_us) < _WINDOW or not (steps < 0).any():
        return np.zeros(len(time_us), bool)
    around = np.lib.stride_tricks.sliding_window_view(np.pad(time_us, _WINDOW // 2, mode="edge"), _WINDOW)
    return np.asarray(np.abs(time_us - np.median(around, axis=1)) > _STRAY_US + 10 * np.median(np.abs(steps)))


def read_autopilot_records(path: Path, kind: AutopilotKind) -> AutopilotRecords:
    """Return the content of a ``ulog`` or ``dataflash`` log; `LogError` if it is unreadable or would exhaust memory."""
    try:
        records = AutopilotRecords(path, path.read_bytes())
    except OSError as error:
        raise LogError(f"{path}: it cannot be read ({error.strerror})") from None
    _UlogReader(records).read() if kind == "ulog" else _read_dataflash(records)
    records.add_damage("no-checksum", lost=0)
    records.sort_by_time()
    return records


# ---------------------------------------------------------------- PX4
_ULOG_TYPES = {
    **{f"{sign}int{bits}_t": f"<{sign or 'i'}{bits // 8}" for bits in (8, 16, 32, 64) for sign in ("", "u")},
    "float": "<f4",
    "double": "<f8",
    "bool": "<u1",
    "char": "S",
}
_ULOG_KINDS = frozenset(b"FDIMPQARSOLCB")
_ULOG_HEAD = struct.Struct("<HBH")  # size and kind of a message, and the number at the start of a data message
_MOST_BYTES = (1 << 16) - 3
_DATA = ord("D")


def _parse_field(text: str) -> tuple[str, int, str] | None:
    """Return type, count (0: no list) and name of a field such as ``float[3] rate``; None if it is no field."""
    type_name, _, name = text.partition(" ")
    kind, opening, count = type_name.removesuffix("]").partition("[")
    number = int(count) if count.isdecimal() and len(count) <= _MOST_DIGITS else 0
    is_field = kind.isidentifier() and name.isidentifier() and bool(number) == bool(opening)
    return (kind, number, name) if is_field else None


@dataclass(slots=True)
class _UlogTopic:
    """A subscribed topic: layout of its messages, their largest size with padding [byte], and their offsets."""

    name: str
    instance: int
    layout: Layout
    most_bytes: int
    offsets: list[int] = field(default_factory=list)

    def fits(self, size: int) -> bool:
        """Return whether a message with this number of bytes after its header can have this format."""
        return self.layout.itemsize <= size - 2 <= self.most_bytes


class _UlogReader:
    """Reads the messages of a ULog, in one pass."""

    def __init__(self, records: AutopilotRecords) -> None:
        self._records, self._data = records, records.data
        self._formats: dict[str, list[tuple[str, int, str]]] = {}
        self._layouts: dict[str, tuple[Layout, int] | str] = {}
        self._topics: dict[tuple[str, int], _UlogTopic] = {}
        self._by_id: dict[int, _UlogTopic] = {}
        self._unknown: Counter[int] = Counter()
        self._columns = 0

    def read(self) -> None:
        """Read the whole file into the records."""
        at, end_of_data = 16, len(self._data)
        while at + 5 <= end_of_data:
            size, kind, number = _ULOG_HEAD.unpack_from(self._data, at)
            end = at + 3 + size
            topic = self._by_id.get(number) if kind == _DATA else None
            fits = topic.fits(size) if topic else kind in _ULOG_KINDS and self._is_head(end)
            if not fits or end > end_of_data:
                end = self._records.skip_to(at, self._find_next(at + 1))
            elif topic:
                topic.offsets.append(at + 5)
            else:
                self._read_message(kind, at + 3, size)
            at = end
        if at < end_of_data:
            self._records.skip_to(at, end_of_data)
        for number, count in self._unknown.items():
            reason = f"nothing says what messages of number {number} are"
            self._records.add_damage("messages-not-decoded", lost=count, reason=reason)
        for topic in self._topics.values():
            if topic.offsets:
                self._records.add(topic.name, topic.instance, topic.layout, np.array(topic.offsets), {})

    def _is_head(self, at: int) -> bool:
        return at >= len(self._data) or (at + 3 <= len(self._data) and self._data[at + 2] in _ULOG_KINDS)

    def _find_next(self, start: int) -> int:
        """Return the offset of the next message of a known topic; the size of the file without one."""
        at = self._data.find(_DATA, start + 2)
        while 0 <= at <= len(self._data) - 3:
            size, _, number = _ULOG_HEAD.unpack_from(self._data, at - 2)
            if number in self._by_id and self._by_id[number].fits(size):
                return at - 2
            at = self._data.find(_DATA, at + 1)
        return len(self._data)

    def _read_message(self, kind: int, at: int, size: int) -> None:
        """Read a message that contains no data of a known topic."""
        text = self._data[at : at + size]
        match chr(kind):
            case "D":
                self._unknown[int.from_bytes(text[:2], "little")] += 1
            case "F":
                name, _, fields = text.decode("ascii", "replace").removesuffix(";").partition(":")
                parsed = [field for field in map(_parse_field, fields.split(";")) if field]
                if len(parsed) > fields.count(";"):
                    self._formats.setdefault(name, parsed)
                else:
                    self._records.skip_to(at - 3, at + size)
            case "A" if size > 3:
                self._subscribe(text[0], int.from_bytes(text[1:3], "little"), text[3:].decode("ascii", "replace"))
            case "P" if size > 5 and len(text) == 5 + text[0]:
                type_name, _, name = text[1:-4].decode("ascii", "replace").partition(" ")
                code = "<f" if type_name == "float" else "<i"
                self._records.parameters[name] = float(struct.unpack(code, text[-4:])[0])
            case "B" if text[8:9] > b"\1" or any(text[9:16]):
                raise LogError(f"{self._records.path}: it uses features of ULog that tcpipe does not know")
            case "O":
                self._records.dropouts += 1
            case "A" | "P":
                self._records.skip_to(at - 3, at + size)
            case _:  # log texts, information and synchronisation are not used
                pass

    def _subscribe(self, instance: int, number: int, name: str) -> None:
        """Add the topic of a subscription; record damage if the layout of its messages is unknown."""
        if name not in self._layouts:
            self._layouts[name] = self._make_layout(name)
            if self._columns > MAX_COLUMNS:
                raise LogError(f"{self._records.path}: its topics expand to more than {MAX_COLUMNS} columns")
        layout = self._layouts[name]
        self._by_id.pop(number, None)
        if isinstance(layout, str):
            self._records.add_damage("messages-not-decoded", f"/{name}", reason=layout)
            return
        self._by_id[number] = self._topics.setdefault((name, instance), _UlogTopic(name, instance, *layout))

    def _make_layout(self, name: str) -> tuple[Layout, int] | str:
        """Return the layout of messages of a format and their padded size [byte], or the reason why it is unknown."""
        fields: list[tuple[str, DTypeLike]] = []
        size = 0
        try:
            for field_name, code in self._iterate_fields(name, "", 0):
                fields.append((field_name, code))
                size += np.dtype(code).itemsize
                if size > _MOST_BYTES:
                    return f"a message of {name} would be longer than any can be"
            self._columns += len(fields)
            used = list(fields)
            while used and used[-1][0].startswith("_padding"):
                used.pop()
            return np.dtype(used), size
        except (KeyError, ValueError, TypeError) as error:
            return f"its format {name} is damaged ({error})"

    def _iterate_fields(self, name: str, prefix: str, depth: int) -> Iterator[tuple[str, DTypeLike]]:
        """Yield name and type of each field; a nested format gives ``outer.inner``, an array of them ``outer_0.inner``."""
        if depth > _DEEPEST:
            raise ValueError("formats inside formats")
        for type_name, count, field_name in self._formats[name]:
            code = _ULOG_TYPES.get(type_name)
            if code is not None:
                yield prefix + field_name, f"S{count or 1}" if code == "S" else (code, (count,)) if count else code
                continue
            for index in range(count or 1):
                inner = f"{prefix}{field_name}_{index}." if count else f"{prefix}{field_name}."
                yield from self._iterate_fields(type_name, inner, depth + 1)


# ---------------------------------------------------------------- ArduPilot
_DATAFLASH_TYPES: dict[str, tuple[DTypeLike, float | None]] = {
    "b": ("i1", None), "B": ("u1", None), "M": ("u1", None), "h": ("<i2", None), "H": ("<u2", None),
    "i": ("<i4", None), "I": ("<u4", None), "q": ("<i8", None), "Q": ("<u8", None),
    "g": ("<f2", None), "f": ("<f4", None), "d": ("<f8", None),
    "c": ("<i2", 0.01), "C": ("<u2", 0.01), "e": ("<i4", 0.01), "E": ("<u4", 0.01), "L": ("<i4", 1e-7),
    "n": ("S4", None), "N": ("S16", None), "Z": ("S64", None), "a": (("<i2", (32,)), None),
}  # fmt: skip
"""By letter of a format: type of a field, and the size of one step in its unit."""
_INSTANCES = ("I", "Inst", "Instance")
_WITHOUT_TIME = ("FMT", "FILE")


def _read_dataflash(records: AutopilotRecords) -> None:
    """Read a whole DataFlash log into the records."""
    data, end_of_data, at = records.data, len(records.data), 0
    lengths, offsets = [0] * 256, [list[int]() for _ in range(256)]
    formats: dict[int, tuple[str, Layout, dict[str, float]]] = {}
    lengths[_FORMAT] = _FORMAT_BYTES
    starts_with = data.startswith
    while at + 3 <= end_of_data:
        kind = data[at + 2]
        end = at + lengths[kind]
        if end > at and (starts_with(_HEAD, end) or end == end_of_data) and starts_with(_HEAD, at):
            offsets[kind].append(at + 3)
            if kind == _FORMAT:
                _define_format(data, at + 3, lengths, formats)
            at = end
            continue
        at = records.skip_to(at, _find_message(data, at + 1, lengths))
    if at < end_of_data:
        records.skip_to(at, end_of_data)
    for kind, (name, layout, scales) in formats.items():
        starts = np.array(offsets[kind], np.int64)
        if len(starts) and not layout.names:
            reason = f"the format of {name} contradicts itself"
            records.add_damage("messages-not-decoded", f"/{name}", len(starts), reason=reason)
        elif len(starts) and name not in _WITHOUT_TIME:
            _add_instances(records, name, layout, starts, scales)
        columns = (
            AutopilotMessages(name, layout, starts, starts, scales).read_columns(data)
            if name in ("PARM", "DSF")
            else {}
        )
        if name == "PARM" and [columns[key].dtype.str for key in ("Name", "Value") if key in columns] == [
            "|S16",
            "<f4",
        ]:
            names = (text.decode("ascii", "replace") for text in columns["Name"].tolist())
            records.parameters |= dict(zip(names, columns["Value"].tolist(), strict=True))
        if "Dp" in columns and columns["Dp"].dtype.kind == "u":
            records.dropouts = int(columns["Dp"].max(initial=0))


def _find_message(data: bytes, start: int, lengths: list[int]) -> int:
    """Return the offset of the next message that precedes another or the file's end; without one the file's size."""
    at = data.find(_HEAD, start)
    while at >= 0 and at + 2 < len(data):
        end = at + lengths[data[at + 2]]
        if end > at and (end == len(data) or data.startswith(_HEAD, end)):
            return at
        at = data.find(_HEAD, at + 1)
    return len(data)


def _define_format(
    data: bytes, at: int, lengths: list[int], formats: dict[int, tuple[str, Layout, dict[str, float]]]
) -> None:
    """Read a format. The first one with a number is used; a contradictory one only gives the length of its messages."""
    kind, length, name, letters, labels = struct.unpack_from("<BB4s16s64s", data, at)
    codes = [_DATAFLASH_TYPES.get(letter) for letter in letters.rstrip(b"\0").decode("latin-1")]
    field_names = [*labels.rstrip(b"\0").decode("ascii", "replace").split(","), *[""] * len(codes)]
    known_codes = [code for code in codes if code is not None]
    fields = {
        name or f"field_{index}": code for index, (name, code) in enumerate(zip(field_names, known_codes, strict=False))
    }
    layout = np.dtype([(field_name, code) for field_name, (code, _) in fields.items()])
    if kind not in formats and length > len(_HEAD):
        is_whole = len(fields) == len(codes) and layout.itemsize + 3 == length
        scales = {field_name: scale for field_name, (_, scale) in fields.items() if scale is not None}
        formats[kind] = (name.rstrip(b"\0").decode("ascii", "replace"), layout if is_whole else np.dtype([]), scales)
        lengths[kind] = length


def _add_instances(
    records: AutopilotRecords, name: str, layout: Layout, offsets: Ints, scales: Mapping[str, float]
) -> None:
    """Add the messages of each instance of a sensor separately."""
    instance = next(
        (field for field in _INSTANCES if field in (layout.names or ()) and layout[field].str == "|u1"), None
    )
    if instance is None:
        records.add(name, 0, layout, offsets, scales)
        return
    number = _gather_field(records.data, offsets, layout, instance)
    for one in np.unique(number).tolist():
        records.add(name, one, layout, offsets[number == one], scales)


_OWN_PACKAGES = {"ulog": "px4", "dataflash": "ardupilot"}


def open_autopilot_log(path: Path, kind: AutopilotKind, stack: ExitStack) -> TableLog:
    """Read a ``ulog`` or ``dataflash`` log; ``stack`` is closed with it. `LogError`: it cannot be read."""
    records = read_autopilot_records(path, kind)
    convertible = {name: message for name, message in records.messages.items() if _find_base(name) in CONVERTED}
    messages = {
        name: (message.time_us, select_fields(message.read_columns(records.data)))
        for name, message in convertible.items()
    }
    log = Autopilot(kind, messages, records.parameters)
    with np.errstate(all="ignore"):  # users of the values count those that are not finite
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


def _make_stamped(messages: RoleMessages, stamp_ns: Ints, lever_arms: LeverArms) -> Fields:
    """Return the fields of a role's messages with stamp and frame; the frame is base_link for an IMU without transform."""
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
