"""Logs in other files than bags: each topic is a table of messages, with the interface of `log_file.Log`."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa

from tcpipe.arrays import GenericArray, Ints
from tcpipe.errors import LogError
from tcpipe.formats.logs.log_file import OpenLog, hash_files
from tcpipe.logs.topics import Damage, Topic, find_damage
from tcpipe.tables.columns import make_text_column, number_column
from tcpipe.tables.findings import Finding

Fields = Mapping[str, "GenericArray | pa.Array"]


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
        """Return the SHA-256 of all files in order of their names, unmapped tables too. `LogError`: the disk fails."""
        return hash_files(self.files, self.size_bytes)

    def tables(self, topics: Iterable[str]) -> dict[str, pa.Table]:
        """Return the messages of several topics; `LogError` if one is not in the log."""
        return {name: table for tables in self.batches(topics) for name, table in tables.items()}

    first_rows = tables

    def batches(self, topics: Iterable[str]) -> Iterator[dict[str, pa.Table]]:
        """Yield the messages of several topics, one topic after the other."""
        wanted = list(topics)
        if unknown := [name for name in wanted if name not in self._made]:
            raise LogError(f"{self.path}: there is no topic {', '.join(unknown)}; there are {', '.join(self.topics)}")
        for name in wanted:
            yield {name: self._made[name]()}


def make_stamp_fields(stamp_ns: Ints) -> dict[str, Ints]:
    """Return the fields of a header's stamp."""
    second, rest = np.divmod(stamp_ns, 1_000_000_000)
    return {"header.stamp.sec": second, "header.stamp.nanosec": rest}


def make_topic(
    name: str, type_name: str, stamp_ns: Ints, read_fields: Callable[[], Fields], damage: Sequence[Damage] = ()
) -> TopicMessages:
    """Return a topic whose messages have the stamps [ns], shape (N,), as both log times; fields are read on demand."""

    def make() -> pa.Table:
        times = {"log_time_ns": stamp_ns, "publish_time_ns": stamp_ns}
        return pa.table({name: _make_column(values) for name, values in (times | {**read_fields()}).items()})

    topic = Topic(name, type_name, len(stamp_ns), int(stamp_ns[0]), int(stamp_ns[-1]), "table", "")
    return TopicMessages(topic, make, damage)


def _make_column(values: GenericArray | pa.Array) -> pa.Array:
    """Return values as a column of messages: rows of shape (N, k) become lists, bytes become texts."""
    if isinstance(values, pa.Array):
        return values
    if values.dtype.kind == "S":
        return make_text_column(text.decode(errors="replace") for text in values.tolist())
    if values.ndim == 1:
        return number_column(values)
    return pa.FixedSizeListArray.from_arrays(number_column(values.ravel()), values.shape[1])
