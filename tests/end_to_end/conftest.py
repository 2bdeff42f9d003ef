"""What tests of commands share: sites that take seconds to simulate, and tracks that take seconds to fuse."""

import hashlib
import json
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pyarrow as pa
import pytest

from tcpipe.formats.json_files import to_plain
from tcpipe.recipe import FuseConfig
from tcpipe.simulation import SimulatedSite, simulate
from tcpipe.simulation.scenarios import RasterSpec
from tcpipe.simulation.site_files import write_rasters
from tcpipe.simulation.world import World
from tcpipe.stages.fuse import fuse_run
from tcpipe.tables.levels import Streams, Track


@pytest.fixture(scope="session")
def tiny_site(tmp_path_factory: pytest.TempPathFactory) -> SimulatedSite:
    """The site of scenario ``tiny``; tests read it only."""
    return simulate(tmp_path_factory.mktemp("tiny") / "site", scenario="tiny", seed=3)


def _digest(table: pa.Table) -> bytes:
    sink, plain = pa.BufferOutputStream(), table.replace_schema_metadata(None).combine_chunks()
    with pa.ipc.new_stream(sink, plain.schema) as stream:
        stream.write_table(plain)
    return hashlib.sha256(sink.getvalue()).digest()


@pytest.fixture(scope="session", autouse=True)
def fused_once() -> Iterator[None]:
    """Fuse the same streams of a run once, however many commands do: a pure function, and most of an ingest."""
    tracks: dict[tuple[object, ...], Track] = {}

    def fuse(streams: Streams, config: FuseConfig, *, run_id: str) -> Track:
        tables = tuple((role, _digest(table)) for role, table in sorted(streams.tables.items()))
        described = json.dumps(to_plain(replace(streams, tables={})), sort_keys=True)
        key = (run_id, repr(config), described, tables)
        if key not in tracks:
            tracks[key] = fuse_run(streams, config, run_id=run_id)
        return tracks[key]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("tcpipe.stages.fuse.fuse_run", fuse)
        yield


@pytest.fixture(scope="session", autouse=True)
def drawn_once(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Draw the rasters of a world once, most of a simulation, however many sites lie in it."""
    drawn: dict[str, Path] = {}

    def write(directory: Path, world: World, spec: RasterSpec) -> None:
        key = repr((world, spec))
        if key not in drawn:
            drawn[key] = tmp_path_factory.mktemp("drawn")
            write_rasters(drawn[key], world, spec)
        shutil.copytree(drawn[key], directory)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("tcpipe.simulation.site_files.write_rasters", write)
        yield
