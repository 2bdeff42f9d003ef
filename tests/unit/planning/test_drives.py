"""Whole drives against a model: what they took by hand, what cannot be compared, and what was trained on."""

import json
from types import SimpleNamespace

import pytest
from physics_model import PhysicsModel
from synthetic_store import box, region_file, small_store

from tcpipe.dataset import open_dataset
from tcpipe.errors import ModelError, UsageError
from tcpipe.learning.training import compute_dataset_checksum
from tcpipe.pipeline.dataset.build import build_dataset
from tcpipe.planning.drives import compute_drive_cost, evaluate_drives, find_drive
from tcpipe.planning.path_files import choose_map
from tcpipe.recipe import Recipe


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A store of two drives; the dataset's region holds the northern one alone."""
    here = tmp_path_factory.mktemp("drives")
    store = small_store(here)
    region = region_file(here / "region.geojson", box(-18, 0, 18, 18))
    build_dataset(here / "dataset", store=store.root, split=region, recipe=Recipe())
    return store, open_dataset(here / "dataset"), choose_map(store.root, None)


def test_a_drive_that_was_held_back_is_summed_where_the_model_knows_the_ground(made):
    store, data, source = made
    run = find_drive(store, "/logs/south.mcap")
    found = compute_drive_cost(PhysicsModel(), source, run, data, log="south.mcap")
    assert found.held_back
    assert found.samples_in_training == 0
    segments = run.segments()
    assert found.segments_m == pytest.approx(segments.num_rows)
    assert found.driven_m == pytest.approx(segments.num_rows + 2.5)
    assert found.compared_m <= found.segments_m <= found.compared_m + sum(found.rest_m.values()) + 1e-6
    count = round(found.compared_m)
    assert found.duration_s.measured == pytest.approx(1.2 * count)
    assert 0.0 < found.energy_joule.measured < segments.column("energy_joule").to_numpy().sum() + 1e-6
    for of in (found.duration_s, found.energy_joule):
        assert of.low <= of.predicted <= of.high  # its held-out velocities are exact
    assert found.energy_joule.low < found.energy_joule.high


def test_a_drive_that_was_trained_on_is_marked(made, tmp_path):
    store, data, source = made
    model = PhysicsModel(dataset=SimpleNamespace(name="own", sha256=compute_dataset_checksum(data.card)))
    said = evaluate_drives(model, data, source, ["north", "south"], store=store.root, out=tmp_path / "out")
    north, south = said.values.drives
    assert not north.held_back
    assert north.near_training_percent > 60.0
    assert south.near_training_percent < 20.0
    assert "of its samples trained the model" in str(said)
    assert south.energy_joule.measured > 0.0
    findings = {of.code: of for of in said.values.findings}
    assert findings["drive-in-training"].subject.name == north.run_id
    assert findings["few-drives"].numbers == {"drive_count": 1.0}
    assert "energy-overconfident" not in findings  # one drive decides nothing
    assert "[drive-in-training]" in str(said)
    assert "J measured" in str(said)
    assert json.loads((tmp_path / "out" / "drives.json").read_text())["drives"][1]["run_id"] == "south"


def test_what_cannot_be_compared_is_told(made):
    store, data, source = made
    with pytest.raises(ModelError, match=r"physics: was trained on another dataset \(another, 000000000000\)"):
        evaluate_drives(PhysicsModel(), data, source, ["south"], store=store.root, out="out")
    with pytest.raises(UsageError, match=r"elsewhere.mcap: .* has no run of this log or name; expected the path"):
        find_drive(store, "elsewhere.mcap")
    assert find_drive(store, find_drive(store, "south").name).run_id == "south"  # RUN/RECIPE
    with pytest.raises(ModelError, match="is of robot husky, model physics of jackal"):
        compute_drive_cost(PhysicsModel(robot="jackal"), source, find_drive(store, "south"), data, log="south")
