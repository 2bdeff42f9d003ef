"""Which container a file of a log is, told by its content, not by its name."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path
from shlex import quote

from tcpipe.errors import LogError
from tcpipe.formats.atomic import make_scratch_directory
from tcpipe.formats.logs import bag_records, mcap_records, sqlite_file
from tcpipe.formats.logs.bag_file import BagPart
from tcpipe.formats.logs.log_part import FetchedFile, LogPart
from tcpipe.formats.logs.mcap_file import McapPart
from tcpipe.formats.logs.rosbag2 import ZSTD_MAGIC, decompress_file
from tcpipe.formats.logs.sqlite_file import SqlitePart
from tcpipe.formats.logs.table_folders import is_table
from tcpipe.logs.topics import AutopilotKind

WANTED = "expected an .mcap, a .bag (2.0), a .db3, a ROS 2 bag directory, a .ulg, ArduPilot's .bin or tables that the recipe maps"
_AUTOPILOTS: dict[bytes, AutopilotKind] = {b"ULog\x01\x12\x35": "ulog", b"\xa3\x95\x80\x80\x59": "dataflash"}
"""How their logs begin; DataFlash's with the format of formats."""
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


def open_part(path: Path, name: str, stack: ExitStack, fetched: FetchedFile | None) -> LogPart:
    """Open a file of a log until the stack ends; `LogError` where it is none, which says what it seems to be."""
    magic, given = _read_magic(path, fetched), path
    if fetched is not None and not magic.startswith((mcap_records.MAGIC, bag_records.MAGIC)):
        fetched.whole()
    if magic.startswith(ZSTD_MAGIC):
        path = decompress_file(path, stack.enter_context(make_scratch_directory()))
        magic = _read_magic(path, None)
    part: LogPart
    if magic.startswith(mcap_records.MAGIC) or _read_tail(path, len(mcap_records.MAGIC)) == mcap_records.MAGIC:
        part = McapPart(path, name, fetched)
    elif magic.startswith(bag_records.MAGIC):
        part = BagPart(path, name, fetched)
    elif magic.startswith(sqlite_file.MAGIC):
        part = SqlitePart(path, name)
    else:
        held = "" if path == given else "what it holds, decompressed: "
        wanted = (
            f"'tcpipe init --from {quote(str(given))}' writes a recipe for a table" if is_table(given.name) else WANTED
        )
        raise LogError(f"{given}: not a log: {held}{_describe_other_file(path, magic)}; {wanted}")
    stack.callback(part.close)
    return part


def find_autopilot(path: Path) -> AutopilotKind | None:
    """Return ``ulog`` or ``dataflash`` where a file begins like a log of an autopilot, None elsewhere."""
    magic = _read_magic(path, None) if path.is_file() else b""
    return next((kind for start, kind in _AUTOPILOTS.items() if magic.startswith(start)), None)


def _read_magic(path: Path, fetched: FetchedFile | None) -> bytes:
    if fetched is not None and not fetched.is_whole:
        return fetched.read(0, 16)
    try:
        with path.open("rb") as file:
            return file.read(16)
    except OSError as error:
        raise LogError(f"{path}: it cannot be read ({error.strerror})") from None


def _read_tail(path: Path, size: int) -> bytes:
    """Return a file's last bytes; nothing where they cannot be read."""
    try:
        with path.open("rb") as file:
            file.seek(max(path.stat().st_size - size, 0))
            return file.read(size)
    except OSError:
        return b""


def _describe_other_file(path: Path, magic: bytes) -> str:
    """Say what a file that is no log seems to be."""
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
