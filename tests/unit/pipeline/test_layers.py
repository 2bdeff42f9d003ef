"""GeoPackages by their own library and by SQLite: what lies where, with which style."""

import sqlite3
from contextlib import closing
from xml.etree.ElementTree import fromstring

import numpy as np
import pyarrow.parquet as pq
import pytest
import shapely
from click.testing import CliRunner
from pyproj import Geod
from synthetic_store import box, region_file, small_store

from tcpipe.cli import cli
from tcpipe.errors import UsageError
from tcpipe.pipeline.dataset.build import build_dataset
from tcpipe.pipeline.export import export_layers

pyogrio = pytest.importorskip("pyogrio", reason="the extra gis is not installed")

GEOD = Geod(ellps="WGS84")


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    here = tmp_path_factory.mktemp("layers")
    small_store(here)
    region = region_file(here / "region.geojson", box(-18, -18, 18, 18), box(19, -18, 20, 18), splits=(None, "unseen"))
    build_dataset(here / "dataset", store=here / "store", split=region)
    return here / "dataset"


def layer(path, name):
    """Columns and geometries of a layer."""
    meta, table = pyogrio.read_arrow(path, layer=name)
    return meta, table, shapely.from_wkb(table[meta["geometry_name"]].to_numpy(zero_copy_only=False))


def test_a_dataset_is_lines_footprints_and_regions(dataset, tmp_path):
    out = tmp_path / "site.gpkg"
    found = export_layers(dataset, out)
    samples = pq.read_table(dataset / "samples.parquet")
    assert found.layers["samples"] == found.layers["footprints"] == samples.num_rows
    meta, table, lines = layer(out, "samples")
    assert meta["crs"] == "EPSG:4326"
    assert table["sample_id"].to_pylist() == samples["sample_id"].to_pylist()
    assert table["power_watt"].to_pylist() == samples["power_watt"].to_pylist()
    first = [samples[f"{end}_{axis}_deg"][0].as_py() for end in ("start", "end") for axis in ("lon", "lat")]
    assert lines[0].coords[:] == [tuple(first[:2]), tuple(first[2:])]
    # A footprint is a metre square around its metre of way: by geodesics, area and distance of the middles.
    _, _, areas = layer(out, "footprints")
    for line, area in zip(lines[:20], areas[:20], strict=True):
        assert abs(GEOD.geometry_area_perimeter(area)[0]) == pytest.approx(1.0, rel=2e-3)
        middles = (*line.interpolate(0.5, normalized=True).coords[0], *area.centroid.coords[0])
        assert GEOD.inv(*middles)[2] < 0.002
    meta, table, regions = layer(out, "regions")
    kinds = dict(zip(table["split"].to_pylist(), regions, strict=True))
    assert set(kinds) == {"train_test", "unseen"}
    inside = np.array([kinds["train_test"].contains(area) for area in areas])
    assert inside[np.isin(samples["split"].to_pylist(), ("train", "test"))].all()


def test_qgis_finds_a_style_for_each_layer_and_bytes_are_the_same_again(dataset, tmp_path):
    out = tmp_path / "site.gpkg"
    found = export_layers(dataset, out)
    whole = out.read_bytes()
    with closing(sqlite3.connect(out)) as base:
        styles = base.execute("SELECT f_table_name, styleName, styleQML, useAsDefault FROM layer_styles").fetchall()
        listed = dict(base.execute("SELECT table_name, data_type FROM gpkg_contents").fetchall())
    assert listed == {**dict.fromkeys(found.layers, "features"), "layer_styles": "attributes"}
    assert sorted(name for name, _, _, ruling in styles if ruling) == sorted(found.layers)
    renderers = {
        (name, style): fromstring(qml[qml.index("<qgis") :]).find("renderer-v2")  # noqa: S314
        for name, style, qml, _ in styles
    }
    split = renderers["samples", "split"]
    assert [of.get("value") for of in split.find("categories")] == ["train", "test", "unseen", "buffer"]
    power = [float(of.get("upper")) for of in renderers["samples", "power"].find("ranges")]
    assert power == sorted(power)
    assert all(len(of.find("symbols")) >= 1 for of in renderers.values())
    export_layers(dataset, out)
    assert out.read_bytes() == whole


def test_a_store_is_its_segments_and_nothing_else_is_replaced(dataset, tmp_path):
    found = CliRunner().invoke(cli, ["export", str(dataset.parent / "store"), str(tmp_path / "store.gpkg")])
    assert found.exit_code == 0, found.output
    assert "448 segments" in found.output
    assert layer(tmp_path / "store.gpkg", "segments")[1].num_rows == 448
    (tmp_path / "mine.gpkg").write_text("mine")
    with pytest.raises(UsageError, match="is not a GeoPackage of tcpipe"):
        export_layers(dataset, tmp_path / "mine.gpkg")
    with pytest.raises(UsageError, match="is no dataset, run or store"):
        export_layers(tmp_path, tmp_path / "new.gpkg")
    assert not (tmp_path / "new.gpkg").exists()
