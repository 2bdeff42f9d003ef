"""The page of a run: what it must say of its sensors, and that a map which cannot be read costs only its picture."""

import shutil
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from page_reading import data_of, unpacked
from stored_files import flip, only_run

from tcpipe.pipeline.ingest import ingest
from tcpipe.pipeline.maps import add_map
from tcpipe.report.maps import StoredMaps
from tcpipe.report.page import is_made_from
from tcpipe.report.run_report import run_report
from tcpipe.simulation import Faults, make_tiny, simulate
from tcpipe.store import Store


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    """A run of half a minute with all sensor faults, a map under it, and another that is damaged."""
    here = tmp_path_factory.mktemp("page")
    site = simulate(here / "site", scenario=make_tiny(Faults.every(), seconds=40.0), seed=4)
    assert ingest(site.logs, store=here / "store").exit_code == 0
    add_map("site", store=here / "store", height=site.rasters["height"])
    add_map("damaged", store=here / "store", height=site.rasters["height"])
    store = Store(here / "store")
    (path_of(store, "damaged") / "zarr.json").write_text("{")
    return store


def path_of(store, name):
    return Path(store.place.where(store.scan().maps[name].zarr))


def render(store):
    (run,) = store.runs()
    return run_report(run, StoredMaps(store, store.scan().maps), made_from="inputs")


@pytest.fixture(scope="module")
def page(store):
    return only_run(store.root), render(store)


def test_a_map_that_cannot_be_read_is_named_and_the_next_one_drawn(page):
    _, html = page
    assert "Map damaged cannot be shown:" in html
    assert data_of(html)["ground"] == ["hillshade"]
    assert not is_made_from(html.encode(), "inputs")  # it is rendered again until all maps can be read


def test_every_sensor_and_every_gate_stands_in_the_page_as_it_lies_in_the_store(store, page):
    run, html = page
    told, track = data_of(html), run.track().table
    assert len(html) < 5_000_000
    at_s = (track.column("stamp_ns").to_numpy() - track.column("stamp_ns")[0].as_py()) * 1e-9
    carried = told["series"]["track"]["packed"]
    assert unpacked(carried, "t") == pytest.approx(at_s, abs=1e-4)
    for name, column in (("power", "power_watt"), ("speed", "forward_velocity_mps"), ("height", "z_m")):
        wanted = track.column(column).to_numpy()
        assert np.allclose(unpacked(carried, name), wanted, atol=0.05, rtol=1e-3, equal_nan=True)
    power = pq.read_table(run.stream_files()["power"])
    (rail,) = [name for name in told["series"] if name.startswith("current ")]
    amps = power.column("current_amp").drop_null().to_numpy()
    assert unpacked(told["series"][rail]["packed"], "current") == pytest.approx(amps, abs=1e-3)
    assert {line["series"] for line in told["lines"] if line["plot"] == "speed"} == {"track", "gnss", "visual_odometry"}
    spans = told["spans"]
    seconds = unpacked(spans, "end") - unpacked(spans, "start")
    dropped = unpacked(spans, "bits") != 0
    rows = (track.column("dropped_by").to_numpy() != 0).sum()
    assert seconds[dropped].sum() == pytest.approx(rows / 20.0, abs=0.01)
    step_m = np.hypot(
        np.diff(unpacked(carried, "x")), np.diff(unpacked(carried, "y"))
    )  # a float32 has steps of half a metre here
    wanted_m = np.hypot(np.diff(track.column("x_m").to_numpy()), np.diff(track.column("y_m").to_numpy()))
    assert step_m == pytest.approx(wanted_m, abs=0.02, rel=0.01)
    segments = run.segments()
    assert unpacked(told["segments"], "energy_std") == pytest.approx(segments["energy_std_joule"].to_numpy(), rel=5e-3)
    ids = [f"{told['run']}-{start}" for start in told["starts"]]
    assert ids == segments.column("segment_id").to_pylist()


def test_where_streams_are_gone_the_track_is_drawn_and_the_page_says_so(store, tmp_path):
    alone = tmp_path / "store"
    shutil.copytree(store.root, alone)
    flip(only_run(alone).stream_files()["power"])
    html = render(Store(alone))
    assert list(data_of(html)["series"]) == ["track"]
    assert "The measurements cannot be drawn" in html


def test_trust_refusals_clocks_and_the_noise_floor_are_on_the_page(page):
    run, html = page
    facts = run.manifest.info.report.facts
    trust = html.split("<h3>Rejected measurements by sensor</h3>")[1].split("<h3>")[0]
    for role, nis in facts.fuse.nis_mean.items():
        (row,) = [row for row in trust.split("<tr>") if f"<td>{role.replace('_', ' ')}</td>" in row]
        assert f">{nis:.2f}</td>" in row
        refused = facts.fuse.rejected[role]
        assert (f"<td>{refused} gate</td>" in row) == (refused > 0)
    clocks = html.split("<h3>Clocks</h3>")[1].split("</section>")[0]
    assert all(f"<td>{role.replace('_', ' ')}</td>" in clocks for role in facts.clock_offsets[0].offsets)
    assert f"Noise floor of E {100 * facts.label.energy_budget.total:.1f} %" in html
    assert "Kept and excluded distances add up to the odometer" in html
