"""Evaluation: its figures against the arrays themselves, its files, and models that do not fit."""

import json
import re
from dataclasses import replace

import numpy as np
import pyarrow.compute as pc
import pyproj
import pytest
from made_models import CARD, made_model
from synthetic_store import STANDING_WATT, small_store

from tcpipe.cost.prediction_errors import fit_bias_correction
from tcpipe.dataset import Split, open_dataset
from tcpipe.errors import ModelError, UsageError
from tcpipe.formats.json_files import to_plain
from tcpipe.formats.parquet import read_table
from tcpipe.learning.evaluation import EvaluateConfig
from tcpipe.learning.evaluation_files import run_evaluation
from tcpipe.learning.fitting import FitConfig
from tcpipe.learning.models import load_model
from tcpipe.learning.predictions import predict_costs
from tcpipe.pipeline.dataset.build import build_dataset
from tcpipe.recipe import Recipe
from tcpipe.tables.findings import select_findings
from tcpipe.terrain.layers import PAPER_CLASSES

pytest.importorskip("torch")

CONFIG, ONE_DRAW = (EvaluateConfig(noise_draws=draws) for draws in (2, 1))


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    config = FitConfig(epochs=1, width=16)
    training = replace(CARD.training, config=config, samples={"fitted": 100, "held out": 20})
    return made_model(tmp_path_factory.mktemp("made") / "model", training=training)


@pytest.fixture(scope="module")
def evaluated(model, dataset, tmp_path_factory):
    place = tmp_path_factory.mktemp("evaluated") / "evaluation"
    return place, run_evaluation(model, dataset, place, config=CONFIG).values


def _centred(model, split):
    """What a model says, shape (N, 2), by its bias on held-out samples corrected."""
    said = load_model(model).predict(split.patches).mean.astype(float)
    return np.stack(
        fit_bias_correction(load_model(model).residuals).apply(*said.T, split.column("terrain_class")), axis=1
    )


def test_the_figures_are_the_arrays_own(evaluated, model, dataset):
    _, values = evaluated
    unseen = open_dataset(dataset)["unseen"]
    said, labels = _centred(model, unseen), unseen.labels.astype(float)
    found = values.splits["unseen"].errors
    assert found["w"]["all"].rmse == pytest.approx(np.sqrt(np.mean((said[:, 0] - labels[:, 0]) ** 2)), rel=1e-4)
    energy, told = unseen.column("energy_joule"), said[:, 0] / said[:, 1]
    assert found["E"]["all"].mape_percent == pytest.approx(100 * np.mean(np.abs(told - energy) / energy), rel=1e-4)
    mud = unseen.column("terrain_class") == 5
    times, told = unseen.column("duration_s")[mud], 1.0 / said[mud, 1]
    assert found["T"]["mud"].rmse == pytest.approx(np.sqrt(np.mean((told - times) ** 2)), rel=1e-4)
    expected = values.time["expected time"]["unseen"]
    assert expected.mape_percent == pytest.approx(
        100 * np.mean(np.abs(1.0 - unseen.column("duration_s")) / unseen.column("duration_s"))
    )


def test_a_model_of_net_energy_is_compared_with_net_energy(model, dataset, tmp_path):
    training = load_model(model).card.training
    names = ("net_power_watt", "velocity_mps")
    made = made_model(tmp_path / "above", training=training, outputs=names, label_energy="net")
    values = run_evaluation(made, dataset, tmp_path / "evaluation", config=ONE_DRAW).values
    assert values.model.label_energy == "net"
    unseen = open_dataset(dataset)["unseen"]
    said = _centred(made, unseen)
    energy, told = unseen.column("energy_joule") - 1.2 * STANDING_WATT, said[:, 0] / said[:, 1]
    found = values.splits["unseen"]
    assert found.errors["E"]["all"].rmse == pytest.approx(np.sqrt(np.mean((told - energy) ** 2)), rel=1e-4)
    assert found.label_floor["E"]["all"].rmse == pytest.approx(1.2)
    assert "net of idle power" in (tmp_path / "evaluation" / "evaluation.html").read_text()


