"""Rasters of a user's own, from add-map to a tensor: against closed forms, in both formats, with their classes."""

import json

import numpy as np
import pytest
import rasterio
import xarray as xr
from click.testing import CliRunner
from map_worlds import write_tif
from rasterio import Affine
from stored_files import map_path, read_files
from synthetic_store import WORLD, add_run, lanes, segments

import tcpipe
from tcpipe.cli import cli
from tcpipe.errors import TcpipeError
from tcpipe.learning.model_card import LayerRange
from tcpipe.learning.models import load_model
from tcpipe.learning.training import _report_layers
from tcpipe.pipeline.explain import explain
from tcpipe.pipeline.verify import verify
from tcpipe.store import open_store
from tcpipe.terrain.layers import PAPER_CLASSES, Layer

DRAWS_DATASET_PAGES = True

PITCH_M = 0.2


def moisture(x, y):
    """Per cent, linear: interpolation is exact."""
    return 30.0 + 0.5 * (x - WORLD.x_m) - 0.3 * (y - WORLD.y_m)


def canopy(x, y):
    """Raster values: 40 in the west, 7 in the east."""
    return np.where(x < WORLD.x_m, 40, 7)


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """Rasters of the 40 m world: the paper's three, colours, two layers of the user's, and a store with one run."""
    here = tmp_path_factory.mktemp("layers")
    rasters = WORLD.write(here, pixel_size_m=0.1)
    x, y = WORLD.centres(PITCH_M)
    where = Affine(PITCH_M, 0, WORLD.x_m - 20.0, 0, -PITCH_M, WORLD.y_m + 20.0)
    write_tif(here / "moisture.tif", moisture(x, y).astype(np.float32)[None], WORLD.crs, where)
    write_tif(here / "canopy.tif", canopy(x, y).astype(np.uint8)[None], WORLD.crs, where)
    for name, place in (("east", x - WORLD.x_m), ("north", y - WORLD.y_m)):
        values = np.broadcast_to(place, moisture(x, y).shape)
        write_tif(here / f"{name}.tif", values.astype(np.float32)[None], WORLD.crs, where)
    with rasterio.open(here / "moisture.tif", "r+") as raster:
        raster.set_band_unit(1, "%")
    (here / "canopy.csv").write_text("value,id,name,traversable\n40,1,open,yes\n7,2,closed canopy,yes\n")
    with rasterio.open(rasters["ortho"]) as raster:
        grey, profile = raster.read(1), raster.profile
    with rasterio.open(here / "colour.tif", "w", **{**profile, "photometric": "RGB"}) as raster:
        raster.write(np.stack([grey, 255 - grey, np.full_like(grey, 200)]))
    store = open_store(here / "store", create=True)
    add_run(store, "north", segments("north", *lanes(1.0 + 2.0 * np.arange(8), -14.0, 14.0), start_ns=10**18))
    return here


def run(here, *arguments):
    """Run a command on the store of the site."""
    return CliRunner().invoke(cli, [*map(str, arguments), "--store", str(here / "store"), "-q"])


def add(here, name, *more, ortho="ortho.tif"):
    paper = ["--height", here / "height.tif", "--ortho", here / ortho, "--terrain", here / "terrain.tif"]
    return run(here, "add-map", name, *paper, *more)


@pytest.fixture(scope="module")
def datasets(site):
    layers = ["--layer", f"moisture={site}/moisture.tif", "--layer", f"canopy={site}/canopy.tif"]
    layers += ["--layer", f"east={site}/east.tif", "--layer", f"north={site}/north.tif"]
    own = [*layers, "--categorical", f"canopy={site}/canopy.csv", "--ortho-bands", "rgb"]
    for name, more in (("plain", []), ("own", own)):
        result = add(site, name, *more, ortho="colour.tif")
        assert result.exit_code == 0, result.output
    for out, name, file_format in (("plain", "plain", "zarr"), ("zarr", "own", "zarr"), ("parquet", "own", "parquet")):
        built = run(site, "build-dataset", site / out, "--map", name, "--format", file_format, "--holdout", "sample")
        assert built.exit_code in {0, 3}, built.output
    return site


def test_the_paper_s_three_are_what_they_are_without_the_others(datasets):
    plain, own = (tcpipe.open_dataset(datasets / name)["train"] for name in ("plain", "zarr"))
    assert own.channels == ("ortho", "terrain", "height")
    np.testing.assert_array_equal(own.patches, plain.patches)
    for layer in ("ortho", "terrain", "height"):
        files = [path for path in (datasets / "plain/patches.zarr" / layer).rglob("*") if path.is_file()]
        assert files
        for path in files:
            assert path.read_bytes() == (datasets / "zarr" / path.relative_to(datasets / "plain")).read_bytes()


