"""The page of a dataset says what its card and its tables say, shows every sample or means of them, and tells what is damaged."""

import base64
import io
import re
import shutil

import numpy as np
import pyarrow.parquet as pq
import pytest
import zarr
from page_reading import data_of, unpacked
from PIL import Image
from synthetic_store import add_run, lanes, open_world, segments

from tcpipe.dataset import open_dataset
from tcpipe.pipeline.dataset.build import build_dataset
from tcpipe.pipeline.report import report
from tcpipe.report import dataset_report
from tcpipe.report.dataset_report import SAMPLE_COLUMNS, find_nearest_train_m, render_dataset_report, select_samples
from tcpipe.report.label_sections import QUALITY_WORDS
from tcpipe.splits.assignment import SPLITS
from tcpipe.tables.bits import Quality

DRAWS_DATASET_PAGES = True


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    here = tmp_path_factory.mktemp("page")
    store = open_world(here)
    for number, run in enumerate(("north", "south")):
        start, end = lanes((4.0 * number, 4.0 * number + 1.5), -12.0, 12.0)
        add_run(store, run, segments(run, start, end, start_ns=int((number + 1) * 1e18)))
    build_dataset(here / "dataset", store=store.root)
    return here / "dataset"


@pytest.fixture(scope="module")
def page(built):
    as_built = (built / "report.html").read_text()
    assert "../store" not in as_built  # the same bytes wherever the store is
    assert report(built)[0].changed
    return (built / "report.html").read_text()


def test_its_numbers_are_the_cards(built, page):
    card = open_dataset(built).card
    by_label = {label: value for value, label in re.findall(r"<div><b>([^<]*)</b><span>([^<]*)</span></div>", page)}
    assert page.count("<h2>") <= 8
    assert by_label["samples"] == str(card.samples)
    assert {name: by_label[name] for name in card.splits} == {name: str(n) for name, n in card.splits.items()}
    assert by_label["runs"] == "2"
    assert by_label["driven"] == f"{sum(card.distance_by_reason_m.values()):.0f} m"
    assert {of["name"]: of["count"] for of in data_of(page)["splits"]} == card.splits
    for part in card.split.audit:
        row = page.split(f"<td>{part.split}</td>")[1].split("</tr>")[0]
        assert re.findall(r">(\d+)<", row)[:4] == [
            str(n) for n in (part.samples, part.overlapping_samples, part.same_track_pairs, part.repeated_place_samples)
        ]


def test_every_sample_is_there_as_the_table_has_it(built, page):
    table, data = pq.read_table(built / "samples.parquet"), data_of(page)
    told = data["samples"]["packed"]
    np.testing.assert_allclose(unpacked(told, "energy"), table["energy_joule"].to_numpy(), rtol=0.0, atol=0.03)
    np.testing.assert_allclose(unpacked(told, "energy_std"), table["energy_std_joule"].to_numpy(), rtol=0.004)
    np.testing.assert_array_equal(unpacked(told, "quality"), table["quality"].to_numpy())
    names = [data["splits"][number]["name"] for number in unpacked(told, "split")]
    assert names == table["split"].to_pylist()
    runs = [data["runs"][number] for number in unpacked(told, "run")]
    after = unpacked(told, "after_s").astype(object) * 10**9 + unpacked(told, "after_ns")
    ids = [f"{run['id']}-{int(run['first_ns']) + ns}" for run, ns in zip(runs, after, strict=True)]
    assert data["samples"]["ids"] is None
    assert ids == table["sample_id"].to_pylist()


def test_patches_are_those_of_the_samples_named(built, page):
    sheets = data_of(page)["patches"]
    (ortho,) = [layer for layer in sheets["layers"] if layer["name"] == "ortho"]
    picture = np.asarray(Image.open(io.BytesIO(base64.b64decode(ortho["uri"].split(",")[1]))).convert("L"), float)
    px, across = sheets["px"], sheets["across"]
    stored = zarr.open_group(built / "patches.zarr", mode="r")["ortho"][:].astype(float)
    shown = [picture[i // across * px :, i % across * px :][:px, :px] for i in range(len(sheets["rows"]))]
    alike = np.array(
        [[np.corrcoef(one.ravel(), stored[row].ravel())[0, 1] for row in sheets["rows"][:20]] for one in shown[:20]]
    )
    assert len(shown) == len(stored)
    own = np.diag(alike)
    assert (alike.max(axis=1) - own < 1e-3).all()  # some ground of this world repeats itself
    assert np.median(alike) < np.median(own)


def test_the_same_dataset_has_the_same_page(built, page):
    assert not report(built)[0].changed
    assert page.startswith(render_dataset_report(built, built.parent))


def test_of_too_many_samples_the_first_are_shown(built, monkeypatch):
    monkeypatch.setattr(dataset_report, "MOST_SAMPLES", 30)
    card, table = open_dataset(built).card, pq.read_table(built / "samples.parquet", columns=list(SAMPLE_COLUMNS))
    xy_m, shown = select_samples(card, table)
    energy = unpacked(shown["packed"], "energy")
    np.testing.assert_allclose(energy, table["energy_joule"].to_numpy()[:30], rtol=1e-3)
    assert len(xy_m) == 30
    assert unpacked(shown["packed"], "nearest").max() < 30
    data = data_of(render_dataset_report(built))
    assert max(data["patches"]["rows"]) < 30
    assert data["count"] == table.num_rows


def test_a_damaged_dataset_says_so_on_its_page(built, tmp_path):
    shutil.copytree(built, tmp_path / "dataset")
    (tmp_path / "dataset/overview.png").write_bytes(b"no picture")
    for file in (tmp_path / "dataset/patches.zarr/ortho/c").rglob("*"):
        if file.is_file():
            file.write_bytes(b"\0" * file.stat().st_size)
    html = render_dataset_report(tmp_path / "dataset")
    for words in ("overview.png is missing or damaged", "no patches are shown"):
        assert words in html
    assert data_of(html)["patches"] is None


def test_the_nearest_train_metre_is_the_nearest():
    chance = np.random.default_rng(1)
    xy_m, split = chance.uniform(0, 9, (60, 2)), chance.choice(["train", "test", "unseen", "buffer"], 60)
    apart_m, nearest = find_nearest_train_m(xy_m, np.array([SPLITS.index(name) for name in split]))
    train = np.flatnonzero(split == "train")
    for row in range(60):
        if split[row] in {"test", "unseen"}:
            ways = np.hypot(*(xy_m[train] - xy_m[row]).T)
            assert apart_m[row] == pytest.approx(ways.min())
            assert nearest[row] == train[ways.argmin()]
        else:
            assert np.isnan(apart_m[row])


def test_every_quality_bit_has_words():
    assert list(QUALITY_WORDS) == list(Quality)
