"""The balance of a dataset from a store with an analytic map: card, page, and where to drive next."""

import json
import re

import numpy as np
import pyarrow.parquet as pq
import pyproj
import pytest
import shapely
from made_tracks import with_columns
from synthetic_store import WORLD, add_run, box, lanes, open_world, region_file, segments

from tcpipe.balance.cells import SLOPE_NAMES, find_slope_ranges
from tcpipe.pipeline.dataset.build import build_dataset
from tcpipe.recipe import Recipe

DRAWS_DATASET_PAGES = True

CLOSED = box(-19, -19, -5, 19)
NOISE_WATT = 7.0


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    """Eight lanes that are driven twice, the second time a little off and with other noise, and one that is driven back."""
    directory = tmp_path_factory.mktemp("balance")
    store = open_world(directory)
    rng = np.random.default_rng(0)
    start, end = lanes(-15.0 + 4.0 * np.arange(8), -4.0, 16.0)
    for run_id, offset in (("once", 0.0), ("again", 0.1)):
        table = segments(run_id, start + offset, end + offset, start_ns=int(1e18 + offset * 1e15))
        power = 150.0 + rng.normal(0.0, NOISE_WATT, len(start))
        add_run(store, run_id, with_columns(table, power_watt=power))
    add_run(store, "back", segments("back", end[:20] + 0.05, start[:20] + 0.05, start_ns=int(2e18)))
    region = region_file(directory / "region.geojson", box(-20, -20, 20, 20), CLOSED, splits=(None, "exclude"))
    build_dataset(directory / "out", store=store.root, recipe=Recipe(), split=region)
    return directory / "out"


@pytest.fixture(scope="module")
def balance(built):
    return json.loads((built / "dataset.json").read_text())["balance"]


def test_cells_hold_the_samples_that_are_in_use(built, balance):
    samples = pq.read_table(built / "samples.parquet")
    used = samples.filter(samples["split"].to_numpy() != np.array("buffer"))
    for cells in (balance["cells"], balance["by_class_and_slope"]):
        assert sum(sum(cell["samples"].values()) for cell in cells) == used.num_rows
    names = np.array(SLOPE_NAMES)[find_slope_ranges(used["slope_rad"].to_numpy())]
    for cell in balance["by_class_and_slope"]:
        rows = (names == cell["slope"]) & (used["terrain_name"].to_numpy() == cell["class"])
        assert sum(cell["samples"].values()) == rows.sum()
        assert cell["rare"] == (cell["effective"] < 30)


def test_what_was_driven_twice_gives_the_noise_that_was_put_in(balance):
    found = balance["repeatability"]["power_watt"]
    assert found["pairs"] > 100
    assert found["std_low"] < NOISE_WATT < found["std_high"]
    assert found["std"] == pytest.approx(NOISE_WATT, rel=0.15)


def test_the_page_shows_every_cell_of_class_and_slope(built, balance):
    page = (built / "report.html").read_text()
    shown = page.split("<h2>Balance of class and slope")[1].split("<h2>Repeatability: lower bound of model errors")[0]
    found = [int(count) for count in re.findall(r"<td[^>]*><span[^>]*>(\d+) \(\d+\)\*?</span></td>", shown)]
    cells = balance["by_class_and_slope"]
    assert sorted(found) == sorted(sum(cell["samples"].values()) for cell in cells if any(cell["samples"].values()))


def test_where_to_drive_next_is_geojson_that_a_gis_takes(built, balance):
    document = json.loads((built / "drive-next.geojson").read_text())
    assert set(document) == {"type", "features"}  # RFC 7946: no crs
    assert document["features"]
    assert [feature["properties"]["rank"] for feature in document["features"]] == list(
        range(1, len(document["features"]) + 1)
    )
    to_map = pyproj.Transformer.from_crs(4326, WORLD.crs, always_xy=True)
    samples = pq.read_table(built / "samples.parquet")
    rare = {(row["class"], row["slope"]) for row in balance["by_class_and_slope"] if row["rare"]}
    names = np.array(SLOPE_NAMES)[find_slope_ranges(samples["slope_rad"].to_numpy())]
    used = samples["split"].to_numpy() != np.array("buffer")
    closed = shapely.Polygon(np.add(CLOSED, (WORLD.x_m, WORLD.y_m))).buffer(np.sqrt(2.0))
    as_said = []
    for feature in document["features"]:
        assert feature["type"] == "Feature"
        (ring, *_), about = feature["geometry"]["coordinates"], feature["properties"]
        assert ring[0] == ring[-1]
        assert shapely.is_ccw(shapely.LinearRing(ring))
        assert (about["class"], about["slope"]) in rare
        polygon = shapely.Polygon(np.column_stack(to_map.transform(*np.array(ring).T)))
        assert shapely.box(*np.add((-20, -20, 20, 20), (WORLD.x_m, WORLD.y_m) * 2)).buffer(0.01).covers(polygon)
        assert polygon.intersection(closed).area < 0.01
        assert polygon.area >= about["area_m2"] - 0.1  # its outer ring; holes are cut from it
        same = (names == about["slope"]) & (samples["terrain_name"].to_numpy() == about["class"])
        inside = shapely.contains_xy(shapely.geometry.shape(feature["geometry"]), *samples_lonlat(samples))
        assert not (same & inside & used).any()
        slope_deg = world_slope_deg(polygon.representative_point(), about["drive_towards"])
        as_said.append(slope_deg is None or (slope_deg > 0) == (about["slope"] in SLOPE_NAMES[5:]))
    assert np.mean(as_said) > 0.9


def samples_lonlat(samples):
    """Middles of the samples."""
    return [(samples[f"start_{a}_deg"].to_numpy() + samples[f"end_{a}_deg"].to_numpy()) / 2 for a in ("lon", "lat")]


def world_slope_deg(point, towards):
    """Slope of the analytic world at a point, along one of the eight winds."""
    if towards is None:
        return None
    north, east = ("N" in towards) - ("S" in towards), ("E" in towards) - ("W" in towards)
    step = 0.5 * np.array([east, north]) / np.hypot(east, north)
    low, high = (WORLD.height(point.x + sign * step[0], point.y + sign * step[1]) for sign in (-1, 1))
    return float(np.degrees(np.arctan(high - low)))
