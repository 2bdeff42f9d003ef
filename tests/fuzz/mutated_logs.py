"""Small logs of every container with a changed structure, and an oracle: each loss and change is reported.

By hand: ``python benchmarks/faults.py mutations``. Each mutation changes one to three places of a log (lengths, op codes, ids, stamps,
CRCs, indexes; SQLite's page heads, cell pointers, varints, serial types, chains; or any bytes), or cuts, inserts, deletes or swaps. The
log is then read twice, all topics at once and one in pieces, and judged:

- ``refused``: one plain line, nothing is read.
- ``same``: every message is read as it was written, and nothing else.
- ``told``: messages are missing or differ, and damage that is a loss is reported.
- ``value``: a message differs, unsaid, in bytes that are its own value and that no checksum covers. So many messages are read as were
  written, and those whose own bytes were left alone are equal. A message's own bytes are its payload and publish time; in a .db3, and
  outside the chunks of an .mcap, also topic id and log time, which stand there once only (.bag and .mcap repeat them in an index, so that
  a change is seen); for all messages of a topic its name, type and definition. In a compressed chunk without checksum these bytes cannot
  be told apart: there the payloads of the chunk's messages are their own, topics and times are not. In a chunk that has a CRC nothing is.
- ``silent``: anything else, and any exception that is no `LogError`. There must be none.

What nobody can know is not tried: a whole message, row or chunk taken cleanly out of a log that nowhere counts them.
"""

import json
import sqlite3
import struct
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

import numpy as np
from mcap.writer import CompressionType, IndexType
from random_messages import ROS1, ROS2, START_NS, Message, write_bag, write_mcap, write_rosbag2
from rosbags.rosbag1 import Writer as BagWriter

from tcpipe.errors import LogError
from tcpipe.formats.logs.log_file import open_log

_PIECE = 4
_PIECE_BYTES = 1 << 10
"""Size of the tables that one topic alone is read in [bytes]."""
Row = tuple[str, int, str]
"""A message: topic, log time, content."""
Rows = Counter[Row]


@dataclass(frozen=True)
class Clean:
    """An intact log: its bytes, messages, where their own bytes lie, and the places (byte, width) of its structure."""

    kind: str
    data: bytes
    rows: Rows
    own: tuple[frozenset[Row], ...]
    """Messages that own each byte."""
    compressed: tuple[tuple[int, int], ...]
    """Ranges of compressed data that no checksum covers."""
    places: tuple[tuple[int, int], ...]
    whole: tuple[tuple[int, int], ...]
    """Ranges of whole records, where the log counts what it holds."""


@dataclass(frozen=True)
class Finding:
    """Outcome of one mutated log."""

    kind: str
    verdict: str
    what: str


# ---------------------------------------------------------------- intact logs
def clean_logs(directory: Path) -> list[Clean]:
    """Write the logs that are changed."""
    messages, ros1 = _messages(ROS2), _messages(ROS1)
    none, lz4, zstd = CompressionType.NONE, CompressionType.LZ4, CompressionType.ZSTD
    mcaps = {
        "zstd, crc": {"compression": zstd},
        "lz4, crc": {"compression": lz4},
        "plain, crc": {"compression": none},
        "plain": {"compression": none, "enable_crcs": False},
        "zstd": {"compression": zstd, "enable_crcs": False},
        "unchunked, data crc": {"use_chunking": False, "enable_data_crcs": True},
        "unchunked": {"use_chunking": False, "enable_crcs": False},
        "without index, plain, crc": {"compression": none, "index_types": IndexType.NONE},
        "without index, zstd, crc": {"compression": zstd, "index_types": IndexType.NONE},
    }
    found = []
    for name, options in mcaps.items():
        data = write_mcap(directory / "a.mcap", messages, chunk_bytes=700, **options).read_bytes()
        found.append(_mcap(f"mcap, {name}", data))
        if name in ("zstd, crc", "plain"):
            found.append(_mcap(f"mcap, {name}, not closed", data[: _end_of_data(data)]))
    for name, codec in (
        ("plain", None),
        ("lz4", BagWriter.CompressionFormat.LZ4),
        ("bz2", BagWriter.CompressionFormat.BZ2),
    ):
        path = directory / f"{name}.bag"
        data = write_bag(path, ros1, codec, chunk_bytes=700).read_bytes()
        found.append(_bag(f"bag, {name}", data))
    for page_bytes in (4096, 512):
        path = next(
            write_rosbag2(directory / f"db3-{page_bytes}", _messages(ROS2, long=page_bytes == 512)).glob("*.db3")
        )
        with closing(sqlite3.connect(path, isolation_level=None)) as database:
            database.execute(f"PRAGMA page_size = {page_bytes}")
            database.execute("VACUUM")
            found.append(_db3(f"db3, {page_bytes}", path.read_bytes(), path))
            database.execute("DELETE FROM messages WHERE id % 5 = 2")
        found.append(_db3(f"db3, {page_bytes}, rows deleted", path.read_bytes(), path))
    return found


