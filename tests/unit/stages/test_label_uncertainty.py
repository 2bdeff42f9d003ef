"""The part of σ that is one error of a whole run, against runs whose sensors have that error."""

from dataclasses import replace

import numpy as np
import pytest
from made_tracks import power_streams, stamps, straight_track

from tcpipe.recipe import LabelConfig, MaskConfig, Recipe, SegmentConfig
from tcpipe.recipe.checking import from_values
from tcpipe.robots import Robot
from tcpipe.stages.label import label_segments
from tcpipe.stages.mask import mask_track
from tcpipe.stages.segment import segment_track
from tcpipe.tables.columns import to_floats, to_integers
from tcpipe.tables.facts import FuseFacts, PowerSign, SectionFacts
from tcpipe.tables.findings import StageReport
from tcpipe.tables.levels import GNSS, WHEEL_ODOMETRY

T = np.arange(0, 80, 0.05)
ZERO = int(stamps(1)[0])
SPEED = np.clip(np.minimum(T - 20, 70 - T), 0, 0.8)  # at rest for 20 s
KIND = PowerSign("drawn_positive", False, (), 0.02, 0.2)


def rails(*, gain=1.0, offset_amp=0.0, count=2):
    """Rails whose voltage sags and whose current follows the speed, as a wrong sensor has them."""
    t = np.arange(0, 80, 0.05)
    amp = 0.4 + 5.0 * np.interp(t, T, SPEED) + 0.8 * np.sin(t)
    stamp_ns = ZERO + np.round(t * 1e9).astype(np.int64)
    return {f"rail {k}": (stamp_ns, 26.0 - 0.1 * amp, gain * amp / (k + 1) + offset_amp) for k in range(count)}


def label_run(power, *, facts=None, config=None, tables=None):
    power_watt = sum(volt * amp for _, volt, amp in power.values())
    track = straight_track(SPEED, power_watt=power_watt)
    masked = mask_track(track, MaskConfig(), max_velocity_mps=1.0, chord_m=1.0)
    report = StageReport((), replace(masked.info.report.facts, **({"power": KIND} | (facts or {}))))
    masked = replace(masked, info=replace(masked.info, report=report))
    streams = power_streams(power)
    streams = replace(streams, tables={**streams.tables, **(tables or {})})
    return label_segments(
        segment_track(masked, SegmentConfig()), masked, streams, config or LabelConfig(), robot=Robot()
    )


def label(power, **options):
    return label_run(power, **options).table


def test_the_common_columns_are_what_a_wrong_gain_and_offset_change():
    """Both rails read 2 % too much, or one of them 0.2 A: the labels change by the column, whichever way it is computed."""
    known = {
        "facts": {"power": replace(KIND, rest_current_amp=(0.0, 100.0))}
    }  # no offset is hidden in the current at rest
    right = label(rails(), **known)
    gain, offset = label(rails(gain=1.02)), label(rails(count=2) | {"rail 0": rails(offset_amp=0.2)["rail 0"]})
    for name, offsets in (
        ("energy_{}joule", 2),
        ("power_{}watt", 2),
        ("net_energy_{}joule", 0),
        ("net_power_{}watt", 0),
    ):
        label_, std, total = (to_floats(right, name.format(part)) for part in ("", "common_std_", "std_"))
        by_gain, by_offset = (to_floats(of, name.format("")) - label_ for of in (gain, offset))
        idle = to_floats(right, "idle_power_std_watt") * (to_floats(right, "duration_s") if "energy" in name else 1.0)
        rest = std**2 - (0.0 if offsets else idle**2)
        assert len(label_) > 20
        assert rest == pytest.approx(by_gain**2 + offsets * by_offset**2, rel=1e-6)
        assert (total >= std).all()
        assert offsets or np.abs(by_offset).max() < 0.3  # what is left is the voltage's change between rest and driving


def test_the_recipe_states_a_better_sensor():
    exact = label(rails(), config=LabelConfig(power_gain_std_fraction=0.0, power_offset_std_amp=0.0))
    assert (to_floats(exact, "energy_common_std_joule") == 0.0).all()
    calibrated = label(rails(), config=LabelConfig(power_gain_std_fraction=0.005, power_offset_std_amp=0.0))
    energy = to_floats(calibrated, "energy_joule")
    assert to_floats(calibrated, "energy_common_std_joule") == pytest.approx(0.005 * energy)


def section(**values):
    ends = {"start_ns": ZERO, "end_ns": ZERO + 80_000_000_000}
    fused = SectionFacts({}, {}, {}, **ends, **values)
    return {"fuse": FuseFacts(0, (), {}, {}, {}, {}, 0.0, (fused,))}


