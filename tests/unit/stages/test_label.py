"""Labels of segments whose cost is known in closed form, and the bits that they carry."""

import math
from dataclasses import replace

import numpy as np
import pyarrow as pa
import pytest
from made_tracks import power_streams, stamps, straight_track
from simulated_streams import log_of, streams_of

from tcpipe.cost.labels import SensorError
from tcpipe.formats.finding_lines import format_budget
from tcpipe.pipeline.ingest_run import run_stages
from tcpipe.power.rails import IdlePower
from tcpipe.recipe import LabelConfig, MaskConfig, Recipe, SegmentConfig
from tcpipe.robots import Robot
from tcpipe.simulation import Faults, find_scenario
from tcpipe.simulation.robot import GRAVITY_MPS2, SimulatedRobot
from tcpipe.simulation.route import Wander
from tcpipe.stages.fuse_sections import make_power_columns
from tcpipe.stages.label import compute_segment_costs, label_segments
from tcpipe.stages.mask import mask_track
from tcpipe.stages.message_arrays import make_rails
from tcpipe.stages.segment import segment_track
from tcpipe.tables.bits import Quality
from tcpipe.tables.columns import to_floats, to_integers
from tcpipe.tables.facts import CAUSES, PowerSensorFacts
from tcpipe.tables.findings import select_findings
from tcpipe.tables.levels import Sensor, Streams

T = np.arange(0, 60, 0.05)
ZERO = stamps(1)[0]
SPEED = np.full(len(T), 0.8)


HUSKY = Robot(voltage_range_volt=(20.0, 30.0))


def label(track, streams, *, config=None, robot=HUSKY):
    masked = mask_track(track, MaskConfig(), max_velocity_mps=1.0, chord_m=1.0)
    segments = segment_track(masked, SegmentConfig())
    return label_segments(segments, masked, streams, config or LabelConfig(), robot=robot)


def record(period_s=0.05, *, volt=lambda t: 24 + 0 * t, amp=lambda t: 6 + 0 * t, delay_s=0.0131):
    t = np.arange(-1, 61, period_s) + delay_s
    return ZERO + np.round(t * 1e9).astype(np.int64), volt(t), amp(t)


def flagged(labelled, bit):
    return (labelled.table["quality"].to_numpy() & np.uint32(bit)) != 0


def codes_of(labelled):
    return [finding.code for finding in labelled.info.report.findings]


def test_constant_power_on_a_straight_line():
    labelled = label(straight_track(SPEED), power_streams({"drive": record()}))
    table = labelled.table
    assert to_floats(table, "duration_s") == pytest.approx(1.25, abs=1e-8)
    assert to_floats(table, "velocity_mps") == pytest.approx(0.8, abs=1e-8)
    assert to_floats(table, "power_watt") == pytest.approx(144.0)
    assert to_floats(table, "energy_joule") == pytest.approx(180.0)
    assert set(to_integers(table, "power_samples")) == {25}
    assert (table["quality"].to_numpy() == int(Quality.NO_COMMAND)).all()
    assert to_floats(table, "power_watt") * to_floats(table, "duration_s") == pytest.approx(
        to_floats(table, "energy_joule")
    )


def test_whole_run_energy_and_where_it_went():
    speed = np.clip(np.minimum(T - 5, 50 - T), 0, 0.8)
    labelled = label(straight_track(speed), power_streams({"drive": record()}))
    facts = labelled.info.report.facts.label
    stamp_ns, _, _ = record()
    assert facts.energy_joule == pytest.approx(144.0 * (stamp_ns[-1] - stamp_ns[0]) * 1e-9)
    entries = facts.energy_by_entry_joule
    assert sum(entries.values()) == pytest.approx(facts.energy_joule)
    assert entries["stationary"] == pytest.approx(144 * 15, rel=0.02)
    seconds = labelled.info.report.facts.segment.duration_by_reason_s
    for name in ("stationary", "accelerating"):
        assert entries[name] == pytest.approx(144 * seconds[name], rel=1e-9)
    assert entries["steady"] == pytest.approx(144 * sum(seconds[n] for n in ("kept", "curved", "leftover")), rel=1e-9)
    assert facts.distance_m == pytest.approx(sum(labelled.distance_by_reason_m.values()))


