"""A dataset is replaced unasked only by one of the same options: everything else that differs is named, and nothing is written."""

import json
import shutil
from pathlib import Path

import pytest
from stored_files import read_files as tree
from synthetic_store import add_run, add_world, box, lanes, region_file, segments

from tcpipe.errors import DatasetError, StoreError, UsageError
from tcpipe.formats.dataset_files import read_card
from tcpipe.pipeline.dataset import writing
from tcpipe.pipeline.dataset.build import build_dataset
from tcpipe.pipeline.diff import diff
from tcpipe.pipeline.report import report
from tcpipe.pipeline.verify import verify
from tcpipe.recipe import DatasetConfig, Recipe, SampleConfig
from tcpipe.store import open_store


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Two maps, a run of each weather, and the dataset of the dry one."""
    here = tmp_path_factory.mktemp("replacing")
    store = open_store(here / "store", create=True)
    for name in ("site", "yard"):
        add_world(store, name=name)
    for number, weather in enumerate(("dry", "wet")):
        add_run(store, weather, segments(weather, *lanes(3.0 * number, -10.0, 10.0)), tags={"weather": weather})
    region_file(here / "region.geojson", box(-20, -20, 2, 20))
    region_file(here / "other.geojson", box(-20, -20, 3, 20))
    (here / "soil.csv").write_text("time,moisture\n1970-01-01T00:00:00Z,0.2\n1970-01-01T00:01:00Z,0.3\n")
    build_dataset(here / "dataset", **usual(here))
    return here


def usual(here: Path, **how: object) -> dict[str, object]:
    first = {"store": here / "store", "map": "site", "split": here / "region.geojson", "tag": {"weather": "dry"}}
    return first | {"recipe": Recipe()} | how


@pytest.fixture
def here(made, tmp_path):
    shutil.copytree(made, tmp_path / "here", copy_function=shutil.copy2)
    return tmp_path / "here"


def refused(here: Path, **how: object) -> tuple[str, ...]:
    """Return the differences that a build and a dry run name; both leave the dataset unchanged."""
    before, problems = tree(here / "dataset"), []
    for dry_run in (False, True):
        with pytest.raises(UsageError) as caught:
            build_dataset(here / "dataset", **usual(here, dry_run=dry_run, **how))
        problems.append(caught.value.problems)
    assert problems[0] == problems[1]
    assert "made with other options and is not changed; give another OUT, or replace it with --force" in problems[0][0]
    assert tree(here / "dataset") == before
    return tuple(line.partition("dataset: ")[2] for line in problems[0][1:])


OTHER = {
    "map": ("yard", "--map: site in the dataset, yard now"),
    "tag": ({}, "--tag: weather=dry in the dataset, none now"),
    "format": ("parquet", "--format: zarr in the dataset, parquet now"),
    "without_coordinates": (True, "--without-coordinates: no in the dataset, yes now"),
    "recipe": (
        Recipe(sample=SampleConfig(patch_px=20), dataset=DatasetConfig(licence="CC0-1.0")),
        "recipe dataset.licence: none in the dataset, CC0-1.0 now",
    ),
}


@pytest.mark.parametrize("option", OTHER)
def test_another_option_is_refused_with_both_values_and_taken_with_force(made, here, option):
    value, line = OTHER[option]
    lines = refused(here, **{option: value})
    assert line in lines
    assert len(lines) == (2 if option == "recipe" else 1)
    assert build_dataset(here / "dataset", **usual(here, force=True, **{option: value})).status == "done"
    again = build_dataset(here / "dataset", **usual(here, **{option: value}))
    assert again.status == "unchanged", "what differs is what is there now"


def test_regions_and_tables_differ_by_what_they_are(here):
    for region, now in ((None, "none now"), (here / "other.geojson", "train_test (")):
        (line,) = refused(here, split=region)
        assert line.startswith("--split: train_test (")
        assert now in line
    assert refused(here, covariates=here / "soil.csv") == ("--covariates: none in the dataset, soil.csv now",)
    assert len(refused(here, split=None, seed=3, map=["site", "yard"])) == 3


DESKTOP_FILES = (".directory", ".DS_Store", "overview.png.aux.xml", "patches.zarr/Thumbs.db")
OWN_FILES = ("notes.txt", "figures/a.svg")


def test_files_of_others_are_named_and_kept(here):
    """A file manager or a GIS leaves files in any folder that somebody looks at."""
    out = here / "dataset"
    report(out)
    (out / "figures").mkdir()
    names = sorted((*DESKTOP_FILES, *OWN_FILES))
    for name in names:
        (out / name).write_text(name)
    (out / "link").symlink_to("nowhere")
    for status, options in (("unchanged", {}), ("done", {"seed": 5, "force": True}), ("unchanged", {"seed": 5})):
        found = build_dataset(out, **usual(here, **options))
        assert (found.status, found.exit_code) == (status, 0)
        assert found.foreign_files == tuple(sorted((*names, "link")))
        assert f"{out}: contains .DS_Store, .directory, figures/a.svg and 4 more, not of the dataset; kept" in str(
            found
        )
        assert all((out / name).read_text() == name for name in names)
        assert (out / "link").is_symlink()
    (out / "link").unlink()
    found = verify(out)
    assert found.problems == tuple(f"{out / name}: is no file of this dataset" for name in sorted(OWN_FILES))
    assert [any(name in note for note in found.notes) for name in DESKTOP_FILES] == [True] * len(DESKTOP_FILES)


def test_a_file_of_others_that_the_new_dataset_would_replace_is_kept(here):
    path = here / "dataset" / "data" / "train-00000-of-00001.parquet"
    path.parent.mkdir()
    path.write_text("mine")
    with pytest.raises(DatasetError, match="has the name of a file of the new dataset; rename it"):
        build_dataset(here / "dataset", **usual(here, format="parquet", force=True))
    assert path.read_text() == "mine"


@pytest.fixture(scope="module")
def variants(made, tmp_path_factory):
    """The dataset of the dry run, and such of other inputs."""
    here = shutil.copytree(made, tmp_path_factory.mktemp("variants") / "here")
    (here / "wet").mkdir()
    (here / "wet" / "soil.csv").write_text((here / "soil.csv").read_text().replace("0.2", "0.4"))
    options = {
        "soil": {"covariates": here / "soil.csv"},
        "wet soil": {"covariates": here / "wet" / "soil.csv"},
        "all": {"tag": {}},
        "both": {"map": ["site", "yard"]},
        "turned": {"map": ["yard", "site"]},
        "yard": {"map": "yard"},
    }
    for name, how in options.items():
        build_dataset(here / name, **usual(here, **how))
    return here


@pytest.mark.parametrize(
    ("one", "other", "causes"),
    [
        ("soil", "dataset", {"covariates: removed soil.csv"}),
        ("soil", "wet soil", {"covariates: soil.csv is another one"}),
        ("dataset", "all", {"run: added wet", "chosen tags: weather dry → none"}),
        ("both", "turned", {"order of maps: site, yard → yard, site"}),
        ("dataset", "yard", {"map: added yard", "map: removed site", "order of maps: site → yard"}),
    ],
)
def test_diff_names_every_input_that_differs(variants, one, other, causes):
    """Each entry of the record of inputs, not a list of some of them."""
    found = diff(variants / one, variants / other)
    assert set(found.causes) == causes
    assert not found.same


def test_the_record_of_inputs_is_read_as_it_was_written(here):
    """Its digest decides whether a dataset is built again."""
    build_dataset(here / "b", **usual(here, covariates=here / "soil.csv", map=["yard", "site"]))
    for name in ("b", "dataset"):
        card = read_card(here / name)
        assert card.made_from.digest == card.inputs
    assert read_card(here / "b").made_from.map_names == ("yard", "site")


def test_other_runs_and_another_map_of_the_name_are_built_in_unasked(here):
    assert build_dataset(here / "dataset", **usual(here)).status == "unchanged"
    store = open_store(here / "store")
    add_run(store, "new", segments("new", *lanes(6.0, -10.0, 10.0)), tags={"weather": "dry"})
    assert build_dataset(here / "dataset", **usual(here)).status == "done"
    assert {run.run_id for run in read_card(here / "dataset").runs} == {"dry", "new"}


def test_another_robot_is_refused(here):
    store = open_store(here / "store")
    add_run(store, "big", segments("big", *lanes(6.0, -10.0, 10.0), robot="warthog"), tags={"weather": "dry"})
    assert refused(here, robot="warthog") == ("--robot: husky in the dataset, warthog now",)
    assert build_dataset(here / "dataset", **usual(here, robot="husky")).status == "unchanged"


def reseal(directory: Path, **values: object) -> None:
    """Write a card as an earlier version might have; ``None`` takes a key away."""
    card = json.loads((directory / "dataset.json").read_text()) | values
    (directory / "dataset.json").write_text(json.dumps({key: of for key, of in card.items() if of is not None}))


def test_a_dataset_of_another_data_model_is_left_alone(here):
    reseal(here / "dataset", data_model_version="3.0")
    with pytest.raises(DatasetError, match="is not changed, because its inputs are unknown") as caught:
        build_dataset(here / "dataset", **usual(here, force=True))
    assert "made by tcpipe 1.x (data model 3.0), expected 4.0: ingest the logs again" in caught.value.problems[0]


def test_a_dataset_without_coordinates_does_not_store_its_options(here):
    out = here / "dataset"
    build_dataset(out, **usual(here, without_coordinates=True, force=True))
    assert read_card(out).made_from.tags == {}
    assert build_dataset(out, **usual(here, without_coordinates=True)).status == "unchanged"
    (line,) = refused(here, without_coordinates=True, map="yard")
    assert line == "--without-coordinates: maps, region, tags and recipe are not stored and cannot be compared"
    assert refused(here) == ("--without-coordinates: yes in the dataset, no now",)


@pytest.mark.parametrize("force", [False, True])
def test_what_is_no_dataset_is_left_alone_with_force_too(here, force):
    for name, error, text in (
        ("notes.txt", UsageError, "exists and is not a dataset"),
        ("dataset.json", DatasetError, "is not changed, because its inputs are unknown; move it"),
    ):
        (here / "folder").mkdir(exist_ok=True)
        (here / "folder" / name).write_text("{}")
        before = tree(here / "folder")
        with pytest.raises(error, match=text):
            build_dataset(here / "folder", **usual(here, force=force))
        assert tree(here / "folder") == before


def test_what_another_call_builds_there_meanwhile_stays(here, monkeypatch):
    out, draw = here / "dataset", writing.write_patches

    def while_the_first_draws(*how, **more):
        monkeypatch.setattr(writing, "write_patches", draw)
        build_dataset(out, **usual(here, map="yard", force=True))
        return draw(*how, **more)

    add_run(open_store(here / "store"), "dry", segments("dry", *lanes(1.0, -10.0, 10.0)))
    monkeypatch.setattr(writing, "write_patches", while_the_first_draws)
    with pytest.raises(StoreError, match="another call has built a dataset here meanwhile and it is kept"):
        build_dataset(out, **usual(here))
    assert [entry.name for entry in read_card(out).maps] == ["yard"]
