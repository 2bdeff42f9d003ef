"""ROS 2 bags: a directory of .db3 or .mcap files with metadata.yaml, split, and compressed by file or by message."""

import os
import re
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from tcpipe.errors import LogError
from tcpipe.formats.atomic import describe_full_disk
from tcpipe.formats.logs.log_part import MAX_CHUNK_BYTES, LogPart, MessageBlock, is_bomb
from tcpipe.logs.topics import Damage

METADATA = "metadata.yaml"
STORAGE_SUFFIXES = (".db3", ".mcap", ".db3.zstd", ".mcap.zstd")
ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"

MAX_FILES = 4096
"""Most files of a bag, since all are open at the same time; with a new file each minute, three days."""
MAX_METADATA_BYTES = 1 << 20
"""Longest metadata.yaml that is read [byte]: its parser takes ten seconds for it, and a bag can be read without it."""

_COPY_BYTES = 1 << 22
_LISTED = 10
_PART = re.compile(r"(_\d+)?\.(db3|mcap)(\.zstd)?$")  # end of the names of a bag's files, in which they differ


@dataclass(frozen=True, slots=True)
class Rosbag2Files:
    """The storage files of a bag in order, problems of their list, and metadata.yaml's message counts by topic."""

    paths: tuple[Path, ...]
    damage: tuple[Damage, ...] = ()
    message_count: int | None = None
    topic_counts: Mapping[str, int] = field(default_factory=dict)


def find_rosbag2_files(directory: Path) -> Rosbag2Files:
    """Return the storage files of a bag, by metadata.yaml or, without it, by name; `LogError` if it is no bag."""
    try:
        present = list_storage_files(directory)
    except OSError as error:
        raise LogError(f"{directory}: it cannot be read ({error.strerror})") from None
    if len(present) > MAX_FILES:
        raise LogError(f"{directory}: it contains {len(present)} files; bags of up to {MAX_FILES} are read")
    information = _read_bag_information(directory / METADATA)
    return (
        _find_files_by_name(directory, present)
        if information is None
        else _find_files_by_metadata(directory, present, information)
    )


def _find_files_by_name(directory: Path, present: tuple[Path, ...]) -> Rosbag2Files:
    """Return a bag's files by name; `LogError` if they are not parts of one bag."""
    kinds = {path.name.removesuffix(".zstd").rsplit(".", 1)[-1] for path in present}
    problem = _describe_metadata_problem(directory / METADATA)
    if len(kinds) != 1:
        reason = "no .db3 or .mcap file is there" if not kinds else "both .db3 and .mcap files are there"
        raise LogError(f"{directory}: not a ROS 2 bag: {METADATA} {problem}, and {reason}")
    if len({_PART.sub("", path.name) for path in present}) > 1:
        names = ", ".join(path.name for path in present[:_LISTED]) + (", …" if len(present) > _LISTED else "")
        raise LogError(
            f"{directory}: not a ROS 2 bag: {METADATA} {problem}, and its files are not named as parts of one ({names}); "
            "give one of them"
        )
    return Rosbag2Files(present, (Damage("file-unlisted", directory.name, messages_lost=0),))


def _find_files_by_metadata(directory: Path, present: tuple[Path, ...], information: Mapping[str, Any]) -> Rosbag2Files:
    """Return the files that metadata.yaml lists, then unlisted ones; missing and unlisted files are damage."""
    named = information.get("relative_file_paths")
    if isinstance(named, list) and len(named) > MAX_FILES:
        raise LogError(f"{directory}: {METADATA} names {len(named)} files; bags of up to {MAX_FILES} are read")
    listed = [Path(name).name for name in named if isinstance(name, str)] if isinstance(named, list) else []
    path_by_name = {
        name: next(filter(os.path.isfile, (directory / name, directory / f"{name}.zstd")), None) for name in listed
    }
    paths = [path for path in path_by_name.values() if path is not None]
    missing = [name for name, path in path_by_name.items() if path is None]
    used = set(paths)
    extra = [p for p in present if p not in used and p.with_name(p.name.removesuffix(".zstd")) not in used]
    paths += extra
    count = information.get("message_count")
    damage = [Damage("file-unlisted", f"{directory.name}/{path.name}", messages_lost=0) for path in extra]
    if len(missing) != len(extra) or not _is_count(count):  # else renamed: the count of messages shows losses
        damage += [Damage("file-missing", f"{directory.name}/{name}") for name in missing]
    if not paths:
        names = ", ".join(listed[:_LISTED]) + (", …" if len(listed) > _LISTED else "")
        raise LogError(f"{directory}: not a ROS 2 bag: no file that {METADATA} names is there ({names or 'none'})")
    return Rosbag2Files(
        tuple(paths), tuple(damage), count if _is_count(count) else None, _read_topic_counts(information)
    )


def _is_count(value: object) -> bool:
    return isinstance(value, int) and 0 <= value < 1 << 63


def _read_topic_counts(information: Mapping[str, Any]) -> dict[str, int]:
    """Return metadata.yaml's message count of each topic; none if it does not have the recorder's format."""
    counts: dict[str, int] = {}
    with suppress(KeyError, TypeError):
        for entry in information["topics_with_message_count"]:
            name, count = entry["topic_metadata"]["name"], entry["message_count"]
            if isinstance(name, str) and _is_count(count):
                counts[name] = counts.get(name, 0) + count
    return counts