def test_the_papers_sum_is_late_by_half_a_period():
    streams = power_streams({"drive": record(0.1, amp=lambda t: 6 + 2 * t)})
    paper, exact = (
        label(straight_track(SPEED), streams, config=LabelConfig(integration=rule)).table
        for rule in ("right_endpoint", "exact")
    )
    more = to_floats(paper, "power_watt") - to_floats(exact, "power_watt")
    assert more.mean() == pytest.approx(24 * 2 * 0.05, rel=0.05)


def test_averaged_sources_are_right_endpoint_rectangles():
    stamp_ns, volt, _ = record(0.5)
    t = (stamp_ns - ZERO) * 1e-9
    mean_of_last_period = 6 + 2 * (t - 0.25)
    streams = power_streams({"drive": (stamp_ns, volt, mean_of_last_period)}, averaged=True)
    labelled = label(straight_track(SPEED), streams)
    start, end = ((to_integers(labelled.table, name) - ZERO) * 1e-9 for name in ("start_ns", "end_ns"))
    wanted = 24 * ((6 * end + end**2) - (6 * start + start**2))
    assert to_floats(labelled.table, "energy_joule") == pytest.approx(wanted, abs=24 * 2 * 0.5**2 / 4 + 1e-6)
    assert labelled.info.report.facts.label.integration == "averaged"
    assert not flagged(labelled, Quality.LOW_POWER_RATE).any()


def test_a_run_without_power_has_null_labels():
    labelled = label(straight_track(SPEED), Streams({}, {}, "husky"))
    table = labelled.table
    assert table["energy_joule"].null_count == table["power_std_watt"].null_count == table.num_rows > 0
    assert to_floats(table, "duration_s") == pytest.approx(1.25, abs=1e-8)
    assert labelled.info.report.facts.label.energy_joule is None


def test_segments_beyond_the_record_have_null_labels_and_a_warning():
    stamp_ns, volt, amp = record()
    short = stamp_ns < ZERO + 30_000_000_000
    labelled = label(straight_track(SPEED), power_streams({"drive": (stamp_ns[short], volt[short], amp[short])}))
    unknown = np.isnan(to_floats(labelled.table, "energy_joule"))
    assert unknown.tolist() == (to_integers(labelled.table, "end_ns") > stamp_ns[short][-1]).tolist()
    assert "segments-without-power" in codes_of(labelled)


def test_energy_is_not_usable_if_power_reaches_no_segment():
    stamp_ns, volt, amp = record()
    labelled = label(straight_track(SPEED), power_streams({"drive": (stamp_ns - 10**12, volt, amp)}))
    assert "no-power" in codes_of(labelled)
    assert "segments-without-power" not in codes_of(labelled)


@pytest.mark.parametrize(
    ("period_s", "averaged", "low"), [(0.1, False, False), (0.12, False, True), (0.5, True, False), (0.6, True, True)]
)
def test_low_power_rate(period_s, averaged, low):
    labelled = label(straight_track(SPEED), power_streams({"drive": record(period_s)}, averaged=averaged))
    assert flagged(labelled, Quality.LOW_POWER_RATE).all() == low
    slow = select_findings(labelled.info.report.findings, "power-too-slow")
    assert [of.names["quantity"] for of in slow] == ["current"] * low


def test_voltage_out_of_range_where_it_is():
    streams = power_streams({"drive": record(volt=lambda t: np.where((t > 20) & (t < 21), 19.0, 24.0))})
    labelled = label(straight_track(SPEED), streams)
    found = flagged(labelled, Quality.VOLTAGE_OUT_OF_RANGE)
    start, end = ((to_integers(labelled.table, name) - ZERO) * 1e-9 for name in ("start_ns", "end_ns"))
    assert found[(start < 21) & (end > 20.1)].all()
    assert not found[(end < 19.9) | (start > 21.1)].any()
    none = label(straight_track(SPEED), streams, robot=Robot())
    assert not flagged(none, Quality.VOLTAGE_OUT_OF_RANGE).any()