def test_the_scale_of_a_lone_odometry_is_common_to_duration_and_velocity():
    """With a metre 5 % too long every segment takes 5 % too long: T, v and, by the power at its end, E."""
    table = label(rails(), facts=section(common_scale_std=0.05))
    exact = {"power_gain_std_fraction": 0.0, "power_offset_std_amp": 0.0}
    sole = label(rails(), facts=section(common_scale_std=0.05), config=LabelConfig(**exact))
    duration, velocity = to_floats(table, "duration_s"), to_floats(table, "velocity_mps")
    steady = np.abs(velocity - 0.8) < 1e-3
    assert steady.sum() > 20
    assert to_floats(table, "duration_common_std_s")[steady] == pytest.approx(0.05 * duration[steady], rel=1e-3)
    assert to_floats(table, "velocity_common_std_mps")[steady] == pytest.approx(0.05 * velocity[steady], rel=1e-3)
    assert to_floats(sole, "energy_common_std_joule") == pytest.approx(0.05 * to_floats(sole, "energy_joule"), rel=0.2)
    assert (to_floats(table, "duration_std_s") >= to_floats(table, "duration_common_std_s")).all()
    assert (to_floats(label(rails()), "duration_common_std_s") == 0.0).all()


def test_a_segment_counts_the_sensors_that_measured_in_it_and_agree():
    """Wheels until 50 s, fixes throughout but disputed from 30 to 40 s; a camera that was not fused does not count."""
    wheels = WHEEL_ODOMETRY.empty().schema.names
    stamp_ns = ZERO + np.arange(0, 49_700_000_000, 100_000_000)
    nothing = {name: np.full(len(stamp_ns), np.nan) for name in wheels}
    common = {"stamp_ns": stamp_ns, "log_time_ns": stamp_ns, "clock_epoch": np.zeros(len(stamp_ns), np.int16)}
    odometry = WHEEL_ODOMETRY.table(**(nothing | common))
    fix_ns = ZERO + np.arange(0, 80_000_000_000, 200_000_000)
    place = dict.fromkeys(
        ("lon_deg", "lat_deg", "alt_m", "east_var_m2", "north_var_m2", "up_var_m2"), np.ones(len(fix_ns))
    )
    zero = np.zeros(len(fix_ns))
    fixes = GNSS.table(stamp_ns=fix_ns, log_time_ns=fix_ns, clock_epoch=zero, fix_status=zero, **place)
    table = label(
        rails(),
        facts=section(sensors=("gnss", "imu", "wheel_odometry")),
        tables={"gnss": fixes, "wheel_odometry": odometry, "visual_odometry": odometry},
    )
    start_s = (to_integers(table, "start_ns") - ZERO) * 1e-9
    wanted = 1 + (start_s < 49.65)
    assert set(wanted) == {1, 2}
    got = to_integers(table, "confirming_sensor_count")
    assert (got == wanted).all(), (start_s[got != wanted], got[got != wanted])


def find_negative_idle(power, kind=KIND):
    found = label_run(power, facts={"power": kind}).info.report.findings
    return next((finding for finding in found if finding.code == "idle-power-negative"), None)


@pytest.mark.parametrize(("count", "rest_amp", "zero_amp"), [(1, None, -0.5), (2, None, 0.0), (2, (0.0, 0.8), -0.5)])
def test_a_negative_idle_power_is_an_error_whose_lines_correct_the_labels_within_their_uncertainty(
    count, rest_amp, zero_amp
):
    kind = replace(KIND, rest_current_amp=rest_amp, zero_amp=zero_amp)
    found = find_negative_idle(rails(offset_amp=-1.6, count=count), kind)
    assert found.severity == "error"
    assert found.numbers["idle_watt"] < -0.03 * found.numbers["driving_watt"]
    (remedy,) = found.remedies
    recipe = from_values(Recipe, dict(remedy.recipe), where="suggested")
    further_amp = recipe.read.current_offset_amp - zero_amp
    corrected = rails(offset_amp=-1.6 - further_amp, count=count)
    assert find_negative_idle(corrected, kind) is None
    true, after = label(rails(count=count)), label(corrected, config=recipe.label, facts={"power": kind})
    error, std = (
        to_floats(after, "energy_joule") - to_floats(true, "energy_joule"),
        to_floats(after, "energy_std_joule"),
    )
    assert (np.abs(error) < 2.0 * std).all()
    before = label(rails(offset_amp=-1.6, count=count), facts={"power": replace(kind, rest_current_amp=None)})
    assert (std > to_floats(before, "energy_std_joule")).all()


def test_no_zero_is_off_while_charging_or_where_one_halt_draws_power_or_within_the_scatter():
    assert find_negative_idle(rails(offset_amp=-1.6), replace(KIND, charging=True)) is None
    assert find_negative_idle(rails()) is None
    assert find_negative_idle(rails(offset_amp=-0.42, count=1)) is None
    charged = {
        name: (stamp_ns, volt, np.where(T < 18.0, -4.0, amp)) for name, (stamp_ns, volt, amp) in rails(count=1).items()
    }
    assert find_negative_idle(charged) is None
