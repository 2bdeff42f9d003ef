"""What the shell is offered when a name is half typed."""

import pytest
from click.shell_completion import ShellComplete

from tcpipe.cli import cli
from tcpipe.simulation.scenarios import SCENARIOS


def offered(*words):
    *before, typed = words
    return [item.value for item in ShellComplete(cli, {}, "tcpipe", "_TCPIPE_COMPLETE").get_completions(before, typed)]


@pytest.fixture
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("TCPIPE_RECIPE", "TCPIPE_STORE"):
        monkeypatch.delenv(name, raising=False)
    for run in ("run1-0123abcd", "run2-0123abcd", "other-0123abcd"):
        (tmp_path / "field/runs" / run).mkdir(parents=True)
        (tmp_path / "field/runs" / run / "run-1.json").touch()
    (tmp_path / "field/maps").mkdir()
    (tmp_path / "field/maps/site-1.json").touch()
    return tmp_path


def test_runs_and_maps_of_the_store_are_offered(here):
    assert offered("acknowledge", "--store", "field", "run") == ["run1-0123abcd", "run2-0123abcd"]
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