def test_wheels_that_slip_are_flagged_where_they_do_and_named_once():
    slipping = straight_track(SPEED, wheel_mps=np.where(T < 30, 0.85, 1.2), commanded_mps=np.ones(len(T)))
    labelled = label(slipping, power_streams({"drive": record()}))
    late = to_integers(labelled.table, "start_ns") > ZERO + 30_000_000_000
    assert flagged(labelled, Quality.HIGH_SLIP)[late].all()
    assert not flagged(labelled, Quality.HIGH_SLIP)[~late][:-1].any()
    assert codes_of(labelled).count("wheels-slip") == 1


def test_error_budget_adds_up_to_the_deviations():
    rough = lambda t: 6 + np.random.default_rng(0).normal(0, 1, len(t))  # noqa: E731
    labelled = label(straight_track(SPEED, std_m=1.0), power_streams({"drive": record(0.2, amp=rough)}))
    budget = labelled.info.report.facts.label.energy_budget
    energy, std = to_floats(labelled.table, "energy_joule"), to_floats(labelled.table, "energy_std_joule")
    assert np.hypot(budget.total, budget.common) == pytest.approx(np.sqrt(np.mean(std**2)) / energy.mean())
    assert budget.common == pytest.approx(np.hypot(0.02, 0.2 / 6.0), rel=0.01)
    assert budget.total**2 == pytest.approx(sum(getattr(budget, cause) ** 2 for cause in CAUSES))
    assert budget.position == pytest.approx(144 * 0.004 * 1.25 / 0.8 / 180, rel=0.05)
    assert budget.position < budget.at_20_hz < 0.7 * budget.total
    assert "20 Hz" in format_budget(budget)


