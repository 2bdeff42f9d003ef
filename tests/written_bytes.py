"""All that commands wrote, as bytes to search: each file as it is, Parquet as its values, what pages and JSON hold packed unpacked."""

import base64
import binascii
import gzip
import re
import zlib
from collections.abc import Iterator
from pathlib import Path

import pyarrow.parquet as pq

_BASE64 = re.compile(rb"[A-Za-z0-9+/]{24,}={0,2}")


def written_bytes(directory: Path) -> Iterator[tuple[Path, bytes]]:
    """Yield every file below a directory with all that can be read in it, and its own name."""
    for path in sorted(directory.rglob("*")):
        if path.is_file():
            data = path.read_bytes()
            yield path, b"\n".join((str(path.relative_to(directory)).encode(), data, *_unpacked(path, data)))


def _unpacked(path: Path, data: bytes) -> Iterator[bytes]:
    if data[:4] == b"PAR1":
        table = pq.read_table(path)
        yield repr((table.schema.metadata, [(field.name, field.metadata) for field in table.schema])).encode()
        for column in table.columns:
            yield repr(column.to_pylist()).encode()
    for packed in _BASE64.findall(data):
        with_padding = packed.rstrip(b"=") + b"=" * (-len(packed.rstrip(b"=")) % 4)
        try:
            plain = base64.b64decode(with_padding)
        except binascii.Error:
            continue
        yield plain
        for inflate in (gzip.decompress, zlib.decompress, lambda each: zlib.decompress(each, -15)):
            try:
                yield inflate(plain)
            except (OSError, EOFError, zlib.error):
                continue
