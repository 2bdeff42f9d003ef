"""What is concluded where sensors contradict each other: the cause that was put in, a track as true as without it, or a wide one."""

from dataclasses import replace

import numpy as np
import pytest
from unit.fusion import drive
from unit.fusion.test_error_state import fuse, smoothed, truth

from tcpipe.fusion import state
from tcpipe.fusion.changes import Change, Hypothesis, compute_evidence, is_contradicted, join_events
from tcpipe.fusion.error_state import make_tests
from tcpipe.fusion.filter_kernel import GateVerdict
from tcpipe.fusion.state import Error, Kind


def shift(m, share, offset_m=(1.0, 0.0, 0.0)):
    """Return the measurements with fixes that are off by a ``share`` of ``offset_m`` (3,), a function of the time [s]."""
    t = (m.gnss.stamp_ns - drive.ZERO_NS) * 1e-9
    moved = m.gnss.position_enu_m + share(t)[:, None] * np.array(offset_m)
    return replace(m, gnss=replace(m.gnss, position_enu_m=moved))


def move_antenna(m):
    moved = truth().slerp((m.gnss.stamp_ns - drive.ZERO_NS) * 1e-9).apply([0.3, 0.2, 0.0])
    return shift(m, lambda t: 1.0 * (t > 75.0), moved)


def step_clock(m):
    later = m.gnss.stamp_ns + np.where(m.gnss.stamp_ns > drive.ns(75.0), 300_000_000, 0)
    return replace(m, gnss=replace(m.gnss, stamp_ns=later))


def jump_bias(m, at_s=80.0, change_radps=0.05):
    rate = m.imu.angular_velocity_radps + np.outer(m.imu.stamp_ns > drive.ns(at_s), [0.0, 0.0, change_radps])
    return replace(m, imu=replace(m.imu, angular_velocity_radps=rate))


def find_errors(found):
    """Return times [s], horizontal errors [m] (N, 2), and how many deviations they are."""
    t = (found.stamp_ns - drive.ZERO_NS) * 1e-9
    error = (found.position_enu_m - truth().at(truth().position, t))[:, :2]
    return t, error, np.hypot(*(error / found.position_std_m[:, :2]).T)


def check_track(found, xy_m):
    t, error, off = find_errors(found)
    assert np.sqrt(np.mean(np.sum(error[t > 5.0] ** 2, axis=1))) < xy_m
    assert np.mean(off[t > 5.0] < 2.45) > 0.92


@pytest.mark.parametrize(("start_s", "end_s", "camera"), [(70.0, 80.0, True), (60.0, 100.0, False)])
def test_fixes_that_err_together_move_neither_the_track_nor_what_it_claims(start_s, end_s, camera):
    measurements = drive.measure(truth(), 1, visual=camera)
    found = fuse(shift(measurements, lambda t: 1.0 * ((t > start_s) & (t < end_s)), (0.4, -0.3, 0.2)))
    (change,) = found.facts.changes
    assert (change.kind, change.role) == ("offset", "gnss")
    span_s = [(each - drive.ZERO_NS) * 1e-9 for each in (change.start_ns, change.end_ns)]
    assert span_s == pytest.approx([start_s, end_s], abs=0.3)
    assert change.size == pytest.approx(0.5, abs=0.15)
    check_track(found, 0.03)


def change_wheels(m):
    t = (m.wheels.stamp_ns - drive.ZERO_NS) * 1e-9
    scale = np.where((t > 90.0) & (t < 120.0), 0.75, 1.0)
    return replace(m, wheels=replace(m.wheels, velocity_mps=m.wheels.velocity_mps * scale[:, None]))


def scramble_camera(m):
    t, rng = (m.visual.stamp_ns - drive.ZERO_NS) * 1e-9, np.random.default_rng(5)
    velocity = m.visual.velocity_mps.copy()
    wrong = (t > 80.0) & (t < 110.0)
    velocity[wrong] = rng.normal(0.0, 1.0, velocity[wrong].shape)
    return replace(m, visual=replace(m.visual, velocity_mps=velocity))


