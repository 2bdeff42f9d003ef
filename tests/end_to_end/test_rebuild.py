"""`tcpipe rebuild`: a dataset is made again from what it records, from files that are found by their content."""

import json
import os
import re
import shutil
import signal
import subprocess
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
import rasterio
from installed_command import COMMAND, plain_lines, tcpipe
from made_tracks import with_columns
from mcap.reader import make_reader
from mcap.writer import Writer
from stored_files import flip, read_files

from tcpipe.errors import DatasetError, UsageError
from tcpipe.formats.dataset_card import RunInputs
from tcpipe.formats.dataset_files import read_card
from tcpipe.formats.integrity import compute_checksum, write_sealed
from tcpipe.formats.logs.log_joining import open_logs
from tcpipe.pipeline.dataset.build import build_dataset
from tcpipe.pipeline.ingest import ingest
from tcpipe.pipeline.log_sources import find_sources
from tcpipe.pipeline.maps import add_map
from tcpipe.pipeline.rebuild import _name_log, rebuild
from tcpipe.recipe import CovariateConfig, FuseConfig, Recipe, TableMapping
from tcpipe.simulation import make_tiny, simulate
from tcpipe.store import open_store


def split_log(log, directory):
    """Write the power of a log to one file, and all other topics to another; return both."""
    paths = directory / "drive.mcap", directory / "power.mcap"
    with log.open("rb") as source, paths[0].open("wb") as rest, paths[1].open("wb") as power:
        writers, channels = [Writer(rest), Writer(power)], {}
        for writer in writers:
            writer.start(profile="ros2")
        for schema, channel, message in make_reader(source).iter_messages():
            writer = writers["power" in channel.topic]
            if channel.id not in channels:
                number = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.id] = writer.register_channel(channel.topic, channel.message_encoding, number)
            writer.add_message(channels[channel.id], message.log_time, message.data, message.publish_time)
        for writer in writers:
            writer.finish()
    return paths


def make_tiles(height, directory):
    """Copy a raster as two tiles, of which the second by name has other heights at its start and statistics beside it."""
    paths = directory / "a.tif", directory / "z.tif"
    for path in paths:
        shutil.copy(height, path)
    with rasterio.open(paths[1], "r+") as raster:
        values = raster.read(1)
        values[:40, :40] += 1.0
        raster.write(values, 1)
    (directory / "z.tif.aux.xml").write_text("<PAMDataset><Metadata><MDI key='made'>here</MDI></Metadata></PAMDataset>")
    return paths


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A dataset of a bag folder and of a drive in two files; ``raw`` has everything that it was made from."""
    here = tmp_path_factory.mktemp("rebuild")
    raw, site = here / "raw", simulate(here / "one", scenario="tiny", seed=3)
    bag = simulate(here / "two", scenario=make_tiny(container="rosbag2"), seed=4).logs[0]
    raw.mkdir()
    shutil.copytree(bag, raw / "bag")
    parts, tiles = split_log(site.logs[0], raw), make_tiles(site.rasters["height"], raw)
    rasters = {role: shutil.copy(path, raw) for role, path in site.rasters.items() if role != "height"}
    how = {"store": here / "store", "recipe": Recipe()}
    assert ingest([raw / "bag"], tags={"weather": "wet"}, **how).exit_code == 0
    assert ingest(parts, as_one=True, robot="husky", tags={"weather": "dry"}, **how).exit_code == 0
    add_map("site", height=[tiles[1], tiles[0]], layers={"bare": tiles[0]}, store=here / "store", **rasters)
    (raw / "soil.csv").write_text("time,moisture\n2023-11-01T00:00:00,0.3\n")
    build = {**how, "split": site.region, "holdout": "sample", "file_format": "parquet"}
    build |= {"covariates": raw / "soil.csv", "recipe": Recipe(covariates=CovariateConfig(max_age_s=1e8))}
    ids = open_store(here / "store").runs()[0].segments()["segment_id"].to_pylist()
    (raw / "bad.txt").write_text(f"{ids[0]}\n{ids[5]}\n")
    build_dataset(here / "dataset", exclude=raw / "bad.txt", reason="a person on the path", **build)
    return here


@pytest.fixture
def temporary(tmp_path, monkeypatch):
    """The system's temporary folder of a test."""
    folder = tmp_path / "temporary"
    folder.mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(folder))
    return folder


