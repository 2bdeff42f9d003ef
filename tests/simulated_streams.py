"""Streams of simulated drives, through a real log: what the pipeline reads."""

from dataclasses import replace
from pathlib import Path

from tcpipe.formats.logs.log_file import open_log
from tcpipe.formats.recipe_toml import load_shipped_profiles
from tcpipe.recipe import ReadConfig
from tcpipe.simulation import simulate
from tcpipe.simulation.scenarios import DriveSpec, RasterSpec, Scenario
from tcpipe.stages.read import read_run
from tcpipe.tables.levels import Streams


def log_of(scenario: Scenario, drive: DriveSpec, out: Path, *, seed: int = 1) -> Path:
    """Write one drive of a scenario; its rasters are coarse."""
    single = replace(scenario, drives=(drive,), rasters=RasterSpec(1.0, 1.0, 1.0))
    return simulate(out, scenario=single, seed=seed).logs[0]


def streams_of(log: Path, config: ReadConfig | None = None) -> Streams:
    with open_log(log) as opened:
        return read_run(opened, config or ReadConfig(), robot=None, known=load_shipped_profiles())
