"""Cost maps: right everywhere, each tile decoded once, whole or resumable, and readable by others."""

import json
from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path

import matplotlib.image
import numpy as np
import pyproj
import pytest
import rasterio
from map_worlds import ArrayMap
from physics_model import PhysicsModel, energy_joule, power_watt, velocity_mps
from planning_worlds import plane
from ruamel.yaml import YAML
from stored_files import flip

from tcpipe.errors import MapError, ModelError, UsageError
from tcpipe.pipeline.verify import verify
from tcpipe.planning.cost_grid import ANGLES_DEG
from tcpipe.planning.cost_map import make_cost_map, make_cost_map_key, open_cost_map, read_cost_map_card
from tcpipe.planning.cost_model import Reason
from tcpipe.terrain.target_grid import MapGrid

MODEL = PhysicsModel()


@dataclass(frozen=True)
class CountingMap(ArrayMap):
    """Counts what is read."""

    reads: Counter = None

    def read(self, layer, row0, row1, col0, col1):
        self.reads[layer, row0, col0] += 1
        return super().read(layer, row0, row1, col0, col1)


def _map(**options):
    made = plane(**options)
    return CountingMap(made.grid, made.arrays, made.tile_px, reads=Counter())


def _trees(east, north):
    return np.where((east > 15.0) & (north > 12.0), 2, np.where(east < 8.0, 5, 4))


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A cost map of a slope with mud, grass and trees, and the map."""
    source = _map(rise_east=0.2, rise_north=0.1, classes=_trees)
    out = tmp_path_factory.mktemp("costs") / "cost-map"
    return source, make_cost_map(MODEL, source, out, cell_size_m=1.0)


def test_every_course_of_every_cell_costs_what_physics_says(made):
    _, result = made
    costs = open_cost_map(Path(result.path), read_cost_map_card(Path(result.path)))
    angle = np.radians(ANGLES_DEG)
    slope = (0.2 * np.cos(angle) + 0.1 * np.sin(angle)) * 0.9996
    for (row, col), class_id in {(12, 4): 5, (12, 12): 4}.items():
        np.testing.assert_allclose(costs.power_watt[:, row, col], power_watt(class_id, slope), rtol=4e-3)
        np.testing.assert_allclose(costs.velocity_mps[:, row, col], velocity_mps(class_id, slope), rtol=4e-3)
        assert (costs.reasons[:, row, col] == 0).all()
    assert (costs.reasons[:, 5, 20] == Reason.NOT_TRAVERSABLE | Reason.OBSTACLE | Reason.CLASS_OUTSIDE_TRAINING).all()
    assert np.isnan(costs.power_watt[:, 5, 20]).all()
    assert costs.height_m[12, 12] == pytest.approx(50.0 + 0.2 * 12.5 + 0.1 * 11.5, abs=0.03)


def test_every_tile_is_decoded_once(made):
    source, _ = made
    assert set(source.reads.values()) == {1}
    tiles = [
        of for of in source.reads if of[1] % 64 == 0 and of[2] % 64 == 0
    ]  # the others are single classes, of cells
    assert len(tiles) == 3 * 16


def test_bands_say_what_they_are_and_the_last_four_sum_up_the_courses(made):
    _, result = made
    with rasterio.open(Path(result.path) / "energy.tif") as dataset:
        assert dataset.tags(ns="IMAGE_STRUCTURE")["LAYOUT"] == "COG"
        assert dataset.descriptions[:2] == ("course 0.0 deg", "course 26.6 deg")
        assert dataset.descriptions[16:] == ("min", "mean", "best course, ccw from grid east", "std of a metre")
        assert dataset.units[0] == "J/m"
        assert dataset.transform[:6] == (1.0, 0.0, 500_000.0, 0.0, -1.0, 5_200_000.0)
        assert dataset.crs.to_epsg() == 32633
        energy = dataset.read()
        north = dataset.sample([(500_004.5, 5_200_000.0 - 12.5), (500_012.5, 5_200_000.0 - 12.5)], indexes=5)
        np.testing.assert_allclose(np.ravel(list(north)), energy_joule([5, 4], 0.1 * 0.9996), rtol=4e-3)
    known = energy[:, 12, 12]
    assert known[16] == known[:16].min()
    assert known[17] == pytest.approx(known[:16].mean(), rel=1e-6)
    assert known[18] == pytest.approx(ANGLES_DEG[known[:16].argmin()], rel=1e-6)
    errors = MODEL.errors["energy"]
    assert known[19] == pytest.approx(errors.compute_std(known[:16], np.full(16, 4)).mean(), rel=1e-5)
    assert known[19] == pytest.approx(0.1 * known[17], rel=0.1)  # as its residuals were made
    downhill = np.degrees(np.arctan2(-0.1, -0.2)) % 360.0
    assert abs(known[18] - downhill) < 14.0
    with rasterio.open(Path(result.path) / "velocity.tif") as dataset:
        velocity = dataset.read()[:, 12, 12]
    assert velocity[18] == pytest.approx(ANGLES_DEG[velocity[:16].argmax()])


def test_bands_and_nav2_map_sum_up_the_same_courses_and_say_which(tmp_path):
    """Downhill is steeper than training; the mean, its standard deviation and the Nav2 map leave these courses out."""
    source = _map(rise_east=0.4)
    flat = replace(MODEL, training_range=MODEL.training_range | {"slope_rad": (-0.2, 0.5), "relief_m": (0.0, 9.0)})
    result = make_cost_map(flat, source, tmp_path / "costs", cell_size_m=2.0)
    with (
        rasterio.open(tmp_path / "costs" / "energy.tif") as energy,
        rasterio.open(tmp_path / "costs" / "reasons.tif") as of,
    ):
        bands, trusted = energy.read()[:, 5, 5], of.read()[:16, 5, 5] == 0
    assert 4 < trusted.sum() < 16
    assert np.isfinite(bands[:16]).all()
    assert bands[16:18] == pytest.approx([bands[:16][trusted].min(), bands[:16][trusted].mean()])
    scale, about = result.card.nav2_scale["energy"], (tmp_path / "costs" / "energy.yaml").read_text()
    assert scale.lowest == pytest.approx(bands[17], rel=1e-3)
    assert result.card.aggregation == "mean over the courses without a reason"
    assert result.card.aggregation in about


def read_as_map_server(yaml):
    """Return occupancy, shape (rows, cols), as map_server's loadMapFromYaml in mode scale, and the map's description."""
    about = YAML(typ="safe").load(yaml.read_text())
    assert about["mode"] == "scale"
    grey = matplotlib.image.imread(yaml.parent / about["image"]).astype(float)
    shade = (grey if about["negate"] else 255.0 - grey) / 255.0
    scaled = (shade - about["free_thresh"]) / (about["occupied_thresh"] - about["free_thresh"])
    cost = np.where(
        shade > about["occupied_thresh"], 100, np.where(shade < about["free_thresh"], 0, np.rint(100 * scaled))
    )
    return cost.astype(int), about


def read_as_static_layers(occupancy):
    """Return costs (0 to 254) of `StaticLayer::interpretValue`: in proportion, as up to kilted; by the table of main and lyrical."""
    old = np.where(occupancy >= 100, 254, (occupancy / 100.0 * 254.0).astype(int))
    new = np.where(occupancy == 99, 253, np.where(occupancy == 100, 254, np.rint(1 + (occupancy - 1) * 251 / 97)))
    return old, np.where(occupancy == 0, 0, new).astype(int)


def test_nav2_finds_a_scale_map_with_trees_that_are_lethal_and_no_free_cell_lost(made):
    _, result = made
    cost, about = read_as_map_server(Path(result.path) / "energy.yaml")
    assert about["origin"] == [500_000.0, 5_200_000.0 - 24.0, 0.0]
    assert "frame: x and y of EPSG:32633" in (Path(result.path) / "energy.yaml").read_text()
    assert cost.shape == (24, 24)
    assert cost[5, 20] == 100
    assert cost[12, 4] > cost[12, 12]
    scale = result.card.nav2_scale["energy"]
    angle = np.radians(ANGLES_DEG)
    mean = energy_joule(4, (0.2 * np.cos(angle) + 0.1 * np.sin(angle)) * 0.9996).mean()
    assert scale.lowest + cost[12, 12] / 98 * (scale.highest - scale.lowest) == pytest.approx(mean, rel=0.02)
    costs = open_cost_map(Path(result.path), read_cost_map_card(Path(result.path)))
    is_free = (costs.reasons == 0).any(axis=0)
    assert cost[is_free].max() == 98
    for layer in read_as_static_layers(cost):
        assert (layer[is_free] < 253).all()
        assert (layer[~is_free] == 254).all()


def test_nav2_maps_of_an_origin_are_true_east_and_north(tmp_path):
    """2.9 degrees off the central meridian: grid north is turned by 2.1 degrees, 11 m at 300 m."""
    grid = MapGrid("EPSG:32633", 720_000.0, 5_200_120.0, 2.0, 60, 200)
    east, _ = np.meshgrid(np.arange(200), np.arange(60))
    terrain = np.where(np.abs(east - 150) < 3, 2, 4).astype(np.uint8)
    arrays = {
        "height": np.full(east.shape, 50.0, np.float32),
        "ortho": np.full(east.shape, 128, np.uint8),
        "terrain": terrain,
    }
    source = ArrayMap(grid, arrays, 64)
    lonlat = pyproj.Transformer.from_crs("EPSG:32633", "EPSG:4326", always_xy=True).transform
    origin = lonlat(720_001.0, 5_200_001.0)
    make_cost_map(replace(MODEL, patch_px=4), source, tmp_path / "c", cell_size_m=2.0, origin_deg=origin)
    cost, about = read_as_map_server(tmp_path / "c" / "energy.yaml")
    assert "true east and north" in (tmp_path / "c" / "energy.yaml").read_text()
    to_ecef = pyproj.Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True).transform
    lon, lat = np.radians(origin)
    turn = np.array([
        [-np.sin(lon), np.cos(lon), 0.0],
        [-np.sin(lat) * np.cos(lon), -np.sin(lat) * np.sin(lon), np.cos(lat)],
    ])  # fmt: skip
    zero = np.array(to_ecef(*origin, 0.0))
    for north in (20.0, 60.0, 100.0):  # the middle of the wall, wherever it is
        enu = turn @ (np.array(to_ecef(*lonlat(720_301.0, 5_200_001.0 + north), 0.0)) - zero)
        col = int((enu[0] - about["origin"][0]) / about["resolution"])
        row = cost.shape[0] - 1 - int((enu[1] - about["origin"][1]) / about["resolution"])
        assert cost[row, col] == 100
        assert cost[row, col - 12] < 99


def test_masks_and_parameters_are_those_of_nav2_s_costmap_filters(made):
    """Read as map_server in mode raw, by CostmapFilterInfo (value = base + multiplier * mask), and as Smac 2D weighs costs."""
    _, result = made
    here, parameters = Path(result.path), YAML(typ="safe").load((Path(result.path) / "nav2.yaml").read_text())
    costs = open_cost_map(here, read_cost_map_card(here))
    is_free = (costs.reasons == 0).any(axis=0)
    masks = {}
    for name, kind in (("keepout", 0), ("speed", 2)):
        about = YAML(typ="safe").load((here / f"{name}.yaml").read_text())
        assert (about["mode"], about["origin"][:2]) == ("raw", [500_000.0, 5_200_000.0 - 24.0])
        mask = matplotlib.image.imread(here / about["image"]).astype(int)
        info = parameters[f"{name}_info_server"]["ros__parameters"]
        server = parameters[f"{name}_mask_server"]["ros__parameters"]
        layer = parameters["global_costmap"]["global_costmap"]["ros__parameters"][f"{name}_filter"]
        assert info["type"] == kind
        assert info["mask_topic"] == server["topic_name"]
        assert info["filter_info_topic"] == layer["filter_info_topic"]
        assert server["yaml_filename"] == f"{name}.yaml"
        assert ((mask >= 0) & (mask <= 100)).all()
        masks[name] = info["base"] + info["multiplier"] * mask
    assert (masks["keepout"] == np.where(is_free, 0, 100)).all()
    with rasterio.open(here / "velocity.tif") as dataset:
        mean_mps = dataset.read(18)
    step_mps = parameters["speed_info_server"]["ros__parameters"]["multiplier"]
    limit = masks["speed"][is_free]
    assert ((limit > mean_mps[is_free] - step_mps - 1e-6) & (limit <= mean_mps[is_free] + 1e-6)).all()
    assert (masks["speed"][~is_free] == 0.0).all()
    multiplier = parameters["planner_server"]["ros__parameters"]["GridBased"]["cost_travel_multiplier"]
    cost, _ = read_as_map_server(here / "energy.yaml")
    _, layer = read_as_static_layers(cost)
    with rasterio.open(here / "energy.tif") as dataset:
        mean_jpm = dataset.read(18)
    weight = (1.0 + multiplier * layer / 252.0)[is_free]
    scale = result.card.nav2_scale["energy"]
    wanted = np.clip(mean_jpm[is_free], scale.lowest, scale.highest) / scale.lowest
    np.testing.assert_allclose(weight, wanted, rtol=0.02)


@dataclass(frozen=True)
class _Asked(PhysicsModel):
    """Counts what it is asked; stops like a user after so many calls."""

    patches: list = None
    most: int = 10**9

    def predict(self, patches, extra_features):
        if len(self.patches) == self.most:
            raise KeyboardInterrupt
        self.patches.append(len(patches))
        return super().predict(patches, extra_features)


def test_an_interrupted_map_goes_on_where_it_was_and_ends_the_same(made, tmp_path: Path, monkeypatch):
    source, whole = made
    source = replace(source, reads=Counter())  # what is read here is not counted there
    monkeypatch.setattr("tcpipe.planning.cost_map._BLOCKS_KEPT", 1)
    stopped, going_on = _Asked(patches=[], most=4), _Asked(patches=[])
    with pytest.raises(KeyboardInterrupt):
        make_cost_map(stopped, source, tmp_path / "cost-map", cell_size_m=1.0)
    assert not (tmp_path / "cost-map").exists()
    again = make_cost_map(going_on, source, tmp_path / "cost-map", cell_size_m=1.0)
    asked = int(np.count_nonzero(~np.isnan(open_cost_map(Path(again.path), again.card).velocity_mps)))
    assert sum(stopped.patches) + sum(going_on.patches) == asked
    assert again.card.key == whole.card.key
    for path in sorted(Path(whole.path).iterdir()):
        assert (Path(again.path) / path.name).read_bytes() == path.read_bytes(), path.name
    assert [entry.name for entry in tmp_path.iterdir()] == ["cost-map"]


def test_a_second_call_does_nothing_and_another_step_replaces_it(tmp_path: Path):
    source, out = _map(side_m=6.0), tmp_path / "c"
    assert make_cost_map(MODEL, source, out, cell_size_m=2.0).status == "done"
    before = (out / "cost-map.json").stat().st_mtime_ns
    second = make_cost_map(MODEL, source, out, cell_size_m=2.0)
    assert second.status == "unchanged"
    assert "nothing to do" in str(second)
    assert (out / "cost-map.json").stat().st_mtime_ns == before
    assert make_cost_map(MODEL, source, out, cell_size_m=3.0).card.grid.rows == 2
    assert (
        make_cost_map_key(replace(MODEL, checksum="1" * 64), source, 3.0)
        != json.loads((out / "cost-map.json").read_text())["key"]
    )


def test_a_damaged_file_is_named_by_verify_and_by_who_reads_it_and_a_second_call_mends_it(tmp_path: Path):
    source, out = _map(side_m=6.0), tmp_path / "c"
    card = make_cost_map(MODEL, source, out, cell_size_m=2.0).card
    assert (verify(out).kind, verify(out).problems) == ("cost map", ())
    (out / "energy.tif.aux.xml").write_text("statistics that a viewer left")
    flip(out / "power.tif", 0.99)
    (problem,) = verify(out).problems
    assert str(out / "power.tif") in problem
    with pytest.raises(MapError, match=r"power\.tif: its sha256 is"):
        open_cost_map(out, card)
    assert make_cost_map(MODEL, source, out, cell_size_m=2.0).status == "done"
    (out / "cost-map.json").write_text((out / "cost-map.json").read_text().replace("16", "17"))
    assert "has changed since it was written" in verify(out).problems[0]
    assert read_cost_map_card(out) is None
    assert make_cost_map(MODEL, source, out, cell_size_m=2.0).status == "done"
    assert verify(out).problems == ()


def test_what_cannot_be_mapped_is_one_line(tmp_path: Path):
    source = _map(side_m=6.0)
    with pytest.raises(MapError, match="smaller than one cell"):
        make_cost_map(MODEL, source, tmp_path / "c", cell_size_m=7.0)
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "mine.txt").write_text("mine")
    with pytest.raises(UsageError, match="is no cost map"):
        make_cost_map(MODEL, source, tmp_path / "full", cell_size_m=1.0)
    del source.arrays["terrain"]
    with pytest.raises(ModelError, match="has no terrain"):
        make_cost_map(MODEL, source, tmp_path / "c", cell_size_m=1.0)


def test_the_nav2_frame_begins_at_the_robots_datum_and_nothing_is_predicted_anew(made, tmp_path):
    source, out = replace(made[0], reads=Counter()), tmp_path / "cost-map"  # what is read here is not counted there
    plain = make_cost_map(MODEL, source, out, cell_size_m=2.0)
    datum = (500_003.0, 5_199_990.0)
    lonlat = pyproj.Transformer.from_crs("EPSG:32633", "EPSG:4326", always_xy=True).transform(*datum)
    never_asked = _Asked(patches=[], most=0)
    moved = make_cost_map(never_asked, source, out, cell_size_m=2.0, origin_deg=lonlat)
    assert (plain.status, moved.status) == ("done", "done")
    about = YAML(typ="safe").load((out / "energy.yaml").read_text())
    assert about["origin"] == pytest.approx([-3.0, -14.0, 0.0], abs=0.02)
    assert moved.card.checksums["energy.tif"] == plain.card.checksums["energy.tif"]
    assert make_cost_map(MODEL, source, out, cell_size_m=2.0, origin_deg=lonlat).status == "unchanged"
    with pytest.raises(UsageError, match=r"km from map .*; give LON,LAT \(longitude first\)"):
        make_cost_map(MODEL, source, out, cell_size_m=2.0, origin_deg=lonlat[::-1])