def _messages(store: object, *, long: bool = False) -> list[Message]:
    """Return messages of two topics with payloads that occur once in a log."""
    rng = np.random.default_rng(5)
    serialize = ROS1.serialize_ros1 if store is ROS1 else ROS2.serialize_cdr
    color, text = "std_msgs/msg/ColorRGBA", "std_msgs/msg/String"
    types = (ROS1 if store is ROS1 else ROS2).types
    found = []
    for index in range(24):
        stamp = START_NS + index * 10_000_000 + int(rng.integers(3_000_000))
        rgba = types[color](*map(float, rng.normal(size=4).astype(np.float32)))
        found.append(Message("/color", color, stamp, bytes(serialize(rgba, color)), None))
        size = int(rng.integers(400, 1500)) if long and index % 4 == 0 else 12
        said = types[text]("".join(rng.choice(list("abcdefghijklmnop"), size)))
        found.append(Message("/said", text, stamp + 7, bytes(serialize(said, text)), None))
    return found


def _clean(
    kind: str,
    data: bytes,
    places: Sequence[tuple[int, int]],
    *,
    compressed: Sequence[tuple[int, int]] = (),
    whole: Sequence[tuple[int, int]] = (),
) -> Clean:
    """Find out whose own each byte is: payloads by their content, names and definitions by theirs."""
    checked = "crc" in kind or "bz2" in kind
    rows, payloads, texts = _written(data)
    own: list[set[Row]] = [set() for _ in data]
    squeezed = () if checked else tuple(compressed)
    if not checked:
        for row, payload in payloads.items():
            _own_values(own, kind, data, row, payload)
    if not checked or kind.startswith("bag"):  # connections lie outside the chunks
        for topic, names in texts.items():
            for name in names:
                _own(own, data, name, {row for row in rows if row[0] == topic})
    for start, end in squeezed:
        for byte in range(start, end):
            own[byte] |= rows.keys()
    return Clean(kind, data, rows, tuple(map(frozenset, own)), squeezed, tuple(places), tuple(whole))


def _own_values(own: list[set[Row]], kind: str, data: bytes, row: Row, payload: bytes) -> None:
    """Record the bytes of a message's payload, and of its times and ids that occur once."""
    step = 1 if len(payload) > 100 else _PIECE  # long ones lie on several pages
    for start in range(0, len(payload) - _PIECE + 1, step):
        _own(own, data, payload[start : start + _PIECE], {row})
    _own(own, data, payload, {row})
    fixed = struct.pack(">q", row[1]) if kind.startswith("db3") else payload
    before, after = {"db3": (1, 8), "mca": (22 if "unchunked" in kind else 8, 0), "bag": (0, 0)}[kind[:3]]
    at = data.find(fixed)
    while at >= 0:
        for byte in range(at - before, at + after):
            own[byte].add(row)
        at = data.find(fixed, at + 1)


def _own(own: list[set[Row]], data: bytes, piece: bytes, rows: set[Row]) -> None:
    at = data.find(piece)
    while at >= 0:
        for byte in range(at, at + len(piece)):
            own[byte] |= rows
        at = data.find(piece, at + 1)


