"""A run is named by RUN or RUN/RECIPE and a store; what exists as a path is no run, and an error names both possibilities."""

from dataclasses import replace

import pytest
from click.testing import CliRunner
from synthetic_store import add_run, lanes, segments

from tcpipe.cli import cli
from tcpipe.errors import StoreError, UsageError
from tcpipe.pipeline.audit import audit
from tcpipe.pipeline.inspect import inspect
from tcpipe.pipeline.overlay import write_overlay
from tcpipe.pipeline.report import report
from tcpipe.recipe import ReadConfig, Recipe
from tcpipe.store import find_named_run, find_named_runs, is_path, open_store

OTHER = replace(Recipe(), read=ReadConfig(ignore_topics=["/none"]))


@pytest.fixture
def store(tmp_path, monkeypatch):
    """Run a under one recipe, run b under two."""
    monkeypatch.chdir(tmp_path)
    store = open_store("field", create=True)
    for run_id, recipe in (("a", None), ("b", None), ("b", OTHER)):
        add_run(store, run_id, segments(run_id, *lanes(0.0, 0.0, 2.0)), recipe=recipe)
    return store


def test_a_run_is_named_with_or_without_its_recipe(store):
    (a,), (b, other) = find_named_runs("a", "field"), find_named_runs("b", "field")
    assert [run.run_id for run in (a, b, other)] == ["a", "b", "b"]
    assert find_named_run(other.name, "field").recipe_id == other.recipe_id
    with pytest.raises(
        UsageError, match=f"b: was ingested under several recipes; expected one of {b.name}, {other.name}"
    ):
        find_named_run("b", "field")


ASK = {
    "inspect": lambda name, store: inspect(name, recipe=Recipe(), store=store),
    "report": lambda name, store: report(name, store=store),
    "audit": lambda name, store: audit(name, recipe=Recipe(), store=store),
    "overlay": lambda name, store: write_overlay(name, "over.mcap", store=store),
}


@pytest.mark.parametrize("ask", ASK.values(), ids=ASK)
def test_what_is_neither_a_path_nor_a_run_names_both_possibilities(store, ask):
    with pytest.raises(UsageError, match="gone: there is no such file or directory, and no such run in field"):
        ask("gone", "field")
    with pytest.raises(UsageError, match="gone: there is no such file or directory; if it is a run, name its store"):
        ask("gone", "nowhere")


def test_a_run_without_its_tables_is_named(store):
    (run,) = find_named_runs("a", "field")
    run.place.delete(f"blobs/{run.facts.blob}")
    with pytest.raises(StoreError, match="run a: its tables are not in field; ingest its log again"):
        find_named_run("a", "field")


def test_what_exists_is_a_path_and_has_no_store(store, tmp_path):
    (tmp_path / "a").mkdir()
    assert [is_path(name) for name in ("a", "b", "s3://bucket/a", "x" * 300)] == [True, False, True, False]
    found = CliRunner().invoke(cli, ["inspect", "a", "--store", "field"])
    assert "a: is a path, and --store is only for names of runs; remove one of them" in str(found.exception)
    assert "b: from /logs/b.mcap" in CliRunner().invoke(cli, ["inspect", "b", "--store", "field"]).output
    assert "field: 2 runs, maps: none" in CliRunner().invoke(cli, ["inspect"], env={"TCPIPE_STORE": "field"}).output
