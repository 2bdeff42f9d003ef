"""Measures whether a change of tcpipe alters a value in any table: streams, track, segments, rejections, samples or patches.

Run it before and after a refactoring, each time at that commit and with a directory that does not exist yet:

    python benchmarks/table_digests.py write BEFORE before.json
    python benchmarks/table_digests.py write AFTER after.json
    python benchmarks/table_digests.py compare before.json after.json
    python benchmarks/table_digests.py compare before.json after.json --renamed velocity=speed --renamed track/old=new

`write` simulates drives with many sets of sensors and one or more for each fault. It ingests them and the third-party
logs below $TCPIPE_TEST_DATA that `digest_runs.py` lists, builds four datasets, and writes a digest of each column of
each table; this takes four minutes of CPU. The digest covers the type, the validity and the values of a column. It
ignores chunks, dictionaries and compression. An entry has the exit status too, which is all that a log gives that
fails. `--logs BEFORE` takes the simulated logs of an earlier call; use it if the change alters the simulator. Use the
same machine and libraries for both calls, since processors differ in the last digits.

`compare` prints what differs or is missing, by table and column, with the names of the runs. It exits with 1 if
anything does. `--renamed` and `--ignore` take the name of a column, a patch array or a table, or one column of one
table as TABLE/COLUMN. TABLE is the name before the change for `--renamed`, and the name after it for `--ignore`.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import re
import subprocess
import sys
import time
import traceback
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
import zarr

sys.path.insert(0, str(Path(__file__).parent))

from digest_runs import find_real_logs, make_drives

import tcpipe

DATA = Path(os.environ.get("TCPIPE_TEST_DATA", Path(__file__).parents[2] / "shared" / "data"))
PROGRAM = Path(tcpipe.__file__).parents[1]
IN_DATASETS = 6
"""Number of logs, from the first, that share the store from which datasets are built."""
RECIPES = {
    "ukf": '[fuse]\nestimator = "ukf"',
    "fused": '[label]\nvelocity = "fused"\nintegration = "right_endpoint"',
    "any speed": "[mask]\nrequire_full_speed = false\nkeep_reversing = true\n[segment]\nchord_m = 2.0",
    "wrong lever arm": "[read.extrinsics.gnss]\nxyz_m = [0.6, 0.0, 0.9]",
}
OTHERWISE = {
    "ukf": ("all sensors", "no visual", "GNSS, IMU", "wrong fixes for 20 s", "warthog_grass_a/run.mcap"),
    "fused": ("all sensors", "GNSS alone"),
    "any speed": ("all sensors", "every manoeuvre", "warthog_grass_a/run.mcap"),
    "wrong lever arm": ("all sensors", "fault gnss_lever_arm"),
}
"""By recipe, the logs that are ingested with it beside the default one."""
DATASETS = {
    "all": "",
    "parquet": "--format parquet --split {region}",
    "split": "--split {region} --holdout sample --seed 3 --covariates {weather}",
    "tag": "--split {region} --holdout tag:season --tag site=simulated --covariates {weather} --format parquet",
}
"""Options of build-dataset."""


def digest_array(array: pa.Array) -> str:
    """Return the type and 16 hexadecimal digits of the sha256 of type, validity and values."""
    if pa.types.is_dictionary(array.type):
        array = array.dictionary_decode()
    found = hashlib.sha256()
    for piece in _yield_bytes(array):
        found.update(len(piece).to_bytes(8, "little") + piece)
    return f"{array.type} {found.hexdigest()[:16]}"


def _yield_bytes(array: pa.Array) -> Iterator[bytes]:
    """Yield the content of an array, which what lies under nulls, offsets and buffers does not change."""
    kind = array.type
    yield str(kind).encode()
    yield np.packbits(array.is_valid().to_numpy(zero_copy_only=False)).tobytes()
    if pa.types.is_dictionary(kind):
        yield from _yield_bytes(array.dictionary_decode())
    elif pa.types.is_timestamp(kind) or pa.types.is_duration(kind):
        yield from _yield_bytes(array.cast(pa.int64()))
    elif pa.types.is_struct(kind):
        for piece in array.flatten():
            yield from _yield_bytes(piece)
    elif pa.types.is_list(kind) or pa.types.is_large_list(kind) or pa.types.is_fixed_size_list(kind):
        yield pc.list_value_length(array).fill_null(0).to_numpy(zero_copy_only=False).astype(np.int64).tobytes()
        yield from _yield_bytes(array.flatten())
    elif pa.types.is_integer(kind) or pa.types.is_floating(kind):
        values = array.fill_null(0).to_numpy(zero_copy_only=False)
        yield (np.where(np.isnan(values), np.nan, values) if values.dtype.kind == "f" else values).tobytes()
    else:
        yield repr(array.to_pylist()).encode()


def digest_table(path: Path) -> dict[str, Any]:
    """Return the rows of a Parquet file and the digest of each column."""
    table = pq.ParquetFile(path).read()
    columns = {
        name: digest_array(pa.concat_arrays(column.chunks) if column.num_chunks else pa.array([], column.type))
        for name, column in zip(table.column_names, table.columns, strict=True)
    }
    return {"rows": table.num_rows, "columns": columns}


def digest_patches(path: Path) -> dict[str, Any]:
    """Return the rows of a Zarr group and the digest of each of its arrays."""
    arrays = {name: np.asarray(array[:]) for name, array in zarr.open_group(path, mode="r").arrays()}
    columns = {}
    for name, values in arrays.items():
        number = values.dtype.kind in "biuf"
        content = np.ascontiguousarray(values).tobytes() if number else repr(values.tolist()).encode()
        kind = f"{values.dtype if number else 'text'}{list(values.shape[1:])}"
        columns[name] = f"{kind} {hashlib.sha256(content).hexdigest()[:16]}"
    return {"rows": max((len(values) for values in arrays.values()), default=0), "columns": columns}


def digest_files(directory: Path, before: frozenset[Path] = frozenset()) -> dict[str, Any]:
    """Return the tables below a directory by the name of their file, without those of before."""
    found: dict[str, Any] = {}
    for path in sorted(_find_tables(directory) - before):
        name, again = path.stem, sum(other.split(" ")[0] == path.stem for other in found)
        name = f"{name} {again + 1}" if again else name
        found[name] = digest_table(path) if path.suffix == ".parquet" else digest_patches(path)
    return found


def _find_tables(directory: Path) -> frozenset[Path]:
    """Return the tables of runs or of a dataset below a directory: neither the index of a store nor its maps."""
    found = {path for path in directory.rglob("*.parquet") if path.name != "index.parquet"}
    return frozenset(found | {path for path in directory.rglob("*.zarr") if "blobs" not in path.parts})


def ingest_log(log: Path, store: Path, recipe: Path, tags: dict[str, str]) -> dict[str, Any]:
    """Ingest a log; return the exit status and the tables that came."""
    before = _find_tables(store)
    try:
        status: Any = tcpipe.ingest([log], store=store, recipe=recipe, tag=tags).exit_code
    except Exception as error:  # noqa: BLE001  whatever it is, it stands in the comparison
        traceback.print_exception(error, limit=-1)
        status = "error"
    return {"exit": status, "tables": digest_files(store, before)}


def run_command(*arguments: str | Path) -> int:
    """Run a command of the tcpipe that this process has imported, without its output; return its exit status."""
    words = [sys.executable, "-m", "tcpipe", *map(str, arguments)]
    return subprocess.run(words, cwd=PROGRAM, capture_output=True, check=False).returncode


def write_digests(out: Path, *, logs_of: Path, quick: bool) -> dict[str, Any]:
    """Make logs, runs and datasets below ``out``; return the digests of all tables."""
    out.mkdir(parents=True)
    logs = make_drives(logs_of, quick=quick)
    simulated = set(logs)
    real = {} if quick else dict(find_real_logs(DATA, out))
    for name in [name for name, log in real.items() if not log.exists()]:
        print(f"{name} is not here and is left out", file=sys.stderr)
        del real[name]
    logs |= real
    wanted = [(name, "default") for name in logs]
    wanted += [(name, recipe) for recipe, names in OTHERWISE.items() for name in names if name in logs and not quick]
    for name, text in {"default": "", **RECIPES}.items():
        (out / f"{name}.toml").write_text(text)
    runs: dict[str, Any] = {}
    for number, (name, recipe) in enumerate(wanted):
        begun_s = time.monotonic()
        shared = number < IN_DATASETS
        store = out / "stores" / ("shared" if shared else f"{number:03d}")
        tags = {"site": "simulated", "season": ("summer", "winter", "spring")[number % 3]} if shared else {}
        run = ingest_log(logs[name], store, out / f"{recipe}.toml", tags)
        if name in simulated and logs[name].is_file():
            run["log"] = hashlib.sha256(logs[name].read_bytes()).hexdigest()[:16]
        runs[name if recipe == "default" else f"{name}, {recipe}"] = run
        took_s = time.monotonic() - begun_s
        print(f"{number + 1}/{len(wanted)} {name}, {recipe}: exit {run['exit']}, {took_s:.1f} s", file=sys.stderr)
    return {"runs": runs, "datasets": build_datasets(out, logs_of / "site", quick=quick)}


def build_datasets(out: Path, site: Path, *, quick: bool) -> dict[str, Any]:
    """Build datasets from the shared store; return the exit status and tables of each."""
    store = ["--store", out / "stores" / "shared"]
    layers = [word for name in ("height", "ortho", "terrain") for word in (f"--{name}", site / "maps" / f"{name}.tif")]
    status = run_command("add-map", "site", *layers, "--classes", site / "maps" / "classes.csv", *store)
    assert status == 0, f"add-map ended with {status}"
    weather = out / "weather.csv"
    hours = [f"{1_700_000_000 - 1800 + 3600 * hour},{5.0 + hour % 7}" for hour in range(IN_DATASETS + 1)]
    weather.write_text("\n".join(["time_s,air_degc", *hours, ""]))
    found = {}
    for name, options in list(DATASETS.items())[: 1 if quick else None]:
        words = [word.format(region=site / "region.geojson", weather=weather) for word in options.split()]
        place = out / "datasets" / name
        status = run_command("build-dataset", place, *words, *store, "--recipe", out / "default.toml")
        found[name] = {"exit": status, "tables": digest_files(place)}
    return found


def flatten_digests(path: Path, renamed: dict[str, str], ignored: set[str]) -> dict[tuple[str, str, str], Any]:
    """Return the values of a file by run or dataset, table and column; names of tables and columns are those that are to be."""
    found: dict[tuple[str, str, str], Any] = {}
    for kind, entries in json.loads(path.read_text()).items():
        for name, entry in entries.items():
            of = f"{kind[:-1]} {name}"
            found |= {(of, "", key): entry[key] for key in ("exit", "log") if key in entry}
            for old_table, content in entry["tables"].items():
                table = renamed.get(old_table, old_table)
                found[of, table, "(rows)"] = content["rows"]
                for old, digest in content["columns"].items():
                    column = renamed.get(f"{old_table}/{old}", renamed.get(old, old))
                    if (of, table, column) in found:
                        sys.exit(f"{of}, {table}: two columns would be called {column}; give --renamed TABLE/OLD=NEW")
                    found[of, table, column] = digest
    return {key: value for key, value in found.items() if not {key[1], key[2], f"{key[1]}/{key[2]}"} & (ignored - {""})}


def compare_digests(first: dict[tuple[str, str, str], Any], second: dict[tuple[str, str, str], Any]) -> list[str]:
    """Return a line for each difference, which names the runs and datasets that have it."""
    held = [({key[0] for key in side}, {key[:2] for key in side}) for side in (first, second)]
    differing: dict[str, list[str]] = defaultdict(list)
    for key in sorted(first.keys() | second.keys()):
        of, table, column = key
        column_name = f"{table}: {column}" if table else column
        lacking = [k for k, side in enumerate((first, second)) if key not in side]
        if not lacking:
            if first[key] != second[key]:
                is_count = isinstance(first[key], int) and isinstance(second[key], int)
                note = f" ({first[key]}, then {second[key]})" if is_count else ""
                differing[f"{column_name} differs"].append(of + note)
            continue
        where = ("the first", "the second")[lacking[0]]
        runs, tables = held[lacking[0]]
        if of not in runs:
            differing[f"missing in {where}"].append(of)
        elif key[:2] not in tables:
            differing[f"table {table} is missing in {where}"].append(of)
        else:
            differing[f"{column_name} is missing in {where}"].append(of)
    return [f"{what}: {_list_names(names)}" for what, names in sorted(differing.items())]


def _list_names(names: list[str], most: int = 6) -> str:
    each = list(dict.fromkeys(names))
    return "; ".join(each[:most]) + (f"; and {len(each) - most} more" if len(each) > most else "")


def describe_counts(digests: dict[str, Any]) -> str:
    """Return the counts of runs, datasets, tables and columns."""
    tables = [table for entries in digests.values() for entry in entries.values() for table in entry["tables"].values()]
    columns = sum(len(table["columns"]) for table in tables)
    runs, datasets = len(digests["runs"]), len(digests["datasets"])
    failed = sum(not entry["tables"] for entries in digests.values() for entry in entries.values())
    return f"{runs} runs and {datasets} datasets ({failed} without a table): {len(tables)} tables, {columns} columns"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    write = commands.add_parser("write", help="make runs and datasets, and write their digests")
    write.add_argument("directory", type=Path, help="where logs, stores and datasets are made; it must not exist")
    write.add_argument("out", type=Path)
    write.add_argument("--logs", type=Path, metavar="DIR", help="take the simulated logs of this earlier directory")
    write.add_argument("--quick", action="store_true", help="three runs, one dataset, no third-party log")
    compare = commands.add_parser("compare", help="print what differs between two files of digests")
    compare.add_argument("first", type=Path)
    compare.add_argument("second", type=Path)
    compare.add_argument("--renamed", action="append", default=[], metavar="OLD=NEW", help="old name and new name")
    compare.add_argument("--ignore", action="append", default=[], metavar="COLUMN", help="a name that is not compared")
    given = parser.parse_args()
    if given.command == "write":
        if given.directory.exists():
            parser.error(f"{given.directory} exists; give a directory that does not")
        print(f"tcpipe of {PROGRAM}", file=sys.stderr)
        out = given.directory.resolve()
        digests = write_digests(out, logs_of=(given.logs or out).resolve(), quick=given.quick)
        given.out.parent.mkdir(parents=True, exist_ok=True)
        given.out.write_text(json.dumps(digests, indent=1, sort_keys=True) + "\n")
        print(describe_counts(digests))
        return
    if wrong := [pair for pair in given.renamed if not re.fullmatch(r"[^=]+=[^=]+", pair)]:
        parser.error(f"--renamed {wrong[0]}: expected OLD=NEW")
    renamed = dict(pair.split("=", 1) for pair in given.renamed)
    first = flatten_digests(given.first, renamed, set(given.ignore))
    second = flatten_digests(given.second, {}, set(given.ignore))
    lines = compare_digests(first, second)
    equal = sum(first[key] == second[key] for key in first.keys() & second.keys())
    print("\n".join([*lines, f"{equal} of {len(first.keys() | second.keys())} values and digests are equal"]))
    sys.exit(1 if lines else 0)


if __name__ == "__main__":
    main()
