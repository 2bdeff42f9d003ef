"""Paths of the command line: each has a type that looks at it, and where nothing can begin because of one the exit code is 2."""

import json
from pathlib import Path

import click
import pytest
from click.testing import CliRunner

import tcpipe
from tcpipe.cli import cli
from tcpipe.cli.options import ONE_OF_SEVERAL, PATH_OR_RUN, Place
from tcpipe.errors import UsageError
from tcpipe.formats.atomic import write_atomic_file
from tcpipe.pipeline.export import export
from tcpipe.simulation import simulate
from tcpipe.store import open_store

TEXTS = {
    "name", "robot", "cluster", "map", "tag", "sample_id", "scenario", "names", "topics", "crs",
    "start", "goal", "holdout", "strays", "shard", "min_age", "min_age_s", "forget", "drive",
    "adapt", "budget", "labels", "layers", "predictor", "reason", "run", "runs",
    "split", "time", "train", "unused", "xy",
}  # fmt: skip
"""Parameters of commands that are text and no path."""

PARAMETERS = [(name, each) for name, command in cli.commands.items() for each in command.params]
PLACES = [(name, each) for name, each in PARAMETERS if isinstance(each.type, Place)]


def called(of):
    return f"{of[0]} {of[1].name}" if isinstance(of, tuple) else None


@pytest.mark.parametrize("of", PARAMETERS, ids=called)
def test_a_path_has_a_type_that_looks_at_it(of):
    _, parameter = of
    assert not isinstance(parameter.type, click.Path | click.File), "expected a type of tcpipe.cli.options"
    if isinstance(parameter.type, click.types.StringParamType):
        assert parameter.name in TEXTS, (
            "a text that is no path is listed above; a path has a type of tcpipe.cli.options"
        )


def told(parameter, value):
    with pytest.raises(UsageError) as caught:
        parameter.type.convert(value, parameter, None)
    assert caught.value.exit_code == 2
    (line,) = caught.value.problems
    return line


@pytest.mark.parametrize("of", PLACES, ids=called)
def test_what_is_given_is_looked_at_before_the_command_begins(of, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").touch()
    _, parameter = of
    if parameter.type in (ONE_OF_SEVERAL, PATH_OR_RUN):
        return
    if parameter.type.written:
        urls = ("S3:/bucket/out", "s3://bucket/out", "file:///tmp/out", "gs://bucket")
        for url in urls[: 1 if parameter.type.urls else None]:
            assert "this machine" in told(parameter, url)
    if parameter.type.written:
        assert "is a file, expected a directory" in told(parameter, "file/below")
    else:
        assert told(parameter, "gone").startswith("gone: there is no such ")
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


@pytest.fixture
def here(tmp_path, monkeypatch):
    """A directory with a file that is none of ours, an empty directory, and nothing else."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").write_text("text")
    (tmp_path / "empty").mkdir()
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "thing").touch()
    (tmp_path / "path.geojson").write_text(
        json.dumps({"type": "LineString", "coordinates": [[15.0, 47.0], [15.1, 47.0]]})
    )
    return tmp_path


CALLS = [
    "acknowledge run --store gone",
    "add-map site --height gone.tif",
    "add-map site --height empty",
    "add-map site --height s3://bucket/dem.tif",
    "add-map site --height file --store https://bucket/store",
    "add-map site --height file --layer a=gone.tif",
    "add-map site --height file --layer a=file --categorical a=gone.csv",
    "audit gone",
    "build-dataset out --store gone",
    "build-dataset out --store file",
    "build-dataset out --store empty --split gone.geojson",
    "build-dataset out --store empty --recipe gone.toml",
    "build-dataset other --store empty",
    "build-dataset file --store empty",
    "cost-map gone out --store empty",
    "demo other",
    "diff empty empty",
    "diff empty gone",
    "benchmark other",
    "evaluate other empty",
    "explain id --dataset empty --store empty",
    "explain id --dataset empty --store gone",
    "export gone.mcap out",
    "ingest file --store https://bucket/store",
    "inspect gone",
    "inspect empty",
    "overlay gone out.mcap",
    "overlay empty out.mcap",
    "plan-path gone --from 15,47 --to 15.1,47",
    "plan-path empty --from 15,47 --to 15.1,47 --store gone",
    "plan-path other --from 15,47 --to 15.1,47 --store empty --out other",
    "predict-path empty --path gone.geojson",
    "predict-path empty --path path.geojson --store gone",
    "preflight gone",
    "prune --store gone",
    "report gone",
    "report empty",
    "report file",
    "reproduce other",
    "route-graph gone --store empty --graph gone.geojson",
    "route-graph empty --store empty --graph gone.geojson",
    "simulate other",
    "status --store gone",
    "status --store empty",
    "simulate az://bucket/site",
    "train empty",
    "train gone out",
    "verify empty",
    "verify gone",
    "verify file",
]


@pytest.mark.parametrize("call", CALLS)
def test_a_bad_path_is_exit_code_2(here, call):
    before = sorted(path.name for path in here.rglob("*"))
    found = CliRunner().invoke(cli, call.split())
    assert isinstance(found.exception, UsageError), found.exception
    assert found.exception.exit_code == 2
    assert any(word.rpartition("=")[2] in found.exception.problems[0] for word in call.split()[1:])
    assert sorted(path.name for path in here.rglob("*")) == before


def test_every_command_that_reads_or_writes_a_path_is_tried():
    tried = {call.split()[0] for call in CALLS}
    assert {name for name, _ in PLACES} - tried == {"init"}


FUNCTIONS = {
    "build_dataset": lambda out, _: tcpipe.build_dataset(Path(out)),
    "add_map": lambda out, _: tcpipe.add_map("site", height="file", store=out),
    "open_store": lambda out, _: open_store(out, create=True),
    "simulate": lambda out, _: simulate(out),
    "export": lambda out, log: export(log, Path(out)),
    "atomic_file": lambda out, _: write_atomic_file(out).__enter__(),
}


@pytest.mark.parametrize("name", FUNCTIONS)
def test_functions_refuse_the_same_also_where_a_path_was_made_of_the_url(here, name):
    for out in (Path("s3://bucket/out"), *(["s3://bucket/out"] if name not in ("add_map", "open_store") else [])):
        with pytest.raises(
            UsageError,
            match=r"s3:/+bucket/out: is (a URL; tcpipe writes this on|no URL; expected s3://bucket/name, or a path)",
        ):
            FUNCTIONS[name](out, here / "file")
    assert not (here / "s3:").exists()


@pytest.mark.parametrize(
    "option", ["cost-map m --cell-size nan", "cost-map m --cell-size inf", "train d --learning-rate nan"]
)
def test_no_number_is_nan(here, option):
    (here / "m").mkdir()
    (here / "d").mkdir()
    assert CliRunner().invoke(cli, option.split()).exit_code == 2
