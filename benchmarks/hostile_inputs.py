"""Inputs that were made to hurt, and what each may cost: 1 GB of memory and 20 s, a documented exit code, plain lines."""

import bz2
import json
import os
import resource
import socket
import sqlite3
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import closing, suppress
from dataclasses import dataclass
from pathlib import Path

MOST_BYTES, MOST_S, HANGS_S = 1_000_000_000, 20.0, 240.0

_PROGRAM = """import resource, sys
resource.setrlimit(resource.RLIMIT_CPU, (120, 120))
from tcpipe.cli import main
main()"""

_MCAP = b"\x89MCAP0\r\n"

Arguments = tuple[str | bytes | Path, ...]


@dataclass(frozen=True)
class Hostile:
    """One input: writes itself into an empty directory and returns the commands to try there."""

    name: str
    make: Callable[[Path], list[Arguments]]
    codes: tuple[int, ...] = (1, 2, 3)


def _log(name: str) -> list[Arguments]:
    return [("inspect", name), ("ingest", name)]


def _text(size: int) -> bytes:
    return struct.pack("<I", size)


def _record(opcode: int, body: bytes = b"") -> bytes:
    return bytes([opcode]) + struct.pack("<Q", len(body)) + body


def _mcap(records: bytes) -> bytes:
    return _MCAP + _record(1, _text(4) + b"ros2" + _text(0)) + records


