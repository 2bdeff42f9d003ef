"""Where the files of a store lie, for tests that damage or count them."""

from pathlib import Path

from tcpipe.formats.stored_runs import StoredRun
from tcpipe.store import Store


def manifest(run: StoredRun) -> Path:
    return Path(run.place.where(run.document))


def table(run: StoredRun, name: str) -> Path:
    """The file of ``segments`` and such."""
    return Path(run.folder.where(f"{name}.parquet"))


def tables(store: Path, name: str = "segments") -> list[Path]:
    """The files of ``segments`` and such of all runs of a store, by run."""
    return [table(run, name) for run in Store(store).runs()]


def map_path(store: Path, name: str) -> Path:
    """The Zarr group of a map."""
    opened = Store(store)
    return Path(opened.place.where(opened.scan().maps[name].zarr))


def checksums(store: Path) -> dict[str, object]:
    """Size and sha256 of each file of the runs of a store, by run."""
    return {run.run_id: {**run.facts.tables, **run.facts.streams} for run in Store(store).runs()}


def only_run(store: Path) -> StoredRun:
    (run,) = Store(store).runs()
    return run


def read_files(directory: Path) -> dict[str, bytes]:
    """The content of every file below a directory, by its path there."""
    files = (path for path in directory.rglob("*") if path.is_file())
    return {path.relative_to(directory).as_posix(): path.read_bytes() for path in files}


def flip(path: Path, place: float = 0.5, *, bit: int = 0) -> None:
    """Change one bit of a file, at a share of its length."""
    data = bytearray(path.read_bytes())
    data[min(int(place * len(data)), len(data) - 1)] ^= 1 << bit
    path.write_bytes(data)
