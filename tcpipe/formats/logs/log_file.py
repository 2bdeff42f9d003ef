"""Logs of ROS in every container with one interface: topics from the index, tables in one pass, damage listed."""

from __future__ import annotations

import hashlib
import math
import os
import resource
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import replace
from pathlib import Path
from shlex import quote
from types import TracebackType
from typing import Self

import pyarrow as pa

from tcpipe.errors import LogError
from tcpipe.formats.atomic import Location, make_scratch_directory
from tcpipe.formats.finding_lines import describe_finding
from tcpipe.formats.logs import bag_file, mcap_records, sqlite_file
from tcpipe.formats.logs.arrow_columns import TopicTable
from tcpipe.formats.logs.bag_file import BagPart
from tcpipe.formats.logs.log_part import FetchedFile, LogPart, MessageBlock, join_hashes
from tcpipe.formats.logs.mcap_file import McapPart
from tcpipe.formats.logs.ros_types import DefinitionError, MessageType, TypeLibrary
from tcpipe.formats.logs.rosbag2 import (
    STORAGE_SUFFIXES,
    ZSTD_MAGIC,
    Rosbag2Files,
    decompress_blocks,
    decompress_file,
    find_rosbag2_files,
    is_one_bag,
)
from tcpipe.formats.logs.sqlite_file import SqlitePart
from tcpipe.formats.logs.table_folders import find_log_suffix, is_log_file, is_table
from tcpipe.formats.object_storage import StoredObject, is_url, lay_out_objects
from tcpipe.logs.topics import AutopilotKind, Damage, Topic, find_damage, split_notes
from tcpipe.progress import Meter
from tcpipe.tables.findings import Finding

_READ_BY_RANGE = (".mcap", ".bag")

BATCH_BYTES = 1 << 25
"""Approximate memory of one batch of tables [byte]."""

MAX_TOPICS = 10_000
"""Most topics of a log; a robot has some hundred. Each topic costs a millisecond, however few its messages are."""
MAX_COLUMNS = 200_000
"""Largest number of columns of topics that are read together; 500 topics of a robot have about 20,000."""

_HASH_BYTES = 1 << 20
_LISTED = 5
_OTHER_FILES = 256
_FILE_SYSTEMS_OWN = ("lost+found",)

WANTED = "expected an .mcap, a .bag (2.0), a .db3, a ROS 2 bag directory, a .ulg, ArduPilot's .bin or tables that the recipe maps"
# First bytes of the logs of autopilots; a DataFlash log begins with the format of its formats.
_AUTOPILOTS: dict[bytes, AutopilotKind] = {b"ULog\x01\x12\x35": "ulog", b"\xa3\x95\x80\x80\x59": "dataflash"}
_KNOWN_MAGIC = (
    (b"PK\x03\x04", "a zip archive"),
    (b"\x1f\x8b", "a gzip file"),
    (b"BZh", "a bzip2 file"),
    (b"\xfd7zXZ", "an xz file"),
    (b"\x89HDF", "an HDF5 file"),
    (b"PAR1", "a Parquet file"),
    (b"%PDF", "a PDF"),
    (b"II*\0", "a TIFF"),
    (b"MM\0*", "a TIFF"),
)


def open_log(path: Location, *, message_definitions: Path | None = None) -> Log:
    """Open a .mcap, .bag or .db3 file (by its content), or a ROS 2 bag directory; `LogError` names any other kind.

    ``path`` may be a URL (``s3://…``): tcpipe fetches only the requested topics of an .mcap or .bag with an index, and
    copies any other log until it is closed. ``message_definitions`` is a directory of .msg files for types that the log
    does not define.
    """
    with ExitStack() as stack:
        stored: dict[Path, StoredObject] = {}
        if is_url(path):
            path, stored = stack.enter_context(lay_out_objects(str(path), wanted=is_log_file, by_range=_READ_BY_RANGE))
        path = Path(path)
        _require_existing_path(path)
        if not path.is_file() and not path.is_dir():
            raise LogError(f"{path}: it is a pipe or a device; {WANTED}")
        fetched = {file: FetchedFile(place, file) for file, place in stored.items()}
        if path.is_dir():
            listed, parts = _open_directory(path, stack, fetched)
        else:
            listed, parts = Rosbag2Files((path,)), [open_part(path, path.name, stack, fetched.get(path))]
        return Log(path, listed, parts, fetched.values(), TypeLibrary(message_definitions), stack.pop_all())


