"""Datasets that a call would make of something else now: planned again with the recipe file and options of the last call."""

import pytest
from click.testing import CliRunner
from synthetic_store import small_store
from wheel_drives import ask_status

from tcpipe.cli import cli
from tcpipe.errors import RecipeError, UsageError
from tcpipe.pipeline.calls import BUILD, record_call
from tcpipe.pipeline.dataset.build import build_dataset
from tcpipe.pipeline.problems import acknowledge, find_stale_outputs


@pytest.fixture
def store(tmp_path, monkeypatch):
    """The store of the working directory, which has a recipe."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "tcpipe.toml").write_text("[split]\nseed = 5\n")
    return small_store(tmp_path)


def build(*options):
    return CliRunner().invoke(cli, ["build-dataset", "dataset", "--store", "store", "--quiet", *options])


def list_stale(store):
    """Code and changes of each dataset that is not up to date."""
    found = [problem.finding for problem in find_stale_outputs(store, store.scan())]
    return [(finding.code, finding.names.get("changes")) for finding in found]


def test_a_changed_recipe_file_makes_the_dataset_of_a_command_outdated(store, tmp_path):
    assert build().exit_code == 0
    assert list_stale(store) == []
    (tmp_path / "tcpipe.toml").write_text("[split]\nseed = 6\n")
    assert list_stale(store) == [("output-outdated", "recipe")]
    with record_call(store, BUILD, [str(tmp_path / "dataset")]):
        assert list_stale(store) == [], "it is being built"
    assert build("--force").exit_code == 0
    assert list_stale(store) == []


def test_a_recipe_that_cannot_be_read_is_in_the_record_of_the_call(store, tmp_path):
    (tmp_path / "tcpipe.toml").write_text("[split]\nsed = 5\n")
    with pytest.raises(RecipeError):
        build_dataset("dataset", store=store.root)
    by_function = store.scan().calls[0][1]
    assert isinstance(build().exception, RecipeError)
    by_command = store.scan().calls[0][1]
    assert by_command.begin != by_function.begin
    assert (by_command.exit_code, by_command.message) == (by_function.exit_code, by_function.message)
    assert list_stale(store) == [("output-failed", None)]


def test_a_stale_dataset_is_acknowledged_by_its_path_until_it_is_another_problem(store, tmp_path):
    assert build().exit_code == 0
    (tmp_path / "tcpipe.toml").write_text("[split]\nseed = 6\n")
    assert ask_status("store").exit_code == 3
    (problem,) = acknowledge(["dataset"], store="store").acknowledged
    assert problem.finding.code == "output-outdated"
    assert ask_status("store").exit_code == 0
    assert isinstance(build().exception, UsageError), "it is not replaced without --force"
    assert [finding.code for finding in ask_status("store").problems] == ["output-failed"]
    acknowledge([str(tmp_path / "dataset")], store="store")
    assert isinstance(build().exception, UsageError)
    assert ask_status("store").exit_code == 0, "it is the same failure"