def _written(data: bytes) -> tuple[Rows, dict[Row, bytes], dict[str, list[bytes]]]:
    """Return the messages, the payload of each, and the texts that each topic's messages depend on."""
    with _file(data) as path, open_log(path) as log:
        rows, payloads = _rows(log.tables(log.topics)), {}
        for part in log._parts:  # the bytes themselves
            for block in part.blocks(frozenset(part.channels)):
                topic = part.channels[block.channel].name
                for at, length, stamp in zip(
                    block.offsets.tolist(), block.lengths.tolist(), block.log_time_ns.tolist(), strict=True
                ):
                    (row,) = (row for row in rows if row[:2] == (topic, stamp))
                    payloads[row] = bytes(block.buffer[at : at + length])
        texts = {
            name: [
                text.encode()
                for text in (name, of.type_name, of.type_name.replace("/msg/", "/"), of.definition, of.encoding)
                if text
            ]
            for name, of in log.topics.items()
        }
    return rows, payloads, texts


def _rows(tables: dict[str, object]) -> Rows:
    return Counter(
        (name, row.pop("log_time_ns"), json.dumps(row)) for name, table in tables.items() for row in table.to_pylist()
    )


class _file:  # noqa: N801
    """A file of these bytes, in memory where that can be."""

    def __init__(self, data: bytes) -> None:
        self._directory = tempfile.TemporaryDirectory(dir="/dev/shm" if Path("/dev/shm").is_dir() else None)  # noqa: S108
        self._path = Path(self._directory.name, "log")
        self._path.write_bytes(data)

    def __enter__(self) -> Path:
        return self._path

    def __exit__(self, *_error: object) -> None:
        self._directory.cleanup()


# ---------------------------------------------------------------- where the structure is
def _records(data: bytes, start: int, end: int) -> Iterator[tuple[int, int, int]]:
    """Yield (opcode, start, end) of MCAP records."""
    while start + 9 <= end:
        after = start + 9 + struct.unpack_from("<Q", data, start + 1)[0]
        yield data[start], start, after
        start = after


def _end_of_data(data: bytes) -> int:
    return next(start for op, start, _ in _records(data, 8, len(data) - 8) if op == 0x0F)


def _mcap(kind: str, data: bytes) -> Clean:
    places, compressed, whole = [], [], []
    closed = data.endswith(data[:8])
    for op, start, end in _records(data, 8, len(data) - 8 if closed else len(data)):
        places += [(start, 1), (start + 1, 8), *_heads(start + 9, min(end, start + 9 + 80))]
        if closed and op in (5, 6, 7, 8) and kind != "mcap, unchunked":
            whole.append((start, end))
        if op == 6:
            name_bytes = struct.unpack_from("<I", data, start + 9 + 28)[0]
            inside = start + 9 + 40 + name_bytes
            if name_bytes:
                compressed.append((inside, end))
            else:
                for _, first, last in _records(data, inside, end):
                    places += [(first, 1), (first + 1, 8), *_heads(first + 9, min(last, first + 9 + 22))]
    return _clean(kind, data, places, compressed=compressed, whole=whole)


def _heads(start: int, end: int) -> list[tuple[int, int]]:
    return [(at, width) for width in (1, 2, 4, 8) for at in range(start, end - width + 1, width)]


def _bag_records(data: bytes, start: int, end: int) -> Iterator[tuple[int, int, int, int]]:
    """Yield (opcode, start, start of the data, end) of a bag's records."""
    while start + 8 <= end:
        head = struct.unpack_from("<I", data, start)[0]
        body = start + 8 + head
        after = body + struct.unpack_from("<I", data, body - 4)[0]
        yield data[data.index(b"op=", start) + 3], start, body, after
        start = after


def _bag(kind: str, data: bytes) -> Clean:
    places, compressed, whole = [], [], []
    for op, start, body, end in _bag_records(data, 13, len(data)):
        places += [*_heads(start, body), *_heads(body, min(end, body + 40))]
        if op in (4, 5, 6):
            whole.append((start, end))
        if op == 5 and "plain" not in kind:
            compressed.append((body, end))
        elif op == 5:
            for _, first, inner, _ in _bag_records(data, body, end):
                places += _heads(first, inner)
    return _clean(kind, data, places, compressed=compressed, whole=whole)