def open_part(path: Path, name: str, stack: ExitStack, fetched: FetchedFile | None) -> LogPart:
    """Open a file of a log until the stack ends; `LogError` names the probable kind of any other file."""
    magic, original = _read_magic(path, fetched), path
    if fetched is not None and not magic.startswith((mcap_records.MAGIC, bag_file.MAGIC)):
        fetched.whole()
    if magic.startswith(ZSTD_MAGIC):
        path = decompress_file(path, stack.enter_context(make_scratch_directory()))
        magic = _read_magic(path, None)
    part: LogPart
    if magic.startswith(mcap_records.MAGIC) or _read_tail(path, len(mcap_records.MAGIC)) == mcap_records.MAGIC:
        part = McapPart(path, name, fetched)
    elif magic.startswith(bag_file.MAGIC):
        part = BagPart(path, name, fetched)
    elif magic.startswith(sqlite_file.MAGIC):
        part = SqlitePart(path, name)
    else:
        prefix = "" if path == original else "what it holds, decompressed: "
        wanted = (
            f"a table needs a recipe (--recipe FILE); tcpipe init --from {quote(str(original))} writes one"
            if is_table(original.name)
            else WANTED
        )
        raise LogError(f"{original}: not a log: {prefix}{_describe_other_file(path, magic)}; {wanted}")
    stack.callback(part.close)
    return part


def find_autopilot(path: Path) -> AutopilotKind | None:
    """Return ``ulog`` or ``dataflash`` where a file begins like a log of an autopilot, None elsewhere."""
    magic = _read_magic(path, None) if path.is_file() else b""
    return next((kind for start, kind in _AUTOPILOTS.items() if magic.startswith(start)), None)


def _read_magic(path: Path, fetched: FetchedFile | None) -> bytes:
    """Return the first bytes of a file, which identify its format."""
    if fetched is not None and not fetched.is_whole:
        return fetched.read(0, 16)
    try:
        with path.open("rb") as file:
            return file.read(16)
    except OSError as error:
        raise LogError(f"{path}: it cannot be read ({error.strerror})") from None


def _read_tail(path: Path, size: int) -> bytes:
    """Return the last bytes of a file; none if they cannot be read."""
    try:
        with path.open("rb") as file:
            file.seek(max(path.stat().st_size - size, 0))
            return file.read(size)
    except OSError:
        return b""


def _describe_other_file(path: Path, magic: bytes) -> str:
    """Return a guess of the kind of a file that is no log."""
    if not magic:
        return "it is empty (0 bytes)"
    if magic.startswith(b"#ROSBAG V"):
        return f"it is a ROS bag of version {magic[9:12].decode(errors='replace')} (rosbag fix converts it)"
    for start, kind in _KNOWN_MAGIC:
        if magic.startswith(start):
            return f"it is {kind}"
    if not any(magic):
        return "it begins with zeros"
    return f"it is {path.stat().st_size} bytes that begin with {magic[:8]!r}"


def _require_existing_path(path: Path) -> None:
    if path.is_symlink() and not path.exists():
        raise LogError(f"{path}: is a link to {path.readlink()}, which is not there")
    if not path.exists():
        raise LogError(f"{path}: there is no such file or directory")


def find_logs(path: Path) -> list[Path]:
    """Return the logs at or below a path, and unreadable directories, by name; `LogError` without any."""
    path = Path(path)
    _require_existing_path(path)
    if not path.is_dir():
        return [path]
    found = list_logs_below(path)
    if not found:
        raise LogError(f"{path}: no log in this directory or below it; {WANTED}")
    return found