@pytest.mark.parametrize(
    ("change", "kind", "role", "at_s"),
    [
        (move_antenna, "antenna", "gnss", 75.0),
        (step_clock, "clock", "gnss", 75.3),
        (jump_bias, "gyroscope", "imu", 80.1),
        (change_wheels, "scale", "wheel_odometry", 90.0),
    ],
    ids=["antenna", "clock", "gyroscope", "wheels"],
)
def test_what_changed_is_named_with_its_time(change, kind, role, at_s):
    found = fuse(change(drive.measure(truth(), 1)))
    (only,) = found.facts.changes
    assert (only.kind, only.role) == (kind, role)
    assert (only.start_ns - drive.ZERO_NS) * 1e-9 == pytest.approx(at_s, abs=0.2)
    check_track(found, 0.03)


def test_a_camera_that_measures_nothing_usable_moves_no_track():
    check_track(fuse(scramble_camera(drive.measure(truth(), 1))), 0.03)


def test_a_camera_whose_scale_varies_is_blamed_and_not_the_fixes_that_it_contradicts():
    m, rng = drive.measure(truth(), 1), np.random.default_rng(3)
    t, slip_s = ((each.stamp_ns - drive.ZERO_NS) * 1e-9 for each in (m.visual, m.wheels))
    scale = np.where((t > 90.0) & (t < 130.0), 1.2, 0.8)  # another kind of ground
    visual = m.visual.velocity_mps * scale[:, None] + rng.normal(0.0, 0.03, m.visual.velocity_mps.shape)
    wheels = m.wheels.velocity_mps * (1.05 + 0.05 * np.sin(slip_s / 8.0))[:, None]
    force = m.imu.specific_force_mps2 + rng.normal(0.0, 1.5, m.imu.specific_force_mps2.shape)  # cannot tell who errs
    found = fuse(
        replace(
            m,
            visual=replace(m.visual, velocity_mps=visual),
            wheels=replace(m.wheels, velocity_mps=wheels),
            imu=replace(m.imu, specific_force_mps2=force, accelerometer_std_mps2=1.5),
        )
    )
    (change,) = found.facts.changes
    assert (change.kind, change.role) == ("scale", "visual_odometry")
    span_s = [(each - drive.ZERO_NS) * 1e-9 for each in (change.start_ns, change.end_ns)]
    assert span_s == pytest.approx([90.0, 130.0], abs=2.0)
    assert drive.errors(truth(), found)["xy"] < 0.05


@pytest.mark.parametrize("change_radps", [0.02, -0.03])
def test_a_jump_that_no_gate_rejects_is_found(change_radps):
    found = fuse(jump_bias(drive.measure(truth(), 1, visual=False), 75.0, change_radps))
    (change,) = found.facts.changes
    assert (change.kind, change.role) == ("gyroscope", "imu")
    assert (change.start_ns - drive.ZERO_NS) * 1e-9 == pytest.approx(75.0, abs=0.5)


def test_a_jump_within_an_outage_bends_no_track():
    found = fuse(jump_bias(drive.measure(truth(), 1, visual=False, gnss_outages=((55.0, 105.0),)), 75.0, 0.03))
    assert [(change.kind, change.role) for change in found.facts.changes] == [("gyroscope", "imu")]
    t, error, off = find_errors(found)
    assert np.hypot(*error.T).max() < 1.5
    assert np.mean(off[(t > 56.0) & (t < 104.0)] < 2.45) > 0.9


def drift_and_jump_back(t):
    return np.interp(t, [50.0, 75.0, 75.01], [0.0, 0.3, 0.0])


