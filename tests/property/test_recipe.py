"""The recipe as a whole: what is the same by name is the same by bytes, and no valid value breaks a stage or lasts."""

from dataclasses import fields, replace

import pytest
from recipe_values import keys, other_values, with_value
from simulated_streams import log_of, streams_of
from stored_files import only_run

from tcpipe.formats.recipe_toml import (
    ingest_key,
    load_recipe,
    make_recipe_id,
    parse_recipe,
    read_key,
)
from tcpipe.pipeline.ingest import ingest
from tcpipe.recipe import IngestSections, Recipe
from tcpipe.recipe.checking import as_toml
from tcpipe.robots import Robot
from tcpipe.simulation.scenarios import make_tiny
from tcpipe.stages.fuse import fuse_run
from tcpipe.stages.label import label_segments
from tcpipe.stages.mask import mask_track
from tcpipe.stages.segment import segment_track

INGEST = {section.name for section in fields(IngestSections)}


def section(key):
    return key.partition(".")[0]


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    scenario = make_tiny(seconds=5.0)
    return log_of(scenario, scenario.drives[0], tmp_path_factory.mktemp("site"))


@pytest.fixture(scope="module")
def streams(log):
    return streams_of(log)


@pytest.fixture(scope="module")
def track(streams):
    return fuse_run(streams, Recipe().fuse, run_id="run")


def after_fusion(track, streams, recipe):
    masked = mask_track(track, recipe.mask, max_velocity_mps=1.0, chord_m=recipe.segment.chord_m)
    segments = segment_track(masked, recipe.segment)
    return label_segments(segments, masked, streams, recipe.label, robot=Robot())


@pytest.mark.parametrize("key", keys())
def test_a_key_changes_the_name_of_a_run_if_and_only_if_its_section_reaches_a_stage_of_it(key):
    default = Recipe()
    values = other_values(key)
    assert values
    for value in values:
        other = with_value(default, key, value)
        assert (make_recipe_id(other, "husky") != make_recipe_id(default, "husky")) == (section(key) in INGEST)
        assert (ingest_key(other) != ingest_key(default)) == (section(key) in INGEST)
        streams_differ = read_key(other, None, definitions="") != read_key(default, None, definitions="")
        assert streams_differ == (section(key) in {"read", "robots", "power_sources", "tables"})


def test_one_name_is_one_set_of_bytes_whatever_the_other_sections_say(log, tmp_path):
    other = Recipe()
    for key in keys():
        if section(key) not in {*INGEST, "robot"}:
            other = with_value(other, key, other_values(key)[0])
    assert other != Recipe()
    found = []
    for recipe in (Recipe(), other):
        store = tmp_path / recipe.dataset.name
        (result,) = ingest([log], store=store, recipe=recipe).results
        assert result.status in {"done", "empty"}
        assert only_run(store).run_id == result.run.run_id
        found.append(replace(only_run(store).manifest, blob="", streams_blob=""))
    assert len(found[0].tables | found[0].streams) > 5
    assert found[0] == found[1]


NUMBERS = [
    (key, value)
    for key in keys()
    for value in other_values(key)
    if section(key) in INGEST - {"read"} and isinstance(value, float)
]


@pytest.mark.parametrize(("key", "value"), NUMBERS, ids=lambda of: f"{of}")
def test_no_stage_breaks_at_the_ends_of_a_key(track, streams, key, value):
    recipe = with_value(Recipe(), key, value)
    fused = fuse_run(streams, recipe.fuse, run_id="run") if section(key) == "fuse" else track
    labelled = after_fusion(fused, streams, recipe)
    assert sum(labelled.distance_by_reason_m.values()) > 1.0


@pytest.mark.parametrize("key", keys())
def test_toml_and_python_make_the_same_recipe(tmp_path, key):
    for value in other_values(key):
        (tmp_path / "r.toml").write_text(f"{key} = {as_toml(value)}\n", encoding="utf-8")
        assert load_recipe(tmp_path / "r.toml") == with_value(Recipe(), key, value)
    assert parse_recipe({}, where="r") == Recipe()