def list_logs_below(directory: Path) -> list[Path]:
    """Return the logs below a directory, as `find_logs`, or []; linked directories are searched once."""
    found, seen, waiting = list[Path](), set[tuple[int, int]](), [(directory, True)]
    while waiting:
        path, is_directory = waiting.pop()
        try:
            state = path.stat() if is_directory else None
            if state is None:
                found.append(path)
            elif (state.st_dev, state.st_ino) not in seen:
                seen.add((state.st_dev, state.st_ino))
                waiting += reversed(_list_entries(path))
        except OSError:
            found.append(path)
    return found


def hash_files(files: Iterable[Path], size_bytes: int) -> str:
    """Return the SHA-256 of concatenated files of ``size_bytes`` in total. `LogError`: the disk fails."""
    digest, meter = hashlib.sha256(), Meter("hashing", size_bytes)
    for file in files:
        try:
            with file.open("rb") as stream:
                while block := stream.read(_HASH_BYTES):
                    digest.update(block)
                    meter.add(len(block))
        except OSError as error:
            raise LogError(
                f"{file}: it cannot be read to its end ({error.strerror}); rescue what can be read into a copy "
                "(ddrescue does), and give that"
            ) from None
    return digest.hexdigest()


class OpenLog:
    """Files that are open for reading until the ``stack`` is closed. Use as a context manager, or close it."""

    def __init__(self, stack: ExitStack, files: Sequence[Path]) -> None:
        self._stack, self.files = stack, files

    def __enter__(self) -> Self:
        """Return the log, which is open already."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close the log; errors of one in object storage name its URL."""
        self._stack.__exit__(kind, error, trace)

    def close(self) -> None:
        """Close its files and remove temporary copies."""
        self._stack.close()

    @property
    def size_bytes(self) -> int:
        """Size of the log's files together."""
        return sum(file.stat().st_size for file in self.files)

    @property
    def size_and_time(self) -> list[list[int]]:
        """Size [byte] and modification time [ns] of each file, by name: equal for an unchanged log."""
        states = [file.stat() for file in sorted(self.files, key=lambda file: file.name)]
        return [[stat.st_size, stat.st_mtime_ns] for stat in states]