@pytest.mark.parametrize("share", [lambda t: 0.3 * (t > 75.0), drift_and_jump_back], ids=["step", "ramp"])
def test_no_side_of_a_step_of_fixes_is_believed(share):
    found = fuse(shift(drive.measure(truth(), 1), share))
    (change,) = found.facts.changes
    assert (change.kind, change.role) == ("step", "gnss")
    assert (change.start_ns - drive.ZERO_NS) * 1e-9 == pytest.approx(75.1, abs=0.3)
    t, _, off = find_errors(found)
    assert np.mean(off < 2.45) > 0.95
    drms_m = np.hypot(*found.position_std_m[:, :2].T)
    assert drms_m[t < 40.0].min() > 0.47 * 0.3
    assert drms_m[t > 120.0].min() > 0.47 * 0.3


def test_of_two_odometries_alone_none_is_said_to_have_changed():
    m = replace(drive.measure(truth(), 3, gnss=False, imu=False), imu=None)
    t = (m.wheels.stamp_ns - drive.ZERO_NS) * 1e-9
    slow = m.wheels.velocity_mps * np.where(t > 90.0, 0.5, 1.0)[:, None]
    assert fuse(replace(m, wheels=replace(m.wheels, velocity_mps=slow))).facts.changes == ()


def test_nothing_happened_in_a_clean_run():
    assert smoothed().facts.changes == ()
    assert smoothed(imu=False).facts.changes == ()


def test_sensors_contradict_each_other_where_one_is_rejected_five_times_in_a_row_for_a_second():
    tests = make_tests(400)
    tests.verdict[::2, Kind.FIX] = GateVerdict.ACCEPTED
    tests.verdict[200:216:2, Kind.FIX] = GateVerdict.REJECTED
    assert not is_contradicted(tests, 0.05)
    tests.verdict[100:140:2, Kind.FIX] = GateVerdict.REJECTED
    assert is_contradicted(tests, 0.05)


def make_offset(first, east_m):
    return Change("offset", Kind.FIX, first, impulse=(east_m, 0.0, 0.0))


def test_an_offset_that_returns_is_a_span_and_one_that_stays_is_a_step():
    (span,) = join_events([make_offset(900, -0.45), make_offset(500, 0.3), make_offset(505, 0.2)])
    assert (span.kind, span.first, span.last) == ("offset", 500, 900)
    steps = join_events([make_offset(500, 0.5), make_offset(900, 0.4)])
    assert [(each.kind, each.first, each.last) for each in steps] == [("step", 500, None), ("step", 900, None)]


def test_evidence_counts_what_is_beyond_the_gate_as_the_gate():
    tests = make_tests(3)
    tests.nis[:, Kind.FIX], tests.log_det[:, Kind.FIX] = [1.0, 100.0, 2.0], [-1.0, -2.0, -3.0]
    gates = np.full(state.KINDS, np.inf)
    gates[Kind.FIX] = 16.0
    assert compute_evidence(tests, gates) == pytest.approx(-0.5 * (1.0 + 16.0 + 2.0 - 6.0))


def test_events_are_in_order_of_time():
    scale = Change("scale", Kind.WHEELS, 50, 90, impulse=(0.3,), impulse_std=(0.01,))
    best = Hypothesis((scale, Change("clock", Kind.FIX, 20, impulse=(0.2,), impulse_std=(0.01,))))
    assert [(event.tick, event.place) for event in best.events] == [
        (20, Error.FIX_LAG),
        (50, Error.WHEEL_SCALE),
        (90, Error.WHEEL_SCALE),
    ]
    assert [(event.mean, event.std) for event in best.events][1:] == [(0.3, 0.03), (-0.3, 0.03)]


def test_an_antenna_that_is_not_where_it_is_stated_makes_no_place_too_sure():
    m = drive.measure(truth(), 1)
    found = fuse(replace(m, gnss=replace(m.gnss, lever_arm_m=(0.12, -0.08, 0.55 - 0.65))))
    assert found.facts.parameters["antenna"].value[2] == pytest.approx(0.65, abs=0.1)
    check_track(found, 0.03)