def _db3(kind: str, data: bytes, path: Path) -> Clean:
    page_bytes = struct.unpack_from(">H", data, 16)[0]
    places = _heads(16, 100)
    for start in range(0, len(data), page_bytes):
        head = start + 100 * (start == 0)
        if data[head] not in (0x0D, 0x05, 0x0A, 0x02):  # an overflow or free page: where the chain goes on
            places += [(head, 4), (head + 4, 4)]
            continue
        interior = data[head] in (0x05, 0x02)
        count, pointers = struct.unpack_from(">H", data, head + 3)[0], head + (12 if interior else 8)
        places += _heads(head, pointers)
        for cell in range(count):
            at = start + struct.unpack_from(">H", data, pointers + 2 * cell)[0]
            places += [(pointers + 2 * cell, 2), *_heads(at, min(at + 18, start + page_bytes))]
    return _clean(kind, data, [(at, width) for at, width in places if at + width <= len(data)])


# ---------------------------------------------------------------- changes
def mutated(clean: Clean, rng: np.random.Generator) -> tuple[bytes, str, set[int]]:
    """Return the log with one to three changes, what they are, and which bytes of the intact one they touch."""
    held, said, touched = bytearray(clean.data), [], set()
    resized = False
    for _ in range(int(rng.choice([1, 1, 1, 2, 3]))):
        if resized:  # places are known no more
            break
        change = _RESIZING[rng.integers(len(_RESIZING))] if rng.random() < 0.15 else None
        if change is not None:
            what, bytes_touched = change(held, clean, rng)
            resized = True
        elif rng.random() < 0.7:
            what, bytes_touched = _change_place(held, clean, rng)
        else:
            what, bytes_touched = _change_bytes(held, rng)
        said.append(what)
        touched |= bytes_touched
    return bytes(held), "; ".join(said), touched


def _change_place(held: bytearray, clean: Clean, rng: np.random.Generator) -> tuple[str, set[int]]:
    """Change a number where the structure is: a bit, by a little, to an extreme, or to another place's."""
    at, width = clean.places[rng.integers(len(clean.places))]
    order = "big" if clean.kind.startswith("db3") else "little"
    before = int.from_bytes(held[at : at + width], order)
    kind, bits = int(rng.integers(4)), 8 * width
    if kind == 0:
        after = before ^ 1 << int(rng.integers(bits))
    elif kind == 1:
        after = before + int(rng.choice([-16, -8, -2, -1, 1, 2, 8, 16]))
    elif kind == 2:
        after = int(rng.choice([0, 1, 127, 128])) if rng.random() < 0.6 else (1 << bits) - 1
    else:
        same = [place for place in clean.places if place[1] == width]
        other = same[rng.integers(len(same))][0]
        after = int.from_bytes(held[other : other + width], order)
    held[at : at + width] = (after % (1 << bits)).to_bytes(width, order)
    return f"{width} bytes at {at}: {before} to {after % (1 << bits)}", set(range(at, at + width))


def _change_bytes(held: bytearray, rng: np.random.Generator) -> tuple[str, set[int]]:
    at, size = int(rng.integers(len(held))), int(rng.integers(1, 40))
    end = min(at + size, len(held))
    kind = int(rng.integers(4))
    if kind == 0:
        end = at + 1
        held[at] ^= 1 << int(rng.integers(8))
    elif kind == 1:
        held[at:end] = bytes([int(rng.choice([0, 255]))]) * (end - at)
    elif kind == 2:
        held[at:end] = rng.bytes(end - at)
    else:
        other = int(rng.integers(len(held) - (end - at) + 1))
        held[at:end] = held[other : other + end - at]
    return f"bytes {at} to {end} (kind {kind})", set(range(at, end))


def _cut(held: bytearray, _clean: Clean, rng: np.random.Generator) -> tuple[str, set[int]]:
    at, size = int(rng.integers(len(held))), len(held)
    del held[at:]
    return f"cut at {at}", set(range(at, size))