class Log(OpenLog):
    """A log of ROS."""

    def __init__(  # noqa: PLR0917
        self,
        path: Path,
        listed: Rosbag2Files,
        parts: Sequence[LogPart],
        fetched: Iterable[FetchedFile],
        types: TypeLibrary,
        stack: ExitStack,
    ) -> None:
        super().__init__(stack, listed.paths)
        self.path = path
        self.container = "rosbag2" if path.is_dir() else parts[0].container
        """``mcap``, ``bag`` or ``rosbag2``."""
        self._parts, self._types, self._fetched = parts, types, tuple(fetched)
        self._damage = list(listed.damage)
        self.topics = self._merged_topics()
        """Every topic by name, from the index."""
        self._compare_counts(listed)

    def _compare_counts(self, listed: Rosbag2Files) -> None:
        """Record that metadata.yaml counts more messages than the files contain, in total or of a topic."""
        counts = {name: topic.message_count or 0 for name, topic in self.topics.items()}
        of_topics = sum(max(count - counts.get(name, 0), 0) for name, count in listed.topic_counts.items())
        lost = max((listed.message_count or 0) - sum(counts.values()), of_topics)
        if lost > 0:
            self._damage.append(Damage("messages-miscounted", self.path.name, messages_lost=lost))

    @property
    def findings(self) -> list[Finding]:
        """Damage found so far, with notes on damage without loss; tables that are read later may add more."""
        unchecked = [Damage("no-checksum", part.name, messages_lost=0) for part in self._parts if part.is_unchecked]
        return find_damage([*self._damage, *(damage for part in self._parts for damage in part.damage), *unchecked])

    @property
    def damage(self) -> list[str]:
        """The findings but for notes, a line each."""
        return [describe_finding(finding) for finding in split_notes(self.findings)[0]]

    @property
    def outline(self) -> str:
        """Return a hash (hex) of the sizes and indexes of all files, independent of place; "" without an index."""
        outlines = [part.outline for part in self._parts]
        if not all(outlines) or len(outlines) < len(self.files):
            return ""
        return join_hashes(outlines)

    @property
    def is_known_by_outline(self) -> bool:
        """Whether `sha256` is the outline: the log is in object storage, and its hash would need all of its bytes."""
        return any(not file.is_whole for file in self._fetched) and bool(self.outline)

    def sha256(self) -> str:
        """Return the SHA-256 of the file; of a bag directory, of its storage files one after the other, by name.

        For a log in object storage that is read by its index, return the hash of the index (`outline`). `LogError`:
        the disk fails.
        """
        if self.is_known_by_outline:
            return self.outline
        for fetched in self._fetched:
            fetched.whole()
        return hash_files(sorted(self.files, key=lambda file: file.name), self.size_bytes)

    def definition(self, topic: str) -> tuple[str, str]:
        """Return a topic's message definition and its source: ``log``, or else ``given`` or ``bundled``.

        Both are empty where the type is not known.
        """
        found = self._resolved(self._channel_of[topic])
        if isinstance(found, DefinitionError):
            return self.topics[topic].definition, ""
        text = (
            self.topics[topic].definition
            if found.source == "log"
            else found.text(ros1=self.topics[topic].encoding == "ros1")
        )
        return text, found.source

    def table(self, topic: str) -> pa.Table:
        """Return one topic's messages; `LogError` if the topic is unknown or cannot be decoded."""
        tables = self.tables([topic])
        if topic not in tables:
            raise LogError(f"{self.path}: topic {topic} cannot be read: {self._message_type(topic)}")
        return tables[topic]

    def tables(self, topics: Iterable[str]) -> dict[str, pa.Table]:
        """Return the tables of several topics, read in one pass.

        A table has one row a message in the order of log time: ``log_time_ns``, ``publish_time_ns``, then the fields by
        dotted name. A topic that cannot be decoded is missing and named in `findings`. `LogError`: a topic is not in
        the log.
        """
        (tables,) = self.batches(topics, batch_bytes=None)
        return tables

    def first_rows(self, topics: Iterable[str]) -> dict[str, pa.Table]:
        """Return the first rows of several topics, as `tables` does; read the log until each topic has rows."""
        found: dict[str, pa.Table] = {}
        wanted = [name for name in topics if self.topics[name].message_count != 0]
        if wanted:
            for tables in self.batches(wanted, batch_bytes=0):
                found = {**{name: table for name, table in tables.items() if table.num_rows}, **found}
                if len(found) == len(wanted):
                    break
        return found

    def batches(self, topics: Iterable[str], *, batch_bytes: int | None = BATCH_BYTES) -> Iterator[dict[str, pa.Table]]:
        """Yield the tables of several topics in batches, as `tables`, in memory that does not grow with the log.

        Each batch has the next rows of the topics with most data; the last one names every topic. Rows are in the order
        of log time, also across batches, unless a message comes more than half a batch after its time; `findings`
        counts such messages. A batch is yielded when more than ``batch_bytes`` are gathered over all topics; None
        yields one batch.
        """
        collected = self._collectors(topics)
        limit_bytes = math.inf if batch_bytes is None else batch_bytes
        yielded_rows = dict.fromkeys(collected, 0)
        gathered, size = 0, self.size_bytes
        meter, messages = Meter("reading", size), sum(self.topics[name].message_count or 0 for name in collected)
        for index in range(len(self._parts)):
            for topic_table, block in self._blocks(index, collected):
                meter.add(size * len(block.offsets) / max(messages, 1))
                gathered -= topic_table.held_bytes
                topic_table.add(block)
                gathered += topic_table.held_bytes
                if gathered > limit_bytes:
                    fullest = {
                        name: table
                        for name, table in collected.items()
                        if table.held_bytes * len(collected) >= gathered
                    }
                    tables = {name: table.take(share=0.5) for name, table in fullest.items()}
                    for name, table in tables.items():
                        yielded_rows[name] += table.num_rows
                    yield tables
                    gathered = sum(table.held_bytes for table in collected.values())
        tables = {name: table.take() for name, table in collected.items()}
        for name, collected_table in collected.items():
            self._note_losses(name, collected_table, yielded_rows[name] + tables[name].num_rows)
        yield tables

    def _collectors(self, topics: Iterable[str]) -> dict[str, TopicTable]:
        """Return an empty table for each topic that can be decoded."""
        wanted = list(dict.fromkeys(topics))
        unknown = [name for name in wanted if name not in self.topics]
        if unknown:
            known_topics = ", ".join(sorted(self.topics)) or "no topics"
            raise LogError(*(f"{self.path}: there is no topic {name}; it has {known_topics}" for name in unknown))
        types, columns = dict[str, MessageType](), 0
        for name in wanted:
            resolved = self._message_type(name)
            if isinstance(resolved, DefinitionError):
                self._note_undecoded(self.path.name, name, self.topics[name].message_count, str(resolved))
                continue
            types[name] = resolved
            columns += resolved.wire.leaves
            if columns > MAX_COLUMNS:
                raise LogError(
                    f"{self.path}: its topics expand to more than {MAX_COLUMNS} columns; read fewer of them at once"
                )
        return {name: TopicTable(message_type, self.topics[name].encoding) for name, message_type in types.items()}

    def _blocks(self, index: int, collected: Mapping[str, TopicTable]) -> Iterator[tuple[TopicTable, MessageBlock]]:
        """Yield a file's blocks with their topics' tables; skip channels whose type differs from their topic's."""
        part, channels = self._parts[index], {}
        for number, channel in part.channels.items():
            if channel.name in collected:
                if self._agrees(channel):
                    channels[number] = collected[channel.name]
                else:
                    reason = f"the topic changes its type to {channel.type_name} ({channel.encoding})"
                    self._note_undecoded(part.name, channel.name, channel.message_count, reason)
        if channels:
            for block in decompress_blocks(part, frozenset(channels)):
                later = replace(block, ordinal=block.ordinal + (index << 48)) if index else block
                yield channels[block.channel], later

    def _agrees(self, channel: Topic) -> bool:
        """Return whether a channel has the type, encoding and fields of its topic."""
        topic = self.topics[channel.name]
        if (channel.type_name, channel.encoding) != (topic.type_name, topic.encoding):
            return False
        if channel.definition in ("", topic.definition):
            return True
        mine, theirs = self._message_type(topic.name), self._resolved(channel)
        return isinstance(theirs, MessageType) and isinstance(mine, MessageType) and mine.wire == theirs.wire

    def _message_type(self, name: str) -> MessageType | DefinitionError:
        problem = self.topics[name].problem
        return DefinitionError(problem) if problem else self._resolved(self._channel_of[name])

    def _note_undecoded(self, file: str, topic: str, count: int | None, reason: str) -> None:
        self._damage.append(Damage("messages-not-decoded", file, topic=topic, messages_lost=count, reason=reason))

    def _resolved(self, channel: Topic) -> MessageType | DefinitionError:
        return self._types.find_type(
            channel.type_name,
            definition=channel.definition,
            schema_encoding=channel.schema_encoding,
            ros1=channel.encoding == "ros1",
        )

    def _find_problem(self, channel: Topic) -> str | None:
        """Return why messages cannot be decoded; a definition that cannot be used is found when they are read."""
        if channel.encoding not in ("cdr", "ros1"):
            return f"its messages are encoded as {channel.encoding or 'nothing known'}; cdr and ros1 are read"
        if not channel.type_name:
            return "the log does not state the type of its messages"
        found = None if channel.definition.strip() else self._resolved(channel)
        return str(found) if isinstance(found, DefinitionError) else None

    def _note_losses(self, name: str, topic_table: TopicTable, rows: int) -> None:
        """Record missing, undecodable and late messages, and invalid texts, of a topic."""
        missing = (self.topics[name].message_count or 0) - rows - topic_table.undecodable
        if missing and not self._damage and not any(part.damage for part in self._parts):
            lost = missing if missing > 0 else None  # messages too many may be another topic's
            self._damage.append(Damage("messages-miscounted", self.path.name, topic=name, messages_lost=lost))
        if topic_table.undecodable:
            self._note_undecoded(self.path.name, name, topic_table.undecodable, topic_table.undecodable_reason)
        for cause, count in (("messages-unordered", topic_table.late), ("text-not-utf8", topic_table.replaced_texts)):
            if count:
                self._damage.append(Damage(cause, self.path.name, topic=name, messages_lost=0, places=count))

    def _merged_topics(self) -> dict[str, Topic]:
        """Merge the channels of all files by topic; if types differ, tcpipe uses the one with most messages."""
        self._channel_of: dict[str, Topic] = {}
        topics: dict[str, Topic] = {}
        channels = [channel for part in self._parts for channel in part.channels.values()]
        for channel in sorted(channels, key=lambda c: (c.name, -(c.message_count or 0), not c.definition)):
            topic = replace(channel, problem=self._find_problem(channel))
            first = self._channel_of.setdefault(channel.name, channel)
            if channel is first:
                topics[channel.name] = topic
                if len(topics) > MAX_TOPICS:
                    raise LogError(
                        f"{self.path}: it contains more than {MAX_TOPICS} topics; tcpipe does not read such a log"
                    )
            elif (channel.type_name, channel.encoding) == (first.type_name, first.encoding):
                topics[channel.name] = topics[channel.name].joined(topic)
        return topics


