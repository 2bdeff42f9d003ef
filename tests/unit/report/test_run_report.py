"""The page of a run of which only its store is known: what is thinned keeps its peaks, times survive clocks that step, lacks are said."""

import numpy as np
import pyarrow as pa
import pytest
from page_reading import data_of, unpacked
from synthetic_store import add_run, driven, lanes, segments

from tcpipe.report.maps import StoredMaps
from tcpipe.report.run_plots import (
    downsample_columns,
    find_mask_spans,
    make_rail_series,
    make_timeline,
)
from tcpipe.report.run_report import run_report
from tcpipe.store import open_store
from tcpipe.tables.findings import Subject, make_finding
from tcpipe.tables.levels import POWER

EVIL = "</script><script>alert(1)</script>\x1b[31m\u202e\"'&"


def drive(run_id="run", **how):
    start, end = lanes((0.0,), -10.0, 10.0)
    return segments(run_id, start, end, start_ns=10**18, **how)


def page_of(tmp_path, table, **how):
    store = open_store(tmp_path / "store", create=True)
    add_run(store, "run", table, **how)
    (run,) = store.runs()
    return run_report(run, StoredMaps(store, {}))


def test_thinning_keeps_every_peak_and_says_how_many_there_were():
    rng = np.random.default_rng(1)
    values = rng.normal(size=100_003)
    values[[17, 60_001]] = 40.0, -40.0
    values[500:900] = np.nan
    shown = downsample_columns("x", np.arange(len(values)) * 0.01, {"y": (6, values)}, most=2_000)
    kept = shown.columns["y"][1]
    assert len(kept) == len(shown.t_s) <= 2_000
    assert (np.nanmax(kept), np.nanmin(kept)) == (40.0, -40.0)
    per_bin = -(-2 * len(values) // 2_000)
    for number in (0, 7, len(kept) // 2 - 1):
        part = values[number * per_bin : (number + 1) * per_bin]
        part = part[np.isfinite(part)]
        pair = kept[2 * number : 2 * number + 2]
        assert set(pair[np.isfinite(pair)]) == ({part.min(), part.max()} if len(part) else set())
    assert (np.diff(shown.t_s) > 0).all()
    assert abs(shown.t_s[np.nanargmax(kept)] - 0.17) < per_bin * 0.01
    short = np.array([1.0, np.nan, 3.0, 2.0, 5.0])
    shown = downsample_columns("x", np.arange(5.0), {"y": (2, short)})
    assert shown.columns["y"][1] == pytest.approx(short, nan_ok=True)
    assert len(shown.t_s) == 5


def test_a_span_ends_where_the_reason_or_the_track_does():
    track = driven(drive())
    without = pa.concat_tables(
        [track.slice(0, 40), track.slice(60)]
    )  # two seconds, a second is missing, three more standing
    spans = find_mask_spans(without, make_timeline(without), 20.0)
    assert spans["bits"][1].tolist() == [2, 2, 0]
    assert spans["start"][1] == pytest.approx([-0.025, 2.975, 4.975])
    assert spans["end"][1][:2] == pytest.approx([1.975, 4.975])


def test_rails_that_tell_current_and_voltage_in_turn_are_series_of_their_own():
    n = 10
    stamps = 10**18 + np.arange(n) * 10**8
    odd = np.arange(n) % 2 == 1
    table = POWER.table(
        stamp_ns=stamps, log_time_ns=stamps, clock_epoch=np.zeros(n, np.int16), rail=np.where(np.arange(n) < 6, "left", EVIL),
        voltage_volt=np.where(odd, 25.0, np.nan), current_amp=np.where(odd, np.nan, 4.0),
    )  # fmt: skip
    found = {each.name: each for each in make_rail_series(table, make_timeline(driven(drive())))}
    assert sorted(found) == sorted([f"{kind} {rail}" for kind in ("voltage", "current") for rail in ("left", EVIL)])
    assert found["current left"].t_s == pytest.approx([5.0, 5.2, 5.4])
    assert found["voltage left"].columns["voltage"][1] == pytest.approx([25.0] * 3)


def test_a_run_without_power_map_or_sensors_says_so(tmp_path):
    table = drive(powered=False)
    html = page_of(tmp_path, table, track=driven(table, powered=False))
    for text in (
        "The store has no map",
        "There is no power.",
    ):
        assert text in html
    told = data_of(html)
    assert told["ground"] == []
    assert "power" not in {line["plot"] for line in told["lines"]}
    assert np.isnan(unpacked(told["segments"], "power")).all()


def test_a_run_without_track_or_segments_is_a_page_too(tmp_path):
    empty = make_finding("no-segments", Subject("run", "run"), names={"reason": "gap"}, driven_m=12.0, lost_m=12.0)
    html = page_of(tmp_path, drive().slice(0, 0), distance_by_reason_m={"kept": 0.0, "gap": 12.0}, findings=(empty,))
    assert "No track: the log has no measurements that can be fused." in html
    assert "no segments from 12 m driven; largest loss: gap, 12 m" in html
    assert "<td>gap</td>" in html