def _delete(held: bytearray, _clean: Clean, rng: np.random.Generator) -> tuple[str, set[int]]:
    at, size = int(rng.integers(len(held))), int(rng.integers(1, 60))
    end = min(at + size, len(held))
    del held[at:end]
    return f"bytes {at} to {end} are gone", set(range(at, end))


def _insert(held: bytearray, _clean: Clean, rng: np.random.Generator) -> tuple[str, set[int]]:
    at, size = int(rng.integers(len(held))), int(rng.integers(1, 60))
    held[at:at] = rng.bytes(size) if rng.random() < 0.5 else held[at : at + size]
    return f"{size} bytes more at {at}", {at}


def _move_record(held: bytearray, clean: Clean, rng: np.random.Generator) -> tuple[str, set[int]]:
    """Take a whole record out, double it, or put it in another's place, in a log that counts what it holds."""
    if not clean.whole:
        return _cut(held, clean, rng)
    start, end = clean.whole[rng.integers(len(clean.whole))]
    other, after = clean.whole[rng.integers(len(clean.whole))]
    kind = int(rng.integers(3))
    if kind == 0:
        del held[start:end]
    elif kind == 1:
        held[end:end] = held[start:end]
    else:
        held[other:after] = held[start:end]
    return f"record {start} to {end} ({('gone', 'doubled', f'over {other} to {after}')[kind]})", set()


_Resize = Callable[[bytearray, Clean, np.random.Generator], tuple[str, set[int]]]
_RESIZING: tuple[_Resize, ...] = (_cut, _delete, _insert, _move_record)


# ---------------------------------------------------------------- the oracle
def judged(clean: Clean, data: bytes, touched: set[int], wanted: str | None = None) -> tuple[str, str]:
    """Return the verdict on a changed log, and why; ``wanted`` is the topic that is read, None reads all."""
    expected = Counter({row: count for row, count in clean.rows.items() if wanted in (None, row[0])})
    with _file(data) as path:
        try:
            with open_log(path) as log:
                pieces = [log.tables(log.topics)] if wanted is None else log.batches([wanted], batch_bytes=_PIECE_BYTES)
                found = sum(map(_rows, pieces), Rows())
                damage = log.damage
        except LogError as error:
            return "refused", str(error)
        except Exception as error:  # noqa: BLE001  whatever it is, it is a finding
            return "silent", f"{type(error).__name__}: {error}"
    said = "; ".join(damage)
    if found == expected:
        return "same", said
    if damage:
        return "told", said
    lost, new = expected - found, found - expected
    mine = frozenset().union(*(clean.own[byte] for byte in touched if byte < len(clean.own)))
    # one topic may lose a message to another, or get one, where a topic id is a message's own
    counted = lost.total() == new.total() if wanted is None else new.total() <= len(mine)
    squeezed = any(start <= byte < end for byte in touched for start, end in clean.compressed)
    placed = not squeezed or Counter(row[:2] for row in lost.elements()) == Counter(row[:2] for row in new.elements())
    if counted and placed and lost.keys() <= mine:
        return "value", said
    return "silent", f"lost {list(lost)[:2]} of {lost.total()}, new {list(new)[:2]} of {new.total()}; said: {said}"


def findings(count: int, seed: int) -> Iterator[Finding]:
    """Yield what became of ``count`` mutated logs, the containers in turn."""
    with tempfile.TemporaryDirectory() as scratch:
        logs = clean_logs(Path(scratch))
    containers = [[log for log in logs if log.kind.startswith(name)] for name in ("mcap", "bag", "db3")]
    for number in range(count):
        rng = np.random.default_rng((seed, number))
        some = containers[number % 3]
        clean = some[rng.integers(len(some))]
        data, what, touched = mutated(clean, rng)
        verdict, why = judged(clean, data, touched)
        if verdict != "silent":
            alone = ("/color", "/said")[int(rng.integers(2))]
            again, why_again = judged(clean, data, touched, alone)
            if again == "silent":
                verdict, why = again, f"{alone} alone: {why_again}"
        yield Finding(clean.kind, verdict, f"number {number}: {what}: {why}")