def _open_directory(
    directory: Path, stack: ExitStack, fetched: Mapping[Path, FetchedFile]
) -> tuple[Rosbag2Files, list[LogPart]]:
    """Open the files of a ROS 2 bag; files that cannot be opened are recorded as damage."""
    try:
        bag_files = find_rosbag2_files(directory)
    except LogError as error:
        below = [str(path) for path in list_logs_below(directory) if path.parent != directory]
        if not below:
            raise
        names = ", ".join(below[:_LISTED]) + (" and more" if len(below) > _LISTED else "")
        raise LogError(*error.problems, f"{directory}: contains several logs, give one of them: {names}") from None
    _allow_files(len(bag_files.paths))
    parts, damage, errors = [], list(bag_files.damage), []
    for file in bag_files.paths:
        try:
            parts.append(open_part(file, f"{directory.name}/{file.name}", stack, fetched.get(file)))
        except LogError as error:
            errors.append(error)
            damage.append(Damage("data-unreadable", f"{directory.name}/{file.name}", reason=str(error)))
    if not parts:
        raise LogError(*(problem for error in errors for problem in error.problems))
    return replace(bag_files, damage=tuple(damage)), parts


def _allow_files(count: int) -> None:
    """Raise the number of files that this process may open (usually 1024), as far as the system allows it."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = 2 * count + _OTHER_FILES
    if soft != resource.RLIM_INFINITY and soft < wanted:
        most = wanted if hard == resource.RLIM_INFINITY else min(wanted, hard)
        resource.setrlimit(resource.RLIMIT_NOFILE, (most, hard))


def _list_entries(directory: Path) -> list[tuple[Path, bool]]:
    """Return possible logs in a directory, each with whether it is a directory to search; or a bag directory itself."""
    with os.scandir(directory) as there:
        entries = sorted(there, key=lambda entry: entry.name)
    one_bag = is_one_bag(directory)
    candidates = [(directory, False)] if one_bag else []
    for entry in entries:
        if entry.name.startswith((".", "~")) or entry.name in _FILE_SYSTEMS_OWN:
            continue
        if os.path.isdir(entry):  # noqa: PTH112  False where it cannot be read
            candidates.append((directory / entry.name, True))
        elif one_bag and entry.name.endswith(STORAGE_SUFFIXES):
            continue
        elif (
            find_log_suffix(entry.name)
            and (entry.is_symlink() or entry.is_file())
            and not (entry.name.lower().endswith(".bin") and _is_other_binary(directory / entry.name))
        ):
            candidates.append((directory / entry.name, False))
    return candidates


def _is_other_binary(path: Path) -> bool:
    """Return whether a .bin file is certainly no log; an unreadable file may be a log."""
    with suppress(LogError):
        return find_autopilot(path) is None
    return False