def _empty_records(opcode: int) -> Callable[[Path], list[Arguments]]:
    def make(place: Path) -> list[Arguments]:
        (place / "a.mcap").write_bytes(_mcap(_record(opcode) * (4_000_000 // 9)))
        return _log("a.mcap")

    return make


def _inflating(declared: int | None) -> Callable[[Path], list[Arguments]]:
    """Return the maker of a chunk of 4 GB in few bytes."""

    def make(place: Path) -> list[Arguments]:
        import zstandard

        packer, zeros = zstandard.ZstdCompressor().compressobj(), bytes(1 << 24)
        packed = b"".join(packer.compress(zeros) for _ in range(256)) + packer.flush()
        size = (256 << 24) if declared is None else declared
        head = struct.pack("<QQQI", 0, 0, size, 0) + _text(4) + b"zstd" + struct.pack("<Q", len(packed))
        (place / "a.mcap").write_bytes(_mcap(_record(6, head + packed)))
        return _log("a.mcap")

    return make


def _inflating_bag(place: Path) -> list[Arguments]:
    def fields(**values: bytes) -> bytes:
        said = b"".join(_text(len(key) + 1 + len(value)) + key.encode() + b"=" + value for key, value in values.items())
        return _text(len(said)) + said

    packer, zeros = bz2.BZ2Compressor(), bytes(1 << 24)
    packed = b"".join(packer.compress(zeros) for _ in range(20)) + packer.flush()
    head = fields(op=b"\x03", index_pos=bytes(8), conn_count=bytes(4), chunk_count=struct.pack("<I", 1))
    chunk = fields(op=b"\x05", compression=b"bz2", size=struct.pack("<I", 0xFFFFFFF0))
    (place / "a.bag").write_bytes(b"#ROSBAG V2.0\n" + head + _text(0) + chunk + _text(len(packed)) + packed)
    return _log("a.bag")


def _definition(text: str) -> Callable[[Path], list[Arguments]]:
    """Return the maker of a log with one message of a type that is defined so."""

    def make(place: Path) -> list[Arguments]:
        body = text.encode()
        schema = struct.pack("<H", 1) + _text(9) + b"a/msg/One" + _text(7) + b"ros2msg" + _text(len(body)) + body
        channel = struct.pack("<HH", 1, 1) + _text(2) + b"/a" + _text(3) + b"cdr" + _text(0)
        message = struct.pack("<HIQQ", 1, 0, 1, 1) + b"\0\1\0\0" + bytes(64)
        (place / "a.mcap").write_bytes(_mcap(_record(3, schema) + _record(4, channel) + _record(5, message)))
        return [*_log("a.mcap"), ("export", "a.mcap", "table")]

    return make


def _topic(name: str) -> Callable[[Path], list[Arguments]]:
    def make(place: Path) -> list[Arguments]:
        text = name.encode()
        body = b"string data"
        schema = (
            struct.pack("<H", 1) + _text(19) + b"std_msgs/msg/String" + _text(7) + b"ros2msg" + _text(len(body)) + body
        )
        channel = struct.pack("<HH", 1, 1) + _text(len(text)) + text + _text(3) + b"cdr" + _text(0)
        message = struct.pack("<HIQQ", 1, 0, 1, 1) + b"\0\1\0\0" + _text(2) + b"a\0"
        (place / "a.mcap").write_bytes(_mcap(_record(3, schema) + _record(4, channel) + _record(5, message)))
        return [*_log("a.mcap"), ("export", "a.mcap", "table")]

    return make


def _metadata(text: str) -> Callable[[Path], list[Arguments]]:
    def make(place: Path) -> list[Arguments]:
        (place / "bag").mkdir()
        (place / "bag" / "metadata.yaml").write_text(text)
        (place / "bag" / "bag_0.db3").write_bytes(b"SQLite format 3\0" + bytes(84))
        return _log("bag")

    return make


def _many_topics(place: Path) -> list[Arguments]:
    with closing(sqlite3.connect(place / "a.db3")) as database:
        database.execute(
            "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT, offered_qos_profiles TEXT)"
        )
        database.execute(
            "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB)"
        )
        rows = ((number, f"/topic/{number}", "std_msgs/msg/String", "cdr", "") for number in range(1_000_000))
        database.executemany("INSERT INTO topics VALUES (?, ?, ?, ?, ?)", rows)
        database.commit()
    return _log("a.db3")


def _special(kind: str) -> Callable[[Path], list[Arguments]]:
    """Return the maker of what is no file."""

    def make(place: Path) -> list[Arguments]:
        path = place / "a.mcap"
        if kind == "fifo":
            os.mkfifo(path)
        elif kind == "socket":
            with socket.socket(socket.AF_UNIX) as one:
                before = Path.cwd()
                os.chdir(place)  # a socket's path is short
                one.bind("a.mcap")
                os.chdir(before)
        elif kind == "device":
            path.symlink_to("/dev/zero")
        elif kind == "loop":
            path.symlink_to("a.mcap")
            (place / "down").mkdir()
            (place / "down" / "up").symlink_to("..")
        return [*_log("a.mcap"), ("ingest", ".")]

    return make


def _tif(text: str) -> Callable[[Path], list[Arguments]]:
    def make(place: Path) -> list[Arguments]:
        (place / "a.tif").write_text(text)
        return [("add-map", "a", "--height", "a.tif"), ("inspect", "a.tif")]

    return make


def _sparse(side: int) -> Callable[[Path], list[Arguments]]:
    """Return the maker of a raster of which nothing is stored."""

    def make(place: Path) -> list[Arguments]:
        import rasterio

        where = rasterio.Affine(0.1, 0, 500_000, 0, -0.1, 5_200_000)
        with rasterio.open(
            place / "a.tif", "w", driver="GTiff", height=side, width=side, count=1, dtype="float32", crs="EPSG:32633",
            transform=where, tiled=True, SPARSE_OK=True, BIGTIFF="YES",
        ):  # fmt: skip
            pass
        return [("add-map", "a", "--height", "a.tif")]

    return make


def _small_map(place: Path) -> Arguments:
    """Write a height raster and return the command for it."""
    import numpy as np
    import rasterio

    where = rasterio.Affine(1.0, 0, 500_000, 0, -1.0, 5_200_000)
    kinds = {"h": "float32", "t": "uint8"}
    for name, kind in kinds.items():
        with rasterio.open(
            place / f"{name}.tif",
            "w",
            driver="GTiff",
            height=40,
            width=40,
            count=1,
            dtype=kind,
            crs="EPSG:32633",
            transform=where,
        ) as raster:
            raster.write(np.full((1, 40, 40), 4, kind))
    return ("add-map", "a", "--height", "h.tif", "--terrain")


def _classes(text: str) -> Callable[[Path], list[Arguments]]:
    def make(place: Path) -> list[Arguments]:
        command = _small_map(place)
        (place / "c.csv").write_text(text)
        return [(*command, "t.tif", "--classes", "c.csv")]

    return make


def _polygons(text: Callable[[], str]) -> Callable[[Path], list[Arguments]]:
    """Return the maker of a GeoJSON file, taken as terrain and as region."""

    def make(place: Path) -> list[Arguments]:
        command = _small_map(place)
        (place / "t.geojson").write_text(text())
        (place / "tcpipe-store").mkdir()
        return [(*command, "t.geojson"), ("build-dataset", "--split", "t.geojson")]

    return make


def _ring(vertices: int) -> str:
    import math

    ring = [
        [15 + 1e-3 * math.cos(6.283 * n / vertices), 46.9 + 1e-3 * math.sin(6.283 * n / vertices)]
        for n in range(vertices)
    ]
    geometry = {"type": "Polygon", "coordinates": [[*ring, ring[0]]]}
    return json.dumps(
        {
            "type": "FeatureCollection",
            "features": [{"type": "Feature", "properties": {"class": "grass"}, "geometry": geometry}],
        }
    )


def _recipe(text: str) -> Callable[[Path], list[Arguments]]:
    def make(place: Path) -> list[Arguments]:
        (place / "tcpipe.toml").write_text(text)
        return [("ingest", "good.mcap")]

    return make


_EXTREMES = (
    "segment.chord_m = 1e300", "segment.chord_m = 1e-300", "segment.chord_m = nan", "segment.chord_m = -1",
    "fuse.rate_hz = 1e300", "mask.acceleration_window_s = 1e300", "mask.min_event_s = 1e-300", "split.block_m = 1e-300",
    "sample.patch_px = 1000000", "sample.patch_m = 1e300",
)  # fmt: skip


def _dataset(spoil: Callable[[Path], None], *commands: Arguments) -> Callable[[Path], list[Arguments]]:
    """Return the maker of a small dataset that is spoilt and sealed again, so that all its checksums agree."""

    def make(place: Path) -> list[Arguments]:
        sys.path[:0] = [str(Path(__file__).parents[1] / "tests")]
        from synthetic_store import small_store

        from tcpipe.formats.integrity import compute_checksums, write_sealed
        from tcpipe.pipeline.dataset.build import build_dataset

        build_dataset(place / "d", store=small_store(place).root)
        card = json.loads((place / "d" / "dataset.json").read_text())
        spoil(place / "d")
        known = compute_checksums(place / "d")
        card["checksums"] = {
            name: {"size_bytes": known[name].size_bytes, "sha256": known[name].sha256} for name in card["checksums"]
        }
        write_sealed(place / "d" / "dataset.json", card)
        return [("verify", "d"), *commands]

    return make


def _one_text_in_each_row(place: Path) -> None:
    import numpy as np
    import pyarrow as pa
    import pyarrow.parquet as pq

    table = pq.read_table(place / "samples.parquet")
    indices = pa.array(np.zeros(table.num_rows, np.int32))
    texts = pa.DictionaryArray.from_arrays(indices, pa.array(["x" * 12_000_000]))
    table = table.set_column(table.column_names.index("robot"), "robot", texts)
    pq.write_table(table, place / "samples.parquet", compression="zstd", store_schema=False)


def _many_rows(place: Path) -> None:
    import numpy as np
    import pyarrow as pa
    import pyarrow.parquet as pq

    names = pq.read_schema(place / "samples.parquet").names
    pq.write_table(
        pa.table({name: np.zeros(5_000_000) for name in names[:20]}), place / "samples.parquet", compression="zstd"
    )


def _chunk_grid(value: object) -> Callable[[Path], None]:
    def spoil(place: Path) -> None:
        path = place / "patches.zarr" / "height" / "zarr.json"
        described = json.loads(path.read_text())
        described["chunk_grid"]["configuration"]["chunk_shape"][0] = value
        path.write_text(json.dumps(described))

    return spoil


def _named(name: bytes) -> Callable[[Path], list[Arguments]]:
    def make(place: Path) -> list[Arguments]:
        path = os.fsencode(place) + b"/" + name
        with open(path, "wb") as stream:  # noqa: PTH123  a name that is no text
            stream.write(_mcap(b""))
        return [("inspect", name), ("ingest", name), ("ingest", ".")]

    return make


def hostile_inputs() -> Iterator[Hostile]:
    """Yield them all."""
    for opcode, name in (
        (3, "schemas"),
        (4, "channels"),
        (5, "messages"),
        (6, "chunks"),
        (8, "indexes"),
        (11, "statistics"),
        (0x90, "unknown"),
    ):
        yield Hostile(f"mcap: 4 MB of empty records ({name})", _empty_records(opcode))
    yield Hostile("mcap: a chunk of 4 GB in 130 kB", _inflating(None))
    yield Hostile("mcap: a chunk that says 1 MB and is 4 GB", _inflating(1 << 20))
    yield Hostile("mcap: a chunk that says 2^60 bytes", _inflating(1 << 60))
    yield Hostile("bag: a chunk that inflates", _inflating_bag)
    yield Hostile("definition: a field of 2^31 bytes", _definition("uint8[2147483647] a"))
    yield Hostile(
        "definition: 2^62 numbers in nested arrays",
        _definition("b/B[2147483647] a\n" + "=" * 80 + "\nMSG: b/B\nfloat64[2147483647] a"),
    )
    yield Hostile("definition: a type that holds itself", _definition("a/One a"))
    yield Hostile(
        "definition: 2^40 fields by doubling",
        _definition(
            "b/T0 a"
            + "".join(f"\n{'=' * 80}\nMSG: b/T{n}\nb/T{n + 1} a\nb/T{n + 1} b" for n in range(40))
            + f"\n{'=' * 80}\nMSG: b/T40\nuint8 a"
        ),
    )
    yield Hostile("definition: 200,000 fields", _definition("\n".join(f"uint8 a{n}" for n in range(200_000))))
    yield Hostile(
        "definition: 5,000 types in one another",
        _definition("b/T0 a" + "".join(f"\n{'=' * 80}\nMSG: b/T{n}\nb/T{n + 1} a" for n in range(5000))),
    )
    yield Hostile("topic: ANSI and newlines in its name", _topic("/a\x1b[31m\n\r\x07b"), (0, 1, 3))
    yield Hostile("topic: a name of 100 kB", _topic("/" + "a" * 100_000), (0, 1, 3))
    yield Hostile("topic: a name that climbs", _topic("/../../../a"), (0, 1, 3))
    yield Hostile("metadata.yaml of 20 MB", _metadata("a: [" + "1, " * 7_000_000 + "1]"))
    yield Hostile(
        "metadata.yaml: a billion laughs",
        _metadata("a0: &a0 [x]\n" + "".join(f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 10)}]\n" for n in range(1, 12))),
    )
    yield Hostile("metadata.yaml nested 100,000 deep", _metadata("a: " + "[" * 100_000))
    yield Hostile("db3 of a million topics", _many_topics)
    for kind in ("fifo", "socket", "device", "loop"):
        yield Hostile(f"a log that is a {kind}", _special(kind))
    for name in (b"a\nb.mcap", b"a\x1b[31mb.mcap", b"a\xff\xfe.mcap", "äöü日本.mcap".encode(), b"a" * 250 + b".mcap"):
        yield Hostile(f"a log called {name[:20]!a}", _named(name))
    yield Hostile("raster: sparse, 10^10 pixels", _sparse(100_000))
    yield Hostile("raster: sparse, 10^12 pixels", _sparse(1_000_000))
    yield Hostile(
        "raster: VRT that names /etc/passwd",
        _tif(
            '<VRTDataset rasterXSize="9" rasterYSize="9"><VRTRasterBand dataType="Byte" band="1" subClass="VRTRawRasterBand">'
            '<SourceFilename relativeToVRT="0">/etc/passwd</SourceFilename></VRTRasterBand></VRTDataset>'
        ),
    )
    yield Hostile(
        "raster: WMS",
        _tif(
            '<GDAL_WMS><Service name="TMS"><ServerUrl>http://127.0.0.1:9/${z}/${x}/${y}</ServerUrl></Service></GDAL_WMS>'
        ),
    )
    yield Hostile("raster: XML nested 100,000 deep", _tif("<VRTDataset>" * 100_000))
    yield Hostile("raster: 268 bytes of comments", _tif("<!---->" * 38 + "<?"))
    yield Hostile("definition: a megabyte of =", _definition("uint8 a\n" + "=" * 1_000_000))
    yield Hostile("dataset: 5 GB of one text in 1 MB", _dataset(_one_text_in_each_row, ("diff", "d", "d")), (0, 1))
    yield Hostile("dataset: 800 MB of zeros for 448 rows", _dataset(_many_rows))
    for value in (0, "wide", 1e30, 2.56e11):
        yield Hostile(f"dataset: chunk_grid of {value}", _dataset(_chunk_grid(value), ("diff", "d", "d")), (0, 1, 2, 3))
    yield Hostile("classes: ANSI in a name", _classes("value,id,name,traversable\n4,4,gr\x1b[31mass,true\n"))
    yield Hostile(
        "classes: a million rows",
        _classes("value,id,name,traversable\n" + "".join(f"{n},{n},c{n},true\n" for n in range(1_000_000))),
    )
    yield Hostile("classes: a name of 10 MB", _classes(f"value,id,name,traversable\n4,4,{'g' * 10_000_000},true\n"))
    yield Hostile("GeoJSON: a ring of a million vertices", _polygons(lambda: _ring(1_000_000)))
    yield Hostile("GeoJSON: nested 100,000 deep", _polygons(lambda: "[" * 100_000))
    yield Hostile(
        "GeoJSON: coordinates nested 900 deep",
        _polygons(lambda: '{"type":"Polygon","coordinates":' + "[" * 900 + "]" * 900 + "}"),
    )
    yield Hostile(
        "GeoJSON: numbers of 5,000 digits",
        _polygons(lambda: '{"type":"Polygon","coordinates":[[[' + "9" * 5000 + ",1],[1,2],[2,2],[1,1]]]}"),
    )
    yield Hostile("recipe: nested 100,000 deep", _recipe("a = " + "[" * 100_000))
    yield Hostile("recipe: tables nested 100,000 deep", _recipe("[" + ".".join("a" * 100_000) + "]\n"))
    yield Hostile("recipe: 900 kB of dots", _recipe("[" + ".".join("a" * 450_000) + "]\n"))
    yield Hostile("recipe: 40 MB", _recipe("# " + "x" * 40_000_000))
    for line in _EXTREMES:
        yield Hostile(f"recipe: {line}", _recipe(line), (0, 1, 2, 3))


def try_all(good: Path, only: str) -> bool:
    """Try them all beside a good log; print a line for each; return whether all are as wanted."""
    print(f"{'':46} {'codes':>9} {'CPU s':>7} {'MB':>6}", flush=True)
    fine = True
    for hostile in hostile_inputs():
        if only and only not in hostile.name:
            continue
        with tempfile.TemporaryDirectory() as place:
            if hostile.name.startswith("recipe"):
                (Path(place) / "good.mcap").symlink_to(good)
            tried = [_tried(hostile, arguments, Path(place)) for arguments in hostile.make(Path(place))]
        codes = ",".join(str(code) for code, *_ in tried)
        print(
            f"{hostile.name:46} {codes:>9} {max(t[1] for t in tried):7.1f} {max(t[2] for t in tried) / 1e6:6.0f}",
            flush=True,
        )
        for line in [line for *_, lines in tried for line in lines]:
            fine = False
            print(f"    {line}", flush=True)
    print(
        f"\nfalse if: a command needs more than {MOST_BYTES / 1e9:g} GB or {MOST_S:g} s of CPU, or {HANGS_S:g} s in all; ends with"
        "\nanother code than those documented; tells a traceback or an internal error; prints a control character, or 1 MB."
    )
    return fine


def _tried(hostile: Hostile, arguments: Arguments, place: Path) -> tuple[int, float, int, list[str]]:
    """Run a command in a process of its own; return its code, CPU time [s], peak memory [byte] and what is wrong."""
    clean = {key: value for key, value in os.environ.items() if not key.startswith("TCPIPE_")}
    with tempfile.TemporaryFile() as output:
        begun = time.monotonic()
        child = subprocess.Popen(
            [sys.executable, "-c", _PROGRAM, *arguments], cwd=place, env=clean, stdout=output, stderr=output
        )
        try:
            status, used, peak = _wait(child.pid, begun + HANGS_S)
        finally:
            child.returncode = 0
        output.seek(0)
        said = output.read()
    code, cpu_s = os.waitstatus_to_exitcode(status), used.ru_utime + used.ru_stime
    wrong = []
    if code not in hostile.codes:
        wrong.append(f"ends with {code}")
    if cpu_s > MOST_S or peak > MOST_BYTES or time.monotonic() - begun > HANGS_S:
        wrong.append(f"costs {cpu_s:.1f} s of CPU, {time.monotonic() - begun:.1f} s in all, {peak / 1e6:.0f} MB")
    if b"Traceback" in said or b"internal error" in said:
        wrong.append("is not told plainly")
    if any(byte < 32 and byte not in b"\n\t" for byte in said):
        wrong.append("prints control characters")
    if len(said) > 1_000_000:
        wrong.append(f"prints {len(said)} bytes")
    told = said.decode(errors="replace").strip()[-300:]
    return (
        code,
        cpu_s,
        peak,
        [f"{' '.join(map(os.fsdecode, arguments))[:80]!a}: {'; '.join(wrong)}: {told!a}"] if wrong else [],
    )


def _wait(child: int, deadline: float) -> tuple[int, resource.struct_rusage, int]:
    """Return how a child ended, what it used, and its peak memory [byte], which the system's own figure mixes with ours."""
    peak = 0
    while True:
        with suppress(OSError, IndexError):
            peak = max(peak, 1024 * int(Path(f"/proc/{child}/status").read_text().split("VmHWM:")[1].split()[0]))
        found, status, used = os.wait4(child, os.WNOHANG)
        if found:
            return status, used, peak
        if time.monotonic() > deadline:
            os.kill(child, 9)
            deadline = float("inf")
        time.sleep(0.01)