def change_card(made, to, **values):
    """Copy the dataset with other values in its card."""
    shutil.copytree(made / "dataset", to)
    card = replace(read_card(to), **values)
    write_sealed(to / "dataset.json", replace(card, inputs=card.made_from.digest))
    return to


def test_the_same_dataset_is_rebuilt_from_files_of_other_names(made, tmp_path, temporary):
    shuffled = tmp_path / "archive"
    for number, (name, content) in enumerate(sorted(read_files(made / "raw").items())):
        kept = name if name.startswith("bag/") else f"{number % 3}/renamed_{9 - number}{Path(name).suffix}"
        (shuffled / kept).parent.mkdir(parents=True, exist_ok=True)
        (shuffled / kept).write_bytes(content)
    (shuffled / "bag").rename(shuffled / "moved")
    done = tcpipe("rebuild", made / "dataset", "--logs", shuffled, "--to", "new", "--quiet", cwd=tmp_path)
    assert (done.returncode, done.stdout) == (0, "identical: 18 samples\n"), done.stderr
    before, now = read_files(made / "dataset"), read_files(tmp_path / "new")
    assert {name for name in before if before[name] != now[name]} == set()
    assert before.keys() == now.keys()
    assert list(temporary.iterdir()) == []


def test_a_changed_dataset_is_named_with_its_cause(made, tmp_path, temporary):
    made_from = read_card(made / "dataset").made_from
    versions = {**made_from.versions, "results": "0"}
    changed = change_card(made, tmp_path / "old", made_from=replace(made_from, versions=versions))
    table = pq.read_table(changed / "samples.parquet")
    energy = table["energy_joule"].to_numpy() + 0.5 * table["energy_std_joule"].to_numpy() * (np.arange(len(table)) < 3)
    pq.write_table(with_columns(table, energy_joule=energy), changed / "samples.parquet")
    card = read_card(changed)
    sums = {**card.checksums, "samples.parquet": compute_checksum(changed / "samples.parquet")}
    write_sealed(changed / "dataset.json", replace(card, checksums=sums))
    done = tcpipe("rebuild", changed, "--logs", made / "raw", "--json", "--quiet", cwd=tmp_path)
    found = json.loads(done.stdout)
    assert (done.returncode, found["is_identical"], found["samples"], found["differing"]) == (3, False, 18, 3)
    assert found["largest_in_std"] == pytest.approx(0.5)
    (cause,) = found["causes"]
    assert re.fullmatch(r"version: results 0 → \d+", cause)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["old", "temporary"]
    assert list(temporary.iterdir()) == []


def test_every_missing_and_altered_file_and_another_recipe_are_named_at_once(made, tmp_path, temporary):
    raw = shutil.copytree(made / "raw", tmp_path / "raw")
    (raw / "power.mcap").unlink()
    (raw / "soil.csv").unlink()
    for path in (*(raw / "bag").glob("*.db3"), raw / "a.tif"):
        flip(path)
    recipe = replace(read_card(made / "dataset").recipe, fuse=FuseConfig(gate_probability=0.9))
    made_from = replace(read_card(made / "dataset").made_from, recipe=recipe)
    dataset = change_card(made, tmp_path / "dataset", made_from=made_from)
    flip(dataset / "samples.parquet")
    done = tcpipe("rebuild", dataset, "--logs", raw, "--to", "new", "--quiet", cwd=tmp_path)
    said = plain_lines(done, 1, most=20)
    for words in (
        f"{dataset / 'samples.parquet'}: its sha256 is",
        f"{dataset / 'dataset.json'}: run bag-",
        "ingested with recipe",
        f"{raw}: power.mcap is missing: expected the log of run drive-",
        f"{raw}: {raw / 'bag'} was altered: expected the log of run bag-",
        f"{raw}: {raw / 'a.tif'} was altered: expected the height of map site with sha256 ",
        f"{raw}: soil.csv is missing: expected the table of covariates with sha256 ",
    ):
        assert words in said
    assert not (tmp_path / "new").exists()
    assert list(temporary.iterdir()) == []


