"""Logs that are read from other files than bags: each topic is a table of messages, with the interface of `log_file.Log`."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from tcpipe.errors import LogError, clean_line
from tcpipe.formats.logs.log_file import OpenLog, hash_files
from tcpipe.logs.topics import Damage, Topic, find_damage
from tcpipe.tables.columns import make_text_column, number_column
from tcpipe.tables.findings import Finding

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint

T = TypeVar("T")
Fields = Mapping[str, "NDArray[np.generic] | pa.Array"]


@dataclass(frozen=True, slots=True)
class TopicMessages:
    """A topic, the function that makes its messages, and their damage."""

    topic: Topic
    make: Callable[[], pa.Table]
    damage: Sequence[Damage] = ()


class TableLog(OpenLog):
    """A log whose topics are tables of messages, each made when it is read."""

    outline, is_known_by_outline = "", False  # without an index the files are hashed

    def __init__(
        self,
        path: Path,
        container: str,
        topics: Sequence[TopicMessages],
        files: Sequence[Path],
        *,
        findings: Iterable[Finding] = (),
        stack: ExitStack | None = None,
    ) -> None:
        super().__init__(stack or ExitStack(), files)
        self.path, self.container = path, container
        self._made = {found.topic.name: found.make for found in topics}
        self.topics = {found.topic.name: found.topic for found in topics}
        """Every topic by name."""
        self.findings = [*find_damage(damage for found in topics for damage in found.damage), *findings]

    def sha256(self) -> str:
        """Return the SHA-256 of all files, one after the other, by name; also of tables that are not mapped. `LogError`: the disk fails."""
        return hash_files(self.files, self.size_bytes)

    def tables(self, topics: Iterable[str]) -> dict[str, pa.Table]:
        """Return the messages of several topics; `LogError` where one is not in the log."""
        return {name: table for tables in self.batches(topics) for name, table in tables.items()}

    first_rows = tables

    def batches(self, topics: Iterable[str]) -> Iterator[dict[str, pa.Table]]:
        """Yield the messages of several topics, one topic after the other."""
        wanted = list(topics)
        if unknown := [name for name in wanted if name not in self._made]:
            raise LogError(f"{self.path}: there is no topic {', '.join(unknown)}; there are {', '.join(self.topics)}")
        for name in wanted:
            yield {name: self._made[name]()}


def make_stamp_fields(stamp_ns: NDArray[np.int64]) -> dict[str, NDArray[np.int64]]:
    """Return the fields of a header's stamp."""
    second, rest = np.divmod(stamp_ns, 1_000_000_000)
    return {"header.stamp.sec": second, "header.stamp.nanosec": rest}


def make_topic(
    name: str,
    type_name: str,
    stamp_ns: NDArray[np.int64],
    read_fields: Callable[[], Fields],
    damage: Sequence[Damage] = (),
) -> TopicMessages:
    """Return a topic with the stamps of its messages [ns], shape (N,), as both log times; `_make_column` converts its fields."""

    def make() -> pa.Table:
        times = {"log_time_ns": stamp_ns, "publish_time_ns": stamp_ns}
        return pa.table({name: _make_column(values) for name, values in (times | {**read_fields()}).items()})

    topic = Topic(name, type_name, len(stamp_ns), int(stamp_ns[0]), int(stamp_ns[-1]), "table", "")
    return TopicMessages(topic, make, damage)


def _make_column(values: NDArray[np.generic] | pa.Array) -> pa.Array:
    """Return a column of messages: rows of shape (N, k) become lists, bytes texts."""
    if isinstance(values, pa.Array):
        return values
    if values.dtype.kind == "S":
        return make_text_column(text.decode(errors="replace") for text in values.tolist())
    if values.ndim == 1:
        return number_column(values)
    return pa.FixedSizeListArray.from_arrays(number_column(values.ravel()), values.shape[1])


def open_registered_log(path: Path, reader: EntryPoint, stack: ExitStack) -> TableLog:
    """Read a file with the reader of another package; ``stack`` is closed with it. `LogError`: the reader fails."""
    run = partial(_run_reader, path, reader)
    topics = run(lambda: [_make_read_topic(*topic) for topic in reader.load()(path)])
    topics = [replace(topic, make=partial(run, topic.make)) for topic in topics]
    return TableLog(path, reader.name.lower(), topics, [path], stack=stack)


def _run_reader(path: Path, reader: EntryPoint, call: Callable[[], T]) -> T:
    """Return what a call into a reader returns; `LogError` with file, package and entry point if it raises another error."""
    try:
        return call()
    except LogError:
        raise
    except Exception as error:
        package = f"package {reader.dist.name if reader.dist else '?'}, entry point {reader.name} = {reader.value}"
        cause = clean_line(f"{type(error).__name__}: {error}")
        raise LogError(f"{path}: cannot be read by {package}: {cause}; correct or uninstall that package") from error


def _make_read_topic(name: str, type_name: str, stamps: Sequence[int], read: Callable[[], Fields]) -> TopicMessages:
    """Return a topic of a reader as `make_topic`; `ValueError`: its stamps are no rising numbers of nanoseconds."""
    stamp_ns = np.asarray(stamps)
    if stamp_ns.dtype != np.int64 or stamp_ns.ndim != 1 or not stamp_ns.size or (np.diff(stamp_ns) < 0).any():
        got = f"{stamp_ns.dtype} of shape {stamp_ns.shape}"
        raise ValueError(f"topic {name}: expected rising stamps [ns] as int64 of shape (N,), N > 0, got {got}")

    def read_fields() -> Fields:
        columns = {key: value if getattr(value, "ndim", 1) == 2 else pa.array(value) for key, value in read().items()}
        return make_stamp_fields(stamp_ns) | columns

    return make_topic(name, type_name, stamp_ns, read_fields)
