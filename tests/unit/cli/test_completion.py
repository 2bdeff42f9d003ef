"""What the shell is offered when a name is half typed."""

import pytest
from click.shell_completion import ShellComplete
from synthetic_store import add_run, lanes, segments

from tcpipe.cli import cli
from tcpipe.formats.documents import make_key
from tcpipe.formats.runs import StoredMap
from tcpipe.simulation.scenarios import SCENARIOS
from tcpipe.store import open_store
from tcpipe.tables.levels import DATA_MODEL_VERSION


def offered(*words):
    *before, typed = words
    return [item.value for item in ShellComplete(cli, {}, "tcpipe", "_TCPIPE_COMPLETE").get_completions(before, typed)]


@pytest.fixture
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("TCPIPE_RECIPE", "TCPIPE_STORE"):
        monkeypatch.delenv(name, raising=False)
    store = open_store("field", create=True)
    for run_id in ("run1-0123abcd", "run2-0123abcd", "other-0123abcd"):
        add_run(store, run_id, segments(run_id, *lanes(0.0, 0.0, 2.0)))
    store.put(store.scan(), "maps", make_key("site"), StoredMap("site", DATA_MODEL_VERSION, "0" * 16, {}))
    return tmp_path


def test_runs_and_maps_of_the_store_are_offered(here):
    assert offered("acknowledge", "--store", "field", "run") == ["run1-0123abcd", "run2-0123abcd"]
    assert offered("overlay", "--store", "field", "o") == ["other-0123abcd"]
    assert offered("build-dataset", "--store", "field", "--map", "") == ["site"]
    assert offered("acknowledge", "") == []


def test_robots_and_scenarios_are_offered(here):
    assert "husky" in offered("ingest", "--robot", "hu")
    assert offered("simulate", "--scenario", "") == list(SCENARIOS)


def test_what_is_broken_offers_nothing(here):
    (here / "tcpipe.toml").write_text("[nonsense\n")
    assert offered("ingest", "--robot", "") == []
    assert offered("acknowledge", "--store", "s3://bucket/store", "") == []


def test_paths_are_left_to_the_shell(here):
    items = ShellComplete(cli, {}, "tcpipe", "_TCPIPE_COMPLETE").get_completions(["report"], "fie")
    assert [(item.value, item.type) for item in items] == [("fie", "file")]