@pytest.mark.parametrize("name", ["zarr", "parquet"])
def test_every_pixel_is_what_lies_there(datasets, name):
    asked = ["moisture", "ortho_red", "canopy", "height", "ortho_green", "ortho_blue"]
    train = tcpipe.open_dataset(datasets / name, layers=asked)["train"]
    assert train.patches.shape == (len(train), 40, 40, 6)
    samples = train._columns.table()
    lon, lat = ((samples[f"start_{a}_deg"].to_numpy(), samples[f"end_{a}_deg"].to_numpy()) for a in ("lon", "lat"))
    x, y = to_world(np.mean(lon, axis=0), np.mean(lat, axis=0))  # chords are a metre long: the patch is centred there
    stored = train.layers(np.arange(len(train)))
    middle = stored["moisture"][:, 19:21, 19:21].mean(axis=(1, 2))
    np.testing.assert_allclose(middle, moisture(x, y), atol=2e-3)
    far = np.abs(x - WORLD.x_m) > 1.0
    np.testing.assert_array_equal(stored["canopy"][far, 20, 20], np.where(x[far] < WORLD.x_m, 1, 2))
    red, green, blue = (stored[f"ortho_{colour}"].astype(int) for colour in ("red", "green", "blue"))
    assert np.abs(red + green - 255).max() <= 1
    assert (blue == 200).all()
    low, high = train._card.layers["moisture"]["actual_range"]
    np.testing.assert_allclose(train.patches[..., 0], (stored["moisture"] - low) / (high - low), atol=1e-6)
    np.testing.assert_array_equal(train.patches[..., 2], stored["canopy"] - 1.0)
    batch, _ = next(iter(train.batches(8, from_disk=True)))
    np.testing.assert_array_equal(batch, train.patches[:8])


def to_world(lon, lat):
    import pyproj

    return pyproj.Transformer.from_crs(4326, WORLD.crs, always_xy=True).transform(lon, lat)


def test_all_that_describes_a_dataset_tells_of_them(datasets):
    for name in ("zarr", "parquet", "store"):
        assert verify(datasets / name).problems == ()
    patches = xr.open_zarr(datasets / "zarr" / "patches.zarr")
    assert patches.moisture.attrs["units"] == "%"
    assert patches.canopy.attrs["flag_meanings"] == "open closed_canopy"
    fields = json.loads((datasets / "parquet" / "croissant.json").read_text())["recordSet"][1]["field"]
    kinds = {field["name"]: field["dataType"] for field in fields}
    assert (kinds["moisture"], kinds["canopy"]) == ("sc:Float", "sc:Integer")
    assert "canopy" in (datasets / "zarr" / "report.html").read_text()
    listed = CliRunner().invoke(cli, ["inspect", str(map_path(datasets / "store", "own"))]).output
    assert all(name in listed for name in ("moisture", "canopy", "ortho_red"))
    sample_id = tcpipe.open_dataset(datasets / "zarr")["train"].column("sample_id")[0]
    assert explain(sample_id, dataset=datasets / "zarr", store=datasets / "store").facts.map.name == "own"


def test_a_raster_s_own_names_are_its_classes(site, tmp_path):
    with rasterio.open(site / "canopy.tif") as raster:
        values, profile = raster.read(), raster.profile
    named = tmp_path / "named.tif"
    with rasterio.open(named, "w", **profile) as raster:
        raster.write(values)
    name_document = {7: "closed", 40: "open"}
    categories = "".join(f"<Category>{name_document.get(value, '')}</Category>" for value in range(41))
    (tmp_path / "named.tif.aux.xml").write_text(
        f'<PAMDataset><PAMRasterBand band="1"><CategoryNames>{categories}</CategoryNames></PAMRasterBand></PAMDataset>'
    )
    result = add(site, "named", "--layer", f"canopy={named}", "--categorical", "canopy")
    assert result.exit_code == 0, result.output
    assert "50 % closed, 50 % open" in result.output


@pytest.mark.parametrize(
    ("more", "code", "line"),
    [
        (["--categorical", "canopy"], 2, "--categorical canopy: no layer of that name; --layer gives none is given"),
        (["--layer", "height={}/moisture.tif"], 2, "layer height: the name is taken"),
        (["--layer", "sample_id={}/moisture.tif"], 2, "layer sample_id: the name is taken"),
        (["--layer", "2wet={}/moisture.tif"], 2, "layer '2wet': expected small letters"),
        (["--layer", "moisture"], 2, "--layer moisture: expected NAME=FILE"),
        (["--layer", "m={}/moisture.tif", "--layer", "m={}/canopy.tif"], 2, "--layer m: is given twice"),
        (["--layer", "m={}/absent.tif"], 2, "absent.tif: there is no such file"),
        (
            ["--layer", "m={}/colour.tif", "--categorical", "m"],
            1,
            "expected one of class values",
        ),
        (["--layer", "m={}/canopy.tif", "--categorical", "m"], 1, "does not define the meaning of its values"),
        (
            ["--layer", "m={}/moisture.tif", "--categorical", "m={}/canopy.csv"],
            1,
            "m has the value 14.08, expected whole numbers",
        ),
        (["--layer", "m={}/away.tif"], 1, "has no data anywhere on the height raster"),
    ],
)
def test_what_cannot_be_a_layer_is_refused_in_a_line(site, more, code, line):
    ones = np.full((1, 20, 20), 5.0, np.float32)
    write_tif(site / "away.tif", ones, WORLD.crs, Affine(1, 0, WORLD.x_m + 500.0, 0, -1, WORLD.y_m))
    before = [name for name in read_files(site / "store") if not name.startswith("calls/")]
    result = add(site, "refused", *(text.format(site) for text in more), ortho="colour.tif")
    assert isinstance(result.exception, TcpipeError)
    assert (result.exception.exit_code, len(result.exception.problems)) == (code, 1)
    assert line in result.exception.problems[0]
    assert [name for name in read_files(site / "store") if not name.startswith("calls/")] == before


