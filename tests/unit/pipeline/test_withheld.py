"""Withheld fixes show errors that a test adds to the track, and their size is compared with its σ."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from unit.fusion import drive
from unit.stages.test_fuse import filled, sensor, streams_of

from tcpipe.errors import FusionError
from tcpipe.pipeline import audit as withheld
from tcpipe.pipeline.audit import Comparison, compare_withheld, place_windows, score_comparisons, withhold
from tcpipe.recipe import FuseConfig
from tcpipe.stages.fuse import fuse_run
from tcpipe.tables.columns import to_floats, to_integers
from tcpipe.tables.facts import ParameterFacts
from tcpipe.tables.findings import Subject, make_finding
from tcpipe.tables.levels import GNSS_VELOCITY

SECONDS = 185.0
END_S = 5.0


@given(st.floats(0.0, 5000.0), st.sampled_from([10.0, 30.0, 60.0]))
def test_windows_lie_inside_the_run_with_as_much_data_between(span_s, length_s):
    windows = place_windows(span_s, length_s)
    assert np.diff(windows, axis=1) == pytest.approx(length_s)
    assert (windows[1:, 0] - windows[:-1, 1] >= length_s - 1e-6).all()
    if span_s < length_s + 2 * END_S:
        assert not windows.size
    else:
        assert windows[0, 0] >= END_S - 1e-6
        assert windows[-1, 1] <= span_s - END_S + 1e-6
        assert len(windows) == int((span_s - 2 * END_S + length_s) / (2 * length_s)), "a further one would fit"


@pytest.fixture(scope="module")
def streams():
    measured = drive.measure(drive.make_drive(SECONDS, turns=0.5), 1, gnss_outliers=0.0, slip=0.0)
    return streams_of(measured)


@pytest.fixture(scope="module")
def track(streams):
    return fuse_run(streams, FuseConfig(), run_id="run")


def audited(streams, track, monkeypatch, change, windows_s=(10.0,)):
    """Compare what is withheld with a track whose columns are changed by a function of their values and of the stamps [s]."""
    monkeypatch.setattr(withheld, "WINDOWS_S", windows_s)
    time_s = (to_integers(track.table, "stamp_ns") - drive.ZERO_NS) * 1e-9
    columns = {name: track.table[name] for name in track.table.column_names}
    columns |= change({name: to_floats(track.table, name) for name in track.table.column_names}, time_s)
    table = track.table.select([])
    for name, values in columns.items():
        table = table.append_column(track.table.schema.field(name), [values])
    monkeypatch.setattr(withheld, "fuse_run", lambda *_, **__: replace(track, table=table))
    return compare_withheld(streams, FuseConfig(), run_id="run").comparisons


def shift(std_m, claimed_m):
    """Return a change that moves a track by a normal error, another one every ten seconds, and claims a σ."""
    errors = np.random.default_rng(5).normal(0.0, std_m, (2, 30))

    def change(columns, time_s):
        step = (time_s / 10.0).astype(int)
        moved = {f"{axis}_m": columns[f"{axis}_m"] + errors[k, step] for k, axis in enumerate("xy")}
        return moved | {f"{axis}_std_m": np.full(time_s.size, claimed_m) for axis in "xy"}

    return change


def test_an_error_of_the_track_is_what_the_fixes_show_of_it(streams, track, monkeypatch):
    def change(columns, _):
        return {"x_m": columns["x_m"] + 0.3, "y_m": columns["y_m"] - 0.4}

    (fixes,) = audited(streams, track, monkeypatch, change)
    score = score_comparisons([fixes])
    assert fixes.error_m.mean(axis=0) == pytest.approx([-0.3, 0.4], abs=0.01), "withheld less predicted"
    assert score.median_error_m == pytest.approx(0.5, abs=0.01)
    assert (score.windows, score.calibration) == (9, "overconfident")
    assert score.compared <= 10 * score.windows, "one a second"


def test_what_is_not_known_of_the_lever_arm_is_no_part_of_the_antennas_sigma(streams, track, monkeypatch):
    """The σ of base_link contains 0.5 m of the arm along each axis of the body; the antenna is known to 0.3 m."""
    stated = replace(streams, sensors={**streams.sensors, "gnss": sensor((0.0, 0.0, 0.0))})
    report = track.info.report
    shown = {"antenna": ParameterFacts(drive.LEVER, (0.5,) * 3, (0.5,) * 3)}
    fuse = replace(report.facts.fuse, sections=[replace(of, parameters=shown) for of in report.facts.fuse.sections])
    numbers = {f"{axis}{end}": 0.0 for axis in ("forward", "left", "up") for end in ("_m", "_std_m")}
    unknown = make_finding("lever-arm-unknown", Subject("role", "gnss"), names={"placed_by": "assumed"}, **numbers)
    report = replace(report, findings=(unknown,), facts=replace(report.facts, fuse=fuse))
    estimated = replace(track, info=replace(track.info, report=report))
    (fixes,) = audited(stated, estimated, monkeypatch, shift(0.0, float(np.hypot(0.3, 0.5))))
    assert fixes.std_m == pytest.approx(0.3, rel=0.02)
    assert score_comparisons([fixes]).median_error_m < 0.05, "the antenna is where the estimated arm has it"


def make_fixes(shares_inside, values=20):
    """Return fixes of as many windows as shares, of which such a share errs by half a σ and the rest by three."""
    inside = [np.arange(values) < share * values for share in shares_inside]
    error = np.where(np.concatenate(inside), 0.5, 3.0)[:, None] * np.ones(2)
    window = np.repeat(np.arange(len(shares_inside)), values)
    return Comparison(60.0, window, error, np.ones_like(error))


@pytest.mark.parametrize(
    ("shares_inside", "calibration"),
    [
        ((0.2, 1.0), "undecided"),  # as the demo's log: 60 % of 40 values inside, from two windows
        ((0.0, 0.0), "undecided"),
        ((0.0,) * 5, "overconfident"),
        ((0.0, 0.0, 1.0, 1.0, 1.0, 1.0, 1.0), "calibrated"),
        ((0.0, 0.0, 0.0, 1.0, 1.0, 1.0, 1.0), "overconfident"),
        ((1.0,) * 9, "calibrated"),
        ((1.0,) * 12, "underconfident"),
    ],
)
def test_a_verdict_counts_windows_not_their_values(shares_inside, calibration):
    score = score_comparisons([make_fixes(shares_inside)])
    assert (score.windows, score.calibration) == (len(shares_inside), calibration)
    assert score_comparisons([make_fixes(shares_inside, values=200)]).calibration == calibration


def test_fixes_are_withheld_in_windows_and_with_them_the_velocity_of_their_receiver(streams):
    stamp_ns = to_integers(streams.tables["gnss"], "stamp_ns")
    velocity = filled(GNSS_VELOCITY, stamp_ns)
    both = replace(
        streams,
        tables={**streams.tables, "gnss_velocity": velocity},
        sensors={**streams.sensors, "gnss_velocity": sensor()},
    )
    windows_ns = drive.ns(np.array([[20.0, 30.0], [50.0, 60.0]]))
    rest = withhold(both, 0, windows_ns)
    inside = ((stamp_ns[:, None] >= windows_ns[:, 0]) & (stamp_ns[:, None] <= windows_ns[:, 1])).any(1)
    for role in ("gnss", "gnss_velocity"):
        assert to_integers(rest.tables[role], "stamp_ns").tolist() == stamp_ns[~inside].tolist()
    assert rest.tables["wheel_odometry"] is both.tables["wheel_odometry"]
    assert withhold(both, 1, windows_ns).tables["gnss"].num_rows == stamp_ns.size, "another clock epoch"


def test_the_fused_rest_of_a_clean_drive_predicts_its_fixes(streams, monkeypatch):
    monkeypatch.setattr(withheld, "WINDOWS_S", (10.0,))
    found = compare_withheld(streams, FuseConfig(), run_id="run")
    assert not found.skipped
    fixes = score_comparisons(found.comparisons)
    assert (fixes.windows, fixes.window_s) == (9, 10.0)
    assert fixes.median_error_m < 0.05
    assert fixes.calibration != "overconfident"


def test_a_run_without_fixes_shows_its_length_against_its_odometry(streams):
    def ratios(*removed):
        tables = {role: table for role, table in streams.tables.items() if role not in removed}
        return compare_withheld(replace(streams, tables=tables), FuseConfig(), run_id="run")

    alone = ratios("gnss", "visual_odometry")
    assert alone.skipped == ("without fixes",)
    assert alone.length_ratios == {"wheel_odometry": pytest.approx(1.0, abs=0.05)}
    only_fixes = ratios("wheel_odometry", "visual_odometry")
    assert (only_fixes.comparisons, only_fixes.length_ratios) == ((), {})
    with pytest.raises(FusionError, match="no sensor measures motion"):
        ratios("gnss", "wheel_odometry", "visual_odometry", "imu")