def test_an_interrupted_rebuild_leaves_nothing(made, tmp_path):
    command = [COMMAND, "rebuild", made / "dataset", "--logs", made / "raw", "--to", tmp_path / "new", "--jobs", "2"]
    temporary = tmp_path / "temporary"
    temporary.mkdir()
    with subprocess.Popen(
        command, env={**os.environ, "TMPDIR": str(temporary)}, stdout=subprocess.PIPE, stderr=subprocess.PIPE
    ) as running:
        while running.poll() is None and not any(temporary.glob("*/*/store/calls")):
            time.sleep(0.01)
        running.send_signal(signal.SIGTERM)
        running.communicate()
    assert running.returncode == 128 + signal.SIGTERM
    assert [path.name for path in tmp_path.iterdir()] == ["temporary"]
    assert list(temporary.iterdir()) == []


def test_what_cannot_be_rebuilt_is_refused(made, tmp_path):
    build_dataset(tmp_path / "public", store=made / "store", recipe=Recipe(), without_coordinates=True)
    with pytest.raises(DatasetError, match=r"is without coordinates: .* rebuild the dataset with coordinates"):
        rebuild(tmp_path / "public", logs=made / "raw")
    with pytest.raises(UsageError, match=r"contains files; give a new folder \(--to\)"):
        rebuild(made / "dataset", logs=made / "raw", to=made / "dataset")


def wheels(name):
    return {"wheel_odometry": TableMapping(name, stamp="t", stamp_unit="s", columns={"linear_x": "v"})}


@pytest.mark.parametrize(
    ("tables", "before", "after"),
    [
        (wheels("wheels.csv"), ("day/wheels.csv", "day/notes.csv"), ("moved/wheels.csv", "moved/notes.csv")),
        (
            wheels("wheels_*.csv") | {"power": TableMapping("bus_*.csv", stamp="t", columns={"voltage": "v"})},
            ("day/bus_1.csv", "day/wheels_1.csv"),
            ("moved/bus_7.csv", "moved/wheels_7.csv"),
        ),
    ],
)
def test_a_log_of_tables_is_found_and_gets_its_name_back(tmp_path, tables, before, after):
    for folder, names in (("old", before), ("new", after)):
        for speed, name in enumerate(names):
            (tmp_path / folder / name).parent.mkdir(parents=True, exist_ok=True)
            lines = "".join(f"{1.7e9 + 0.1 * row:.1f},{speed}\n" for row in range(50))
            (tmp_path / folder / name).write_text(f"t,v\n{lines}")

    def find(*paths):
        (source,) = find_sources(paths, as_one=False, staging=tmp_path / "staging", tables=tables).sources
        with open_logs(source.paths, tables=tables) as log:
            return source, log.sha256()

    source, sha256 = find(tmp_path / "old")
    names = tuple(path.name for path in source.paths)
    run = RunInputs("recipe", "husky", names, sha256, segments_sha256=None, tags={})
    moved, same = find(tmp_path / "new")
    assert same == sha256
    paths = _name_log(f"{source.stem}-{sha256[:8]}", run, {sha256: moved.paths}, tmp_path / "links")
    again, same = find(*paths)
    assert (again.stem, tuple(path.name for path in again.paths), same) == (source.stem, names, sha256)