def test_the_distance_to_training_is_printed(evaluated, dataset):
    place, values = evaluated
    data = open_dataset(dataset)
    middles = [
        np.mean([[split.column(f"{end}_{axis}_deg") for axis in ("lon", "lat")] for end in ("start", "end")], axis=0).T
        for split in (data["test"], data["train"])
    ]
    metres = [pyproj.Transformer.from_crs(4326, 32633, always_xy=True).transform(*some.T) for some in middles]
    apart = np.hypot(*(a[:, None] - b[None, :] for a, b in zip(*metres, strict=True))).min(axis=1)
    found = values.splits["test"].leakage
    assert found.near_percent == pytest.approx(100.0 * np.mean(apart <= found.within_m))
    audit = next(part for part in data.card.split.audit if part.split == "test")
    assert found.sharing_percent == pytest.approx(100.0 * audit.overlapping_samples / audit.samples)
    page = (place / "evaluation.html").read_text()
    assert page.count("Audit (test held out by block)") == 2  # of each split, once
    assert "on 20 samples of train that stopped it early" in page


def test_every_prediction_is_kept_and_stands_in_the_page(evaluated, dataset):
    place, values = evaluated
    table, data = read_table(place / "predictions.parquet"), open_dataset(dataset)
    for split in ("test", "unseen"):
        rows = table.filter(pc.equal(table["split"], split))
        assert rows["sample_id"].to_pylist() == data[split].column("sample_id").tolist()
        off = rows["energy_predicted_joule"].to_numpy() - data[split].column("energy_joule")
        found = values.splits[split].errors["E"]["all"]
        assert np.sqrt(np.mean(off**2)) == pytest.approx(found.rmse, rel=1e-6)
        energy, low, high = (rows[f"energy_{of}joule"].to_numpy() for of in ("", "predicted_low_", "predicted_high_"))
        assert 100.0 * np.mean((low <= energy) & (energy <= high)) == pytest.approx(found.coverage_percent)


def test_the_worst_metres_are_named_with_their_errors(evaluated):
    place, _ = evaluated
    table, page = read_table(place / "predictions.parquet"), (place / "evaluation.html").read_text()
    off = np.abs(table["energy_predicted_joule"].to_numpy() - table["energy_joule"].to_numpy())
    for split in ("test", "unseen"):
        rows = np.flatnonzero(np.asarray(table["split"]) == split)
        worst = table["sample_id"].to_pylist()[rows[np.argmax(off[rows])]]
        assert worst in page[page.index("Worst segments") :]