PAPER = "ortho,terrain,height"


@pytest.fixture(scope="module")
def models(datasets):
    """Models of the paper's layers alone, with layers that show the place, and with layers that hardly show it."""
    for name, layers in (
        ("plain", PAPER),
        ("placed", f"{PAPER},east,north"),
        ("idle", f"{PAPER},canopy_one_hot,ortho_red"),
    ):
        more = ["--model", "boosting", "--layers", layers, "-q"]
        trained = CliRunner().invoke(cli, ["train", str(datasets / "zarr"), str(datasets / f"model-{name}"), *more])
        assert trained.exit_code == 0, trained.output
    return datasets


def error_mps(here, name, dataset="zarr"):
    """RMSE of velocity on test; it follows the place."""
    model, test = load_model(here / f"model-{name}"), tcpipe.open_dataset(here / dataset)["test"]
    said = model.predict(test.with_layout(model.card.layout).patches).mean[:, 1]
    return float(np.sqrt(np.mean((said - test.labels[:, 1]) ** 2)))


def test_layers_that_tell_the_cost_lower_the_error_of_held_out_samples(models):
    plain, placed, idle = (error_mps(models, name) for name in ("plain", "placed", "idle"))
    assert placed < 0.75 * plain
    assert idle > 0.9 * plain
    assert error_mps(models, "placed", "parquet") == pytest.approx(placed, rel=1e-6)


def test_a_model_says_which_layers_it_takes(datasets, tmp_path, caplog):
    result = CliRunner().invoke(cli, ["train", str(datasets / "zarr"), str(tmp_path / "model"), "--model", "physics"])
    assert result.exit_code == 0
    assert "takes the slope and class of each metre, and no layer" in result.output
    with caplog.at_level("WARNING", "tcpipe"):
        _report_layers(tcpipe.open_dataset(datasets / "zarr"), PAPER.split(","), is_chosen=False)
    assert (
        "does not use canopy, east, moisture, north; to use it: --layers ortho,terrain,height,canopy,east"
        in caplog.text
    )
    for layers, model, line in (
        ("ortho,soil", "boosting", "requested channels: soil"),
        (PAPER, "physics", "not a patch"),
    ):
        more = ["--model", model, "--layers", layers]
        result = CliRunner().invoke(cli, ["train", str(datasets / "zarr"), str(tmp_path / "other"), *more])
        assert isinstance(result.exception, TcpipeError)
        assert line in result.exception.problems[0]


def test_costs_need_the_layers_of_the_model(models):
    said = {}
    for name in ("own", "plain"):
        more = ["--map", name, "--cell-size", "2"]
        said[name] = run(models, "cost-map", models / "model-placed", models / f"cost-{name}", *more)
    assert said["own"].exit_code == 0, said["own"].output
    assert isinstance(said["plain"].exception, TcpipeError)
    (line,) = said["plain"].exception.problems
    assert line.endswith(
        "has no east, north, which model " + str(models / "model-placed") + " needs; add the map with --layer east=FILE"
    )


def test_ground_unlike_that_of_training_in_a_layer_of_one_s_own_is_named(models):
    """A mean far from all training samples, or a class that none had; the same patches as in training are inside."""
    model = load_model(models / "model-placed")
    split = tcpipe.open_dataset(models / "zarr")["train"].with_channels("east")
    known, layer = model.card.training_range.layers["east"], model.card.layout.known["east"]
    patches = split.layers(np.arange(len(split)))["east"]
    inside = known.compute_distance(layer.compute_means(patches))
    assert inside.max() == pytest.approx(known.largest)
    other = patches.astype(np.float32)
    other += 3.0 * (other.max() - other.min())
    assert (known.compute_distance(layer.compute_means(other)) > known.largest).all()
    classes = Layer("x", "categorical", "x", np.dtype(np.uint8), np.dtype(np.uint8), classes=PAPER_CLASSES)
    seen = LayerRange.estimate(classes.compute_means(np.full((5, 2, 2), 4, np.uint8)))
    new = seen.compute_distance(classes.compute_means(np.array([[[4, 4], [4, 4]], [[4, 4], [4, 5]]], np.uint8)))
    assert (new > seen.largest).tolist() == [False, True]