def list_storage_files(directory: Path) -> tuple[Path, ...]:
    """Return the .db3 and .mcap files directly in a directory, compressed ones too, by name with numbers in order."""
    return tuple(sorted((directory / name for name in _list_storage_names(directory)), key=_make_natural_key))


def _list_storage_names(directory: Path) -> list[str]:
    with os.scandir(directory) as entries:
        named = [entry for entry in entries if entry.name.endswith(STORAGE_SUFFIXES) and not entry.name.startswith(".")]
        return [entry.name for entry in named if entry.is_file()]


def is_one_bag(directory: Path) -> bool:
    """Return whether a directory is one ROS 2 bag: by metadata.yaml, or by files with the recorder's names."""
    if (directory / METADATA).is_file():
        return True
    names = _list_storage_names(directory)
    kinds = {name.removesuffix(".zstd").rsplit(".", 1)[-1] for name in names}
    named = re.compile(re.escape(directory.name) + r"(_\d+)?\.(db3|mcap)(\.zstd)?")
    return len(kinds) == 1 and all(map(named.fullmatch, names))


def decompress_file(path: Path, directory: Path) -> Path:
    """Decompress a zstd file into ``directory``, a truncated one as far as possible; return the copy."""
    copy = Path(directory, path.name.removesuffix(".zstd"))
    size, written = path.stat().st_size, 0
    try:
        with copy.open("wb") as target:
            for block in _decompress_stream(path):
                target.write(block)
                written += len(block)
                if is_bomb(size, written):
                    raise LogError(
                        f"{path}: {size} bytes hold more than {written}; tcpipe rejects it as a decompression bomb"
                    )
    except OSError as error:
        raise LogError(
            f"{path}: it cannot be decompressed into a copy ({describe_full_disk(error) or error.strerror})"
        ) from None
    return copy


def _decompress_stream(path: Path) -> Iterator[bytes]:
    """Yield the content of a zstd file until its end, or until damage or a read error; the reader detects the loss."""
    with suppress(OSError), pa.input_stream(str(path), compression="zstd") as stream:
        while block := stream.read(_COPY_BYTES):
            yield block


def decompress_blocks(part: LogPart, wanted: frozenset[int]) -> Iterator[MessageBlock]:
    """Yield a part's messages of the requested channels; decompress zstd frames (``compression_mode: MESSAGE``)."""
    compressed: dict[int, bool] = {}
    for block in part.blocks(wanted):
        if block.channel not in compressed:
            start = block.offsets[0] if len(block.offsets) else len(block.buffer)
            is_frame = bytes(block.buffer[start : start + 4]) == ZSTD_MAGIC  # as no CDR message begins
            compressed[block.channel] = is_frame and part.channels[block.channel].encoding == "cdr"
        yield _decompress_block(block, part) if compressed[block.channel] else block


def _decompress_block(block: MessageBlock, part: LogPart) -> MessageBlock:
    """Decompress the payloads of a block; exclude and record damaged ones."""
    payloads, valid_rows = [], []
    for row, (offset, length) in enumerate(zip(block.offsets.tolist(), block.lengths.tolist(), strict=True)):
        payload = _decompress_frame(block.buffer[offset : offset + length])
        if payload is not None:
            payloads.append(payload)
            valid_rows.append(row)
    lost = len(block.offsets) - len(valid_rows)
    if lost:
        topic = part.channels[block.channel].name
        part.damage.append(Damage("chunk-damaged", part.name, topic=topic, messages_lost=lost))
    lengths = np.fromiter(map(len, payloads), np.int64, len(payloads))
    rows = np.array(valid_rows, np.int64)
    return MessageBlock(
        block.channel,
        memoryview(b"".join(payloads)),
        np.cumsum(lengths) - lengths,
        lengths,
        block.log_time_ns[rows],
        block.publish_time_ns[rows],
        block.ordinal[rows],
    )


def _decompress_frame(frame: memoryview) -> bytes | None:
    """Return the content of a zstd frame; None if it is damaged or implausibly large."""
    pieces: list[bytes] = []
    size = 0
    try:
        with pa.CompressedInputStream(pa.BufferReader(pa.py_buffer(frame)), "zstd") as stream:
            while piece := stream.read(_COPY_BYTES):
                pieces.append(piece)
                size += len(piece)
                if size > MAX_CHUNK_BYTES or is_bomb(len(frame), size, whole=True):
                    return None
    except OSError:
        return None
    return b"".join(pieces)


def _read_bag_information(path: Path) -> dict[str, Any] | None:
    """Return the content of metadata.yaml; None if it is missing or damaged, as after a recorder was killed."""
    from ruamel.yaml import YAML  # noqa: PLC0415  most logs are none of these
    from ruamel.yaml.error import YAMLError  # noqa: PLC0415

    try:
        if path.stat().st_size > MAX_METADATA_BYTES:
            return None
        information = YAML(typ="safe").load(path.read_text(errors="replace"))["rosbag2_bagfile_information"]
    except (YAMLError, KeyError, TypeError, ValueError, OSError, RecursionError):
        return None
    return information if isinstance(information, dict) else None


def _describe_metadata_problem(path: Path) -> str:
    """Describe why a metadata.yaml cannot be used."""
    if not path.is_file():
        return "is missing"
    size = path.stat().st_size
    return f"has {size} bytes, more than {MAX_METADATA_BYTES}" if size > MAX_METADATA_BYTES else "is broken"


def _make_natural_key(path: Path) -> list[tuple[int, str]]:
    return [(int(piece), "") if piece.isdigit() else (-1, piece) for piece in re.split(r"(\d+)", path.name)]
