"""Options that no other test gives to the command, each seen in what the command answers or writes."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
from installed_command import plain_lines, tcpipe
from synthetic_store import add_run, box, lanes, region_file, segments, small_store

from tcpipe.formats.documents import make_key
from tcpipe.formats.recipe_toml import ingest_key
from tcpipe.formats.runs import Output
from tcpipe.recipe import ReadConfig, Recipe
from tcpipe.store import open_store


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A directory with a store of a map and two runs, and a dataset of it."""
    here = tmp_path_factory.mktemp("options")
    small_store(here)
    region_file(here / "region.geojson", box(-18, -18, 6, 18))
    answer("build-dataset", "dataset", "--store", "store", "--split", "region.geojson", cwd=here)
    return here


def answer(*arguments: str | Path, cwd: Path) -> dict:
    done = tcpipe(*arguments, "--json", cwd=cwd)
    assert done.returncode in {0, 3}, done.stderr
    return json.loads(done.stdout)


def test_every_option_of_train_is_in_the_card_of_the_model(place: Path) -> None:
    pytest.importorskip("torch")
    from tcpipe.learning.fitting import FitConfig
    from tcpipe.learning.models import load_model

    options = (
        *(
            "--model",
            "resnet18",
            "--loss",
            "paper_eq4",
            "--label",
            "net",
            "--epochs",
            "1",
            "--patience",
            "2",
        ),
        *("--batch-size", "32", "--learning-rate", "0.001", "--fold", "1", "--width", "16", "--seed", "5"),
        *("--no-mirror", "--no-resume", "--quiet"),
    )
    assert answer("train", "dataset", "model", *options, cwd=place)["status"] == "done"
    wanted = FitConfig(
        loss="paper_eq4", label="net", epochs=1, patience=2, batch_size=32, learning_rate=0.001, fold=1, width=16, seed=5,
        mirror=False,
    )  # fmt: skip
    assert load_model(place / "model").card.training.config == wanted


def test_a_map_a_store_and_a_cell_are_what_planning_takes(place: Path) -> None:
    answer("train", "dataset", "physics", "--model", "physics", cwd=place)
    where = ("--map", "site", "--store", "store")
    costs = ("cost-map", "physics", "costs", *where, "--cell-size", "4", "--origin", "15.4335,47.0701")
    assert answer(*costs, cwd=place)["status"] == "done"
    again = answer("evaluate", "physics", "dataset", "evaluated", "--seed", "3", cwd=place)
    assert again["config"]["seed"] == 3


def test_prune_takes_runs_a_recipe_and_datasets_to_forget(tmp_path: Path) -> None:
    store = open_store(tmp_path / "store", create=True)
    for recipe in (replace(Recipe(), read=ReadConfig(ignore_topics=["/none"])), Recipe()):
        add_run(store, "a", segments("a", *lanes(0.0, -10.0, 10.0)), recipe=recipe)
    add_run(store, "b", segments("b", *lanes(1.0, -10.0, 10.0)))
    (tmp_path / "ruling.toml").touch()
    older = next(run for run in store.runs() if run.facts.ingest_key != ingest_key(Recipe()))
    moved = Output(where=str(tmp_path / "moved"), inputs="0" * 64, runs=(("a", older.recipe_id),))
    store.put(store.scan(), "outputs", make_key(moved.where), moved)
    prune = ("prune", "--store", "store", "--recipe", "ruling.toml")

    def list_removed(*arguments: str) -> list[str]:
        return [each["name"] for each in answer(*prune, *arguments, cwd=tmp_path)["removed"]]

    assert list_removed() == [], "a dataset refers to the run of the older recipe"
    assert "gone" in plain_lines(tcpipe(*prune, "--forget", "gone", cwd=tmp_path), 2, most=1)
    assert list_removed("--forget", "moved", "--dry-run") == [older.name]
    assert list_removed("--forget", "moved") == [older.name]
    assert [name.split("/")[0] for name in list_removed("b")] == ["b"]


def test_robot_recipe_and_age_are_heard(place: Path, tmp_path: Path) -> None:
    (tmp_path / "recipe.toml").write_text('[read]\nignore_topics = ["/none"]\n')
    (tmp_path / "new.mcap").write_bytes(b"still written")
    common = ("--robot", "husky", "--recipe", "recipe.toml")
    inspected = tcpipe("inspect", "new.mcap", *common, cwd=tmp_path)
    assert "new.mcap" in plain_lines(inspected, inspected.returncode, most=1)
    status = ("status", "new.mcap", "--store", place / "store")
    groups = answer(*status, *common, "--min-age", "1h", cwd=tmp_path)["groups"]
    assert [group["state"] for group in groups if group["logs"]] == ["growing"]


def test_the_store_is_named_in_the_same_way_everywhere(place: Path) -> None:
    for command in (("inspect",), ("verify",), ("report", "--no-runs"), ("status",)):
        by_option = tcpipe(*command, "--store", "store", cwd=place)
        by_variable = tcpipe(*command, cwd=place, env={"TCPIPE_STORE": "store"})
        as_before = tcpipe(*command, "store", cwd=place)
        outputs = {done.stdout.replace("no logs", "") for done in (by_option, by_variable, as_before)}
        assert len(outputs) == 1 or command[0] == "report", command
        assert {by_option.returncode, by_variable.returncode, as_before.returncode} == {0}, by_option.stderr
    twice = tcpipe("verify", "store", "--store", "store", cwd=place)
    said = "tcpipe: store: is a path, and --store is only for names of runs; remove one of them\n"
    assert (twice.returncode, twice.stderr) == (2, said)
    nowhere = tcpipe("verify", cwd=place)
    assert (nowhere.returncode, nowhere.stdout) == (2, "")


def test_a_run_is_named_with_its_store(place: Path) -> None:
    for command in ("inspect", "verify", "report"):
        done = tcpipe(command, "north", "--store", "store", cwd=place)
        assert done.returncode == 0, done.stderr
        unknown = tcpipe(command, "nobody", "--store", "store", cwd=place)
        assert "no such run in store" in plain_lines(unknown, 2, most=1)


def test_the_page_of_a_store_sums_over_the_runs_of_the_recipe(place: Path, tmp_path: Path) -> None:
    (tmp_path / "other.toml").write_text('[read]\nignore_topics = ["/none"]\n')
    page = place / "store" / "report.html"
    for recipe, counted in ((place / "none.toml", True), (tmp_path / "other.toml", False)):
        recipe.touch()
        done = tcpipe("report", "store", "--no-runs", "--recipe", recipe, cwd=place)
        assert done.returncode == 0, done.stderr
        assert ("other recipe" not in page.read_text()) is counted
