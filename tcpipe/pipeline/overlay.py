"""A run as a log for a viewer, on the recorder's clock: track, segments, masked rows and rejections.

ROS 2 messages in MCAP: Foxglove, Rerun and PlotJuggler all read them (docs/how-to/viewers.md). Their fields are the
tables' columns.
"""

import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from tcpipe.arrays import AnyArray, Ints, Texts
from tcpipe.errors import LogError, StoreError, UsageError, clean_lines
from tcpipe.formats.atomic import Location
from tcpipe.formats.logs.log_file import open_log
from tcpipe.formats.logs.message_tables import make_stamp_fields
from tcpipe.formats.logs.writing import MessageStream, write_mcap
from tcpipe.formats.parquet import read_table
from tcpipe.formats.stored_runs import StoredRun
from tcpipe.geometry.rotation import quat_from_rpy
from tcpipe.logs.roles import NAV_SAT_FIX, OVERLAY, POSE_STAMPED
from tcpipe.splits.audit import PLACES
from tcpipe.store import find_named_run
from tcpipe.tables.bits import DropReason, Quality, flag_names
from tcpipe.tables.columns import make_text_column, stack_floats, to_numbers, to_texts
from tcpipe.tables.levels import GEOMETRY, LABEL_STD

GEOJSON = "foxglove_msgs/msg/GeoJSON"
_FRAME = "tcpipe_enu"
_SEGMENT_COLOUR, _DROPPED_COLOUR = "#1a9850", "#d73027"
_DIAGONAL_KNOWN = 2
_ROWS_A_VERTEX = 20  # time between vertices of dropped sections [s]