def test_paths_are_off_by_less_than_metres(evaluated, dataset):
    """By hand: sums of thirty consecutive samples of a run."""
    place, values = evaluated
    table, split = read_table(place / "predictions.parquet"), open_dataset(dataset)["unseen"]
    rows = table.filter(pc.equal(table["split"], "unseen"))
    order = np.lexsort((split.column("start_ns"), split.column("run_id")))
    said, true = (rows[name].to_numpy()[order] for name in ("energy_predicted_joule", "energy_joule"))
    runs, sums = split.column("run_id")[order], []
    for run in np.unique(runs):
        own = np.flatnonzero(runs == run)
        sums += [(said[part].sum(), true[part].sum()) for part in np.array_split(own, max(len(own) // 30, 1))]
    off = np.array(sums) @ [1.0, -1.0]
    wanted = 100.0 * np.sqrt(np.mean(off**2)) / np.mean(np.array(sums)[:, 1])
    assert values.splits["unseen"].path_error_percent["E"] == pytest.approx(wanted)


def test_what_is_ablated_is_noise_and_nothing_else(model, dataset):
    """Replacing a layer by hand gives the same figures; no noise gives the model's own."""
    ours, test = load_model(model), open_dataset(dataset)["test"]
    patches = test.patches.copy()
    patches[..., 1] = np.random.default_rng([7, 1]).random(patches.shape[:3], np.float32)
    ours = replace(ours, residuals={})  # not centred
    by_hand = ours.predict(patches).mean[:, 0]
    assert predict_costs(ours, test, noise=["terrain"], seed=(7, 1)).costs["w"] == pytest.approx(by_hand, rel=1e-5)
    assert predict_costs(ours, test).costs["w"] == pytest.approx(ours.predict(test.patches).mean[:, 0], rel=1e-5)


def test_its_files_say_the_same(evaluated):
    place, values = evaluated
    assert json.loads((place / "evaluation.json").read_text()) == to_plain(values)
    page = (place / "evaluation.html").read_text()
    for told in ("Table I:", "Table II:", "Table III:", "Table V:", "12.80", "17.45", "Worst segments"):
        assert told in page
    assert page.count("<h2>") <= 8
    tables = re.split(r"<h3>Table [IV]+:", page)[1:]
    assert len(tables) == 4
    assert all("label noise alone" in table for table in tables[:2])
    words = re.sub(r"<[^>]*>", " ", re.sub(r"(?s)<(script|style).*?</\1>", " ", page)).split()
    assert len(words) <= 1500
    assert "default-src 'none'" in page  # whatever it names, it asks for nothing
    assert not re.search(r"RMSE of E.*[0-9] J, [-+]", page)  # a row of nine ranges fits
    told = page[: page.index('<script type="application/json"')]
    assert not re.search(r"https?:|(src|href)=\"[^#]", told)


def test_a_class_that_is_not_in_training_makes_the_model_usable_with_care(evaluated):
    _, values = evaluated
    assert {of.subject.name for of in select_findings(values.findings, "class-not-in-training")} == {"mud"}
    assert select_findings(values.findings, "model-of-another-dataset")
    assert "class-not-in-training" in {of.code for of in values.verdict.reasons}


def test_a_model_that_does_not_fit_is_told_every_reason(dataset, tmp_path):
    grass = replace(PAPER_CLASSES.classes[3], name="lawn")
    classes = (*PAPER_CLASSES.classes[:3], grass, *PAPER_CLASSES.classes[4:])
    place = made_model(tmp_path / "other", classes=classes, chord_m=2.0, label_velocity="fused")
    with pytest.raises(ModelError) as told:
        run_evaluation(place, dataset, tmp_path / "evaluation", config=CONFIG)
    told = "\n".join(told.value.problems)
    for reason in (
        "id 4 is lawn",
        "segment.chord_m is 2.0 in the model, 1.0 in the dataset",
        "label.velocity is 'fused'",
    ):
        assert reason in told


def test_samples_without_a_label_are_counted(model, dataset, tmp_path, monkeypatch):
    real = Split.labels.func
    monkeypatch.setattr(
        Split,
        "labels",
        property(
            lambda split: np.where((split.name == "unseen") & (np.arange(len(split)) < 3)[:, None], np.nan, real(split))
        ),
    )
    values = run_evaluation(model, dataset, tmp_path / "evaluation", config=ONE_DRAW).values
    count = len(open_dataset(dataset)["unseen"])
    (finding,) = select_findings(values.findings, "samples-without-label")
    assert (finding.subject.name, finding.numbers) == (
        "unseen",
        {"unlabelled_count": 3.0, "sample_count": float(count)},
    )
    assert values.splits["unseen"].errors["w"]["all"].count == count - 3


def test_without_an_unseen_area_it_says_so(model, tmp_path):
    build_dataset(tmp_path / "dataset", store=small_store(tmp_path).root, recipe=Recipe())
    values = run_evaluation(model, tmp_path / "dataset", tmp_path / "evaluation", config=ONE_DRAW).values
    assert list(values.splits) == ["test"]
    assert [of.subject.name for of in select_findings(values.findings, "split-empty")] == ["unseen"]
    assert "Table II:" not in (tmp_path / "evaluation" / "evaluation.html").read_text()


def test_a_folder_of_something_else_is_left_alone(model, dataset, tmp_path):
    (tmp_path / "thesis.txt").write_text("important")
    with pytest.raises(UsageError, match="exists and is no evaluation"):
        run_evaluation(model, dataset, tmp_path, config=CONFIG)


def test_the_same_again_predicts_nothing(evaluated, model, dataset, monkeypatch):
    place, values = evaluated
    before = {path: path.read_bytes() for path in place.iterdir()}
    monkeypatch.setattr("tcpipe.learning.evaluation_files.evaluate", None)
    assert run_evaluation(model, dataset, place, config=CONFIG).values == values
    assert {path: path.read_bytes() for path in place.iterdir()} == before