def test_means_differ_when_samples_are_uneven():
    stamp_ns, volt, _ = record(0.02)
    keep = ((stamp_ns // 20_000_000) % 25 < 12) | ((stamp_ns // 20_000_000) % 5 == 0)
    t = (stamp_ns - ZERO) * 1e-9
    amp = 6 + 4 * np.sin(2 * np.pi * t / 0.5)
    labelled = label(straight_track(SPEED), power_streams({"drive": (stamp_ns[keep], volt[keep], amp[keep])}))
    assert flagged(labelled, Quality.POWER_MEAN_MISMATCH).any()
    even = label(straight_track(SPEED), power_streams({"drive": (stamp_ns, volt, amp)}))
    assert not flagged(even, Quality.POWER_MEAN_MISMATCH).any()


@pytest.mark.parametrize(("role", "doubtful"), [("power", True), ("command", False)])
def test_clock_doubtful_when_the_recorder_stamped_what_counts(role, doubtful):
    sensors = {role: Sensor("/t", "x/msg/Y", "f", "why", time_source="log")}
    streams = power_streams({"drive": record()}, sensors=sensors)
    assert flagged(label(straight_track(SPEED), streams), Quality.CLOCK_DOUBTFUL).all() == doubtful


def test_epochs_with_overlapping_stamps_keep_their_own_power():
    stamp_ns = np.concatenate((stamps(600), stamps(600)))
    clock_epoch = np.repeat(np.array([0, 1], dtype=np.int16), 600)
    track = straight_track(SPEED, stamp_ns=stamp_ns, clock_epoch=clock_epoch)
    first, second = (
        power_streams({"drive": record(amp=a)}, clock_epoch=e)
        for e, a in ((0, lambda t: 5 + 0 * t), (1, lambda t: 9 + 0 * t))
    )
    both = Streams({"power": pa.concat_tables([first.tables["power"], second.tables["power"]])}, {}, "husky")
    table = label(track, both).table
    assert to_floats(table, "power_watt") == pytest.approx(
        np.where(to_integers(table, "clock_epoch") == 0, 120.0, 216.0)
    )


def test_a_run_without_any_current_has_no_relative_deviation_and_divides_by_nothing():
    """No energy is the share of no energy: a raw RuntimeWarning reached the terminal."""
    labelled = label(straight_track(SPEED), power_streams({"drive": record(amp=lambda t: 0 * t)}))
    told = labelled.info.report.facts.label.relative_std_median
    assert (told["power"], told["energy"]) == (None, None)
    assert told["duration"] > 0.0


USUAL = SimulatedRobot()
ROBOT = replace(
    USUAL,
    ground={name: replace(of, slip=0.0) for name, of in USUAL.ground.items()},
    slope_slip=0.0,
    scrub_half_radius_m=math.inf,
)


@pytest.fixture(scope="module")
def stages(tmp_path_factory):
    """280 m over hills and all classes, without sensor faults, of a robot without slip whose torque is the same on every curve."""
    hills = find_scenario("hills12")
    drive = replace(hills.drives[0], plan=Wander(280.0, (14.0, 34.0), climbing=0.5), faults=Faults(), robot=ROBOT)
    streams = streams_of(log_of(hills, drive, tmp_path_factory.mktemp("hills"), seed=3))
    return run_stages(streams, Recipe().ingest, run_id="run")


def test_the_fit_is_the_robot(stages):
    facts = stages[2].info.report.facts.label.physics
    assert facts.idle_watt == pytest.approx(ROBOT.idle_watt, rel=0.02)
    values = {of.term: of for of in facts.fit.terms}
    assert values["grade"].value == pytest.approx(ROBOT.mass_kg * GRAVITY_MPS2 / ROBOT.drive_efficiency, rel=0.05)
    assert 0.115 < facts.fit.rolling_resistance["all"][0] < 0.22  # of all classes together
    assert facts.fit.recovered_downhill == pytest.approx(
        ROBOT.drive_efficiency * ROBOT.regeneration_efficiency, abs=0.15
    )
    torque = ROBOT.scrub_torque_nm / ROBOT.drive_efficiency
    assert abs(values["turning"].value - torque) < max(0.05 * torque, 2.0 * values["turning"].std)
    assert values["turning"].std < 0.1 * torque
    assert facts.fit.held_out.r2 > 0.9
    assert sum(facts.fit.energy_share.values()) == pytest.approx(1.0, abs=0.03)


def test_ground_that_costs_more_is_not_flagged():
    """A quarter of the way is mud at three times the power of grass: a property of the ground, not of the label."""
    wet = lambda t: np.where(t > 45, 18, 6) + 0.1 * np.sin(40 * t)  # noqa: E731
    labelled = label(straight_track(SPEED), power_streams({"drive": record(amp=wet)}))
    assert (to_floats(labelled.table, "power_watt") > 400).sum() > 10
    quality = labelled.table["quality"].to_numpy() & ~np.uint32(Quality.POWER_MEAN_MISMATCH)  # where the ground changes
    assert (quality == int(Quality.NO_COMMAND)).all()


def seconds(*values):
    return ZERO + np.round(np.array(values) * 1e9).astype(np.int64)


def track_watt(streams, at_ns):
    return make_power_columns(streams, 0, at_ns, max_gap_ns=300_000_000)["power_watt"]


@pytest.mark.parametrize("averaged", [True, False])
def test_the_track_has_the_power_that_the_label_takes_at_a_segments_end(averaged):
    # At 1 Hz 30 W and 300 W in turns: between two samples an interpolated value is up to ten times one held back.
    stamp_ns = seconds(*range(-1, 61)) + 700_000_000
    streams = power_streams(
        {"drive": (stamp_ns, np.full(62, 30.0), np.where(np.arange(62) % 2, 10.0, 1.0))}, averaged=averaged
    )
    masked = mask_track(straight_track(np.full(1200, 0.8)), MaskConfig(), max_velocity_mps=1.0, chord_m=1.0)
    cut = segment_track(masked, SegmentConfig()).table
    rule = "averaged" if averaged else "exact"
    unknown, rails = IdlePower(np.nan, np.nan), make_rails(streams, 0)
    cost, _, causes = compute_segment_costs(
        cut,
        masked.table,
        rails,
        masked.info,
        rule=rule,
        standing=unknown,
        sensor=SensorError(),
        power=PowerSensorFacts(0.0, 0.0),
    )
    label_watt = np.sqrt(causes["position"]) / cost.duration_std_s
    assert cut.num_rows > 40
    assert label_watt == pytest.approx(track_watt(streams, to_integers(cut, "end_ns")))
    assert averaged == (set(np.round(label_watt, 6)) == {30.0, 300.0})