_ROS_TYPES = {
    pa.float64(): "float64", pa.int64(): "int64", pa.int32(): "int32", pa.int16(): "int16", pa.uint32(): "uint32", pa.string(): "string",
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class Overlay:
    """The file that was written."""

    path: str
    run_id: str
    recipe_id: str
    messages: Mapping[str, int]
    """By topic."""
    start_ns: int | None
    """Log time of the first message; None without any."""
    end_ns: int | None

    def __str__(self) -> str:
        """Return the file and its topics, a line each."""
        lines = (f"{count:>9} messages  {topic}" for topic, count in self.messages.items())
        return clean_lines(
            (f"{self.path}: run {self.run_id} under recipe {self.recipe_id}, on its log's clock", *lines)
        )


def write_overlay(name: str, out: Path, *, store: Location = "tcpipe-store") -> Overlay:
    """Write the results of a run as an MCAP file of ROS 2 messages, atomically; the same run gives the same bytes.

    `UsageError`: no run has this name (RUN or RUN/RECIPE), or it has several recipes, or ``out`` exists and is not an
    overlay: a log is never replaced. `StoreError`: a file of the run, or its streams, which have the times of the
    recorder's clock, has been changed.
    """
    run = find_named_run(name, store)
    _refuse_others(out)
    streams = list(_iterate_streams(run))
    write_mcap(out, streams)
    count: dict[str, int] = {}
    for stream in streams:
        count[stream.topic] = count.get(stream.topic, 0) + len(stream.log_time_ns)
    times = np.concatenate([stream.log_time_ns for stream in streams])
    ends = (int(times.min()), int(times.max())) if len(times) else (None, None)
    return Overlay(str(out), run.run_id, run.recipe_id, count, *ends)


def _refuse_others(out: Path) -> None:
    is_own = not out.exists()
    with suppress(LogError):
        if not is_own:
            with open_log(out) as log:
                is_own = all(name.startswith(OVERLAY) for name in log.topics)
    if not is_own:
        raise UsageError(f"{out}: exists and is not an overlay; give another name")


def _iterate_streams(run: StoredRun) -> Iterator[MessageStream]:
    """Yield every topic's messages."""
    clock = _find_recorder_clock(run)
    track, segments, refused = run.track(), run.segments().drop_columns([GEOMETRY]), run.rejections()
    rows = _add_bit_names(track.table, "dropped_by", DropReason, "reasons", "kept")
    cut = _add_bit_names(segments, "quality", Quality, "quality_names", "clean")
    times = clock(_read_column(rows, "stamp_ns"), _read_column(rows, "clock_epoch"))
    if track.info.datum is not None:
        yield _make_fixes(rows, times)
        if len(times):
            geojson = json.dumps(
                {"type": "FeatureCollection", "features": [*_iterate_dropped_lines(rows), *_iterate_segment_lines(cut)]}
            )
            yield MessageStream(
                f"{OVERLAY}segments", GEOJSON, times[:1], {}, {"geojson": geojson}, definition="string geojson\n"
            )
    columns: dict[str, AnyArray] = {**make_stamp_fields(_read_column(rows, "stamp_ns"))}
    columns |= {f"pose.position.{axis}": _read_column(rows, f"{axis}_m") for axis in "xyz"}
    quat = quat_from_rpy(*(_read_column(rows, f"{name}_rad") for name in ("roll", "pitch", "yaw")))
    columns |= {f"pose.orientation.{axis}": quat[:, at] for at, axis in enumerate("xyzw")}
    yield MessageStream(f"{OVERLAY}pose", POSE_STAMPED, times, columns, {"header.frame_id": _FRAME})
    yield from _iterate_messages("track", "stamp_ns", rows, times)
    yield from _iterate_masks(to_texts(rows.column("reasons")), times)
    yield from _iterate_messages(
        "segment", "start_ns", cut, clock(_read_column(cut, "start_ns"), _read_column(cut, "clock_epoch"))
    )
    yield from _iterate_messages("refused", "stamp_ns", refused, clock(_read_column(refused, "stamp_ns"), None))


class _Clock:
    """Times of reception of measurements, by the messages of one role; in between the delay is interpolated."""

    def __init__(self, rows: pa.Table) -> None:
        self._epoch, stamps = _read_column(rows, "clock_epoch"), _read_column(rows, "stamp_ns")
        self._stamp_ns, self._behind_ns = stamps, (_read_column(rows, "log_time_ns") - stamps).astype(float)

    def __call__(self, stamp_ns: Ints, epoch: Ints | None) -> Ints:
        """Return the log time of each stamp [ns]; without epochs the first one that contains it counts."""
        if epoch is None:
            epoch = self._epoch_of(stamp_ns)
        times = stamp_ns.copy()
        for number in np.unique(epoch):
            in_epoch, is_usable = epoch == number, self._epoch == number
            is_usable = is_usable if is_usable.any() else np.ones_like(is_usable)
            begin = self._stamp_ns[is_usable][0]  # differences are exact in float64, times since 1970 are not
            at_ns = (stamp_ns[in_epoch] - begin).astype(float)
            known_ns = (self._stamp_ns[is_usable] - begin).astype(float)
            times[in_epoch] += np.rint(np.interp(at_ns, known_ns, self._behind_ns[is_usable])).astype(np.int64)
        return times

    def _epoch_of(self, stamp_ns: Ints) -> Ints:
        epoch = np.full(len(stamp_ns), self._epoch.max(initial=0))
        for number in np.unique(self._epoch)[::-1]:
            inside = self._stamp_ns[self._epoch == number]
            epoch[(stamp_ns >= inside[0]) & (stamp_ns <= inside[-1])] = number
        return epoch


def _find_recorder_clock(run: StoredRun) -> _Clock:
    """Return the clock of a run's log; `StoreError` if its streams are not as they were written."""
    if not run.facts.streams:
        raise StoreError(f"run {run.name}: its log has no measurements, so that the clock of its recorder is not known")
    columns = ["stamp_ns", "log_time_ns", "clock_epoch"]
    tables = (read_table(path, columns) for path in run.stream_files().values())
    return _Clock(max(tables, key=lambda table: table.num_rows))


def _read_column(table: pa.Table, name: str) -> AnyArray:
    return to_numbers(table.column(name))


def _add_bit_names(table: pa.Table, column: str, flags: type[DropReason | Quality], name: str, none: str) -> pa.Table:
    """Return the table with the names of its bits as a text column."""
    bits = _read_column(table, column)
    texts = {int(value): ", ".join(flag_names(int(value), flags)) or none for value in np.unique(bits)}
    return table.append_column(name, make_text_column([texts[int(value)] for value in bits]))


def _make_fixes(rows: pa.Table, times: Ints) -> MessageStream:
    """Return the track as NavSatFix messages with variances, in the datum of the fixes of the log."""
    columns = make_stamp_fields(_read_column(rows, "stamp_ns"))
    columns |= {
        name: _read_column(rows, f"{name[:3]}_{unit}")
        for name, unit in (("longitude", "deg"), ("latitude", "deg"), ("altitude", "m"))
    }
    covariance = np.zeros((len(times), 9))
    covariance[:, ::4] = stack_floats(rows, "x_std_m", "y_std_m", "z_std_m") ** 2
    constants = {"header.frame_id": "base_link", "position_covariance_type": _DIAGONAL_KNOWN}
    return MessageStream(f"{OVERLAY}fix", NAV_SAT_FIX, times, columns | {"position_covariance": covariance}, constants)


def _iterate_masks(reasons: Texts, times: Ints) -> Iterator[MessageStream]:
    """Yield the reasons why rows are masked, as a message at each change."""
    changes = np.flatnonzero(np.append(True, reasons[1:] != reasons[:-1])[: len(reasons)])
    for reason in np.unique(reasons):
        at = times[changes[reasons[changes] == reason]]
        yield MessageStream(f"{OVERLAY}mask", "std_msgs/msg/String", at, {}, {"data": str(reason)})


def _iterate_messages(name: str, stamp: str, table: pa.Table, times: Ints) -> Iterator[MessageStream]:
    """Yield a table as messages of an own type, one field per column, grouped by lengths of texts; null becomes NaN."""
    kinds = {field.name: _ROS_TYPES[field.type] for field in table.schema}
    definition = "std_msgs/Header header\n" + "".join(f"{kind} {column_name}\n" for column_name, kind in kinds.items())
    columns: dict[str, AnyArray] = {**make_stamp_fields(_read_column(table, stamp))}
    lengths = np.zeros((len(times), 0), np.int64)
    for column_name, kind in kinds.items():
        if kind == "string":
            columns[column_name] = (
                np.char.encode(to_texts(table.column(column_name)), "utf-8") if len(times) else np.empty(0, "S1")
            )
            lengths = np.column_stack([lengths, np.char.str_len(columns[column_name])])
        else:
            columns[column_name] = _read_column(table, column_name)
    for length in np.unique(lengths, axis=0) if len(times) else lengths[:1]:
        rows = (lengths == length).all(axis=-1)
        sizes = iter(length.tolist())
        alike = {
            column_name: values[rows].astype(f"S{next(sizes)}") if values.dtype.kind == "S" else values[rows]
            for column_name, values in columns.items()
        }
        constants = {"header.frame_id": _FRAME}
        yield MessageStream(
            f"{OVERLAY}{name}", f"tcpipe_msgs/msg/{name.title()}", times[rows], alike, constants, definition=definition
        )


def _make_line(lonlat: Sequence[Sequence[float]], colour: str, properties: Mapping[str, Any]) -> dict[str, Any]:
    geometry = {"type": "LineString", "coordinates": lonlat}
    return {"type": "Feature", "geometry": geometry, "properties": {**properties, "style": {"color": colour}}}


def _iterate_segment_lines(segments: pa.Table) -> Iterator[dict[str, Any]]:
    """Yield a GeoJSON line a segment, with its labels and quality."""
    labels = chain.from_iterable(LABEL_STD.items())
    for row in segments.select(["segment_id", *PLACES, *labels, "quality_names"]).to_pylist():
        lonlat = [row.pop(name) for name in PLACES]
        yield _make_line([lonlat[:2], lonlat[2:]], _SEGMENT_COLOUR, {"name": row["segment_id"], **row})


def _iterate_dropped_lines(rows: pa.Table) -> Iterator[dict[str, Any]]:
    """Yield a GeoJSON line for each section of masked rows with their reason."""
    reasons, bits, epoch = (
        to_texts(rows.column("reasons")),
        _read_column(rows, "dropped_by"),
        _read_column(rows, "clock_epoch"),
    )
    lonlat = stack_floats(rows, "lon_deg", "lat_deg")
    breaks = np.flatnonzero((np.diff(bits.astype(np.int64)) != 0) | (np.diff(epoch) != 0)) + 1
    for part in np.split(np.arange(len(bits)), breaks):
        if len(part) > 1 and bits[part[0]]:
            vertices = np.append(part[:-1:_ROWS_A_VERTEX], part[-1])
            yield _make_line(
                lonlat[vertices].tolist(),
                _DROPPED_COLOUR,
                {"name": str(reasons[part[0]]), "mask": str(reasons[part[0]])},
            )
