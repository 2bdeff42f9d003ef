"""What a section measures, tick by tick."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from unit.fusion import drive

from tcpipe.fusion.measurements import (
    WHEELS,
    BodyVelocities,
    InertialMeasurements,
    Measurements,
    Positions,
    cut_sections,
    make_track_stamps,
)
from tcpipe.fusion.state import Kind, Mode
from tcpipe.fusion.ticks import build_ticks, find_tick_period_ns

NOWHERE = np.empty((0, 2), np.int64)
TICK_NS = 50_000_000


def ticks_of(m, start_ns, end_ns, stationary_ns=NOWHERE, period_ns=TICK_NS):
    output_ns = np.arange(-(-start_ns // period_ns) * period_ns, end_ns + 1, period_ns, dtype=np.int64)
    return build_ticks(m, drive.estimate_noise(m), stationary_ns, start_ns, end_ns, output_ns=output_ns)


def ramp_imu(stamp_ns):
    """Angular velocity that grows by 1 rad/s each second, force that is constant."""
    t = (stamp_ns - stamp_ns[0]) * 1e-9
    force = np.tile([0.0, 0.0, 9.8], (t.size, 1))
    return InertialMeasurements(
        stamp_ns, np.column_stack((0 * t, 0 * t, t)), force, np.full((t.size, 4), np.nan), 0.003, 0.1
    )


def fixes(stamp_ns):
    return Positions(stamp_ns, np.zeros((stamp_ns.size, 3)), np.ones((stamp_ns.size, 3)))


def test_a_section_of_one_instant_has_one_tick():
    at_ns = 2 * TICK_NS
    assert ticks_of(Measurements(gnss=fixes(np.array([at_ns]))), at_ns, at_ns).stamp_ns.tolist() == [at_ns]


@pytest.mark.parametrize(
    ("period_ns", "tick_ns"), [(10**7, 10**7), (5 * 10**7, 5 * 10**7), (12 * 10**7, 4 * 10**7), (10**9, 5 * 10**7)]
)
def test_a_tick_is_a_whole_part_of_the_tracks_period(period_ns, tick_ns):
    assert find_tick_period_ns(period_ns) == tick_ns
    found = ticks_of(drive.measure(drive.make_drive(20.0), 2), int(drive.ns(0.3)), int(drive.ns(19.0)), period_ns=period_ns)  # fmt: skip
    assert (np.diff(found.stamp_ns) == tick_ns).all()
    wanted = np.arange(int(drive.ns(1.0)), int(drive.ns(19.0)), period_ns)
    assert np.isin(wanted, found.stamp_ns).all()
    assert found.stamp_ns[0] <= drive.ns(0.3)
    assert found.stamp_ns[-1] >= drive.ns(19.0)


def test_each_tick_holds_the_mean_of_what_a_sensor_measures_around_it():
    m = drive.measure(drive.make_drive(20.0), 2)
    found = ticks_of(m, int(m.gnss.stamp_ns[0]), int(m.gnss.stamp_ns[-1]))
    noise = drive.estimate_noise(m)
    white = np.array([fix.white / fix.claimed_m2 for fix in (noise.horizontal, noise.horizontal, noise.vertical)])
    for kind, stamp_ns, values in (
        (Kind.WHEELS, m.wheels.stamp_ns, m.wheels.velocity_mps[:, :1]),
        (Kind.VISUAL, m.visual.stamp_ns, m.visual.velocity_mps),
        (Kind.FIX, m.gnss.stamp_ns, m.gnss.position_enu_m),
    ):
        width = values.shape[1]
        told = np.flatnonzero(np.isfinite(found.inputs.value[:, kind, 0]))
        for k in told[:: max(1, told.size // 40)]:
            near = np.abs(stamp_ns - found.stamp_ns[k]) <= TICK_NS // 2
            assert found.inputs.value[k, kind, :width] == pytest.approx(values[near].mean(0), abs=1e-12)
            late_s = (stamp_ns[near] - found.stamp_ns[k]).mean() * 1e-9
            assert found.inputs.tau[k, kind] == pytest.approx(late_s, abs=1e-12)
            assert (found.rows[kind][near] == k).all()
            if kind == Kind.FIX:
                assert found.inputs.variance[k, kind] == pytest.approx(m.gnss.variance_m2[0] * white / near.sum())
        assert set(told) == set(found.rows[kind][found.rows[kind] >= 0])
    assert np.isnan(found.inputs.value[:, [Kind.LEVEL, Kind.DOPPLER, Kind.STATIONARY]]).all()


@pytest.mark.parametrize("hz", [1.0, 100.0])
def test_a_sensor_of_any_rate_carries_the_information_that_it_claims(hz):
    m = drive.measure(drive.make_drive(30.0), 2)
    stamp_ns = drive.ns(np.arange(0.2, 29.0, 1.0 / hz))
    slow = Measurements(gnss=fixes(stamp_ns), imu=m.imu, wheels=m.wheels)
    found = ticks_of(slow, int(drive.ns(0.1)), int(drive.ns(29.5)))
    told = np.isfinite(found.inputs.value[:, Kind.FIX, 0])
    assert told.sum() == pytest.approx(min(hz, 20.0) * 28.8, rel=0.02)
    noise = drive.estimate_noise(slow)
    white_m2 = noise.horizontal.white / noise.horizontal.claimed_m2
    assert np.sum(1.0 / found.inputs.variance[told, Kind.FIX, 0]) == pytest.approx(stamp_ns.size / white_m2, rel=0.02)


@pytest.mark.parametrize("hz", [4.0, 20.0, 100.0])
def test_wheels_of_any_rate_carry_the_information_of_their_noise_density(hz):
    m = drive.measure(drive.make_drive(20.0), 2)
    stamp_ns, density = drive.ns(np.arange(0.2, 19.0, 1.0 / hz)), 2e-3  # m²/s
    steady = np.column_stack((np.ones(stamp_ns.size), np.full((stamp_ns.size, 2), np.nan)))
    source = BodyVelocities(stamp_ns, steady, 1e-6 * steady, steady[:, 1])
    fitted = drive.estimate_noise(m)
    odometry = replace(fitted.odometries[WHEELS], white=density)
    noise = replace(fitted, odometries={**fitted.odometries, WHEELS: odometry})
    output_ns = np.arange(int(drive.ns(0.1)) // TICK_NS, int(drive.ns(19.5)) // TICK_NS) * TICK_NS
    found = build_ticks(
        replace(m, wheels=source), noise, NOWHERE, int(output_ns[0]), int(output_ns[-1]), output_ns=output_ns
    )
    used = np.isfinite(found.inputs.value[:, Kind.WHEELS, 0])
    per_second = np.sum(1.0 / found.inputs.variance[used, Kind.WHEELS, 0]) / (stamp_ns.size / hz)
    assert per_second == pytest.approx(1.0 / density, rel=1e-3)


def integrate_finely(imu, start_s, end_s, steps=20_000):
    """Return rotation, velocity and displacement over a span, of samples that are linear in between."""
    t = (imu.stamp_ns - drive.ZERO_NS) * 1e-9
    edges = np.linspace(start_s, end_s, steps + 1)
    middle, h = 0.5 * (edges[1:] + edges[:-1]), (end_s - start_s) / steps
    rate = np.stack([np.interp(middle, t, axis) for axis in imu.angular_velocity_radps.T], -1)
    force = np.stack([np.interp(middle, t, axis) for axis in imu.specific_force_mps2.T], -1)
    turn, velocity, moved = Rotation.identity(), np.zeros(3), np.zeros(3)
    for w, f in zip(rate, force, strict=True):
        a = (turn * Rotation.from_rotvec(0.5 * h * w)).apply(f)
        moved, velocity = moved + h * velocity + 0.5 * h**2 * a, velocity + h * a
        turn = turn * Rotation.from_rotvec(h * w)
    return turn, velocity, moved


@pytest.mark.parametrize(("hz", "turn_rad", "moved_m"), [(200.0, 1e-5, 1e-5), (20.0, 2e-3, 1e-3)])
def test_preintegration_is_a_fine_integration(hz, turn_rad, moved_m):
    rng = np.random.default_rng(5)
    t = np.arange(0.003, 2.0, 1.0 / hz) + rng.uniform(-0.2, 0.2, int(np.ceil((2.0 - 0.003) * hz))) / hz
    rate = np.stack([np.sin(9 * t), np.cos(7 * t), 2.0 + np.sin(5 * t)], -1)
    force = np.stack([3 * np.sin(4 * t), 2 * np.cos(6 * t), 9.8 + np.sin(8 * t)], -1)
    imu = InertialMeasurements(drive.ns(t), rate, force, np.full((t.size, 4), np.nan), 0.003, 0.1)
    m = Measurements(gnss=fixes(drive.ns(np.arange(0.1, 1.9, 0.1))), imu=imu)
    found = ticks_of(m, int(drive.ns(0.2)), int(drive.ns(1.8)))
    for k in (5, 12, 30):
        end_s = (found.stamp_ns[k] - drive.ZERO_NS) * 1e-9
        turn, velocity, moved = integrate_finely(imu, end_s - 0.05, end_s, 2_000)
        assert found.inputs.mode[k] == Mode.INERTIAL
        off = (turn.inv() * Rotation.from_matrix(found.inputs.turned[k].reshape(3, 3))).magnitude()
        assert off < turn_rad
        assert found.inputs.gained[k, :3] == pytest.approx(velocity, abs=20 * moved_m)
        assert found.inputs.gained[k, 3:] == pytest.approx(moved, abs=moved_m)


def test_a_gap_of_the_imu_changes_the_motion_there_only():
    stamp = np.arange(0, 3_000_000_000, 10_000_000, dtype=np.int64)
    holed = stamp[(stamp <= 1_000_000_000) | (stamp >= 1_500_000_000)]
    found = ticks_of(Measurements(gnss=fixes(stamp[::10]), imu=ramp_imu(holed)), 100_000_000, 2_900_000_000)
    hole = (found.stamp_ns > 1_000_000_000) & (found.stamp_ns - TICK_NS < 1_500_000_000)
    assert (found.inputs.mode[hole] == Mode.FLAT_TURN).all()
    assert (found.inputs.mode[1:][~hole[1:]] == Mode.INERTIAL).all()
    assert not found.inputs.has_gyro[hole][1:-1].any()
    assert found.inputs.has_gyro[(found.stamp_ns < 950_000_000) | (found.stamp_ns > 1_550_000_000)][1:].all()
    # The rate at a tick is the mean around it: of a ramp, its value.
    inside = (found.stamp_ns > 200_000_000) & (found.stamp_ns < 900_000_000)
    assert found.inputs.rate[inside, 2] == pytest.approx(found.stamp_ns[inside] * 1e-9, abs=1e-9)


def test_the_constraint_carries_the_same_information_at_any_length_of_ticks():
    m = drive.measure(drive.make_drive(20.0), 6)
    start_ns, end_ns = int(drive.ns(1.0)), int(drive.ns(19.0))
    for period_ns in (50_000_000, 20_000_000):
        found = ticks_of(m, start_ns, end_ns, period_ns=period_ns)
        told = np.sum(1.0 / found.inputs.variance[:, Kind.SIDEWAYS, 0]) / 18.0
        assert told == pytest.approx(62.5 / m.nonholonomic_std_mps**2, rel=0.02)


def test_a_stop_measures_velocity_and_bias_five_times_a_second():
    stamp = np.arange(0, 3_000_000_000, 10_000_000, dtype=np.int64)
    m = Measurements(gnss=fixes(stamp[::10]), imu=ramp_imu(stamp))
    found = ticks_of(m, 100_000_000, 2_900_000_000, np.array([[1_000_000_000, 2_000_000_000]], np.int64))
    stopped = np.flatnonzero(np.isfinite(found.inputs.value[:, Kind.STATIONARY, 0]))
    assert stopped.size == 5
    assert (found.inputs.value[stopped, Kind.STATIONARY] == 0.0).all()
    stamp_s = found.stamp_ns[stopped] * 1e-9
    assert (stamp_s >= 1.0).all()
    assert (stamp_s < 2.0).all()
    assert found.inputs.value[stopped, Kind.STATIONARY_RATE, 2] == pytest.approx(stamp_s, abs=1e-9)


def test_without_an_accelerometer_the_robot_is_about_level_and_the_odometry_turns_it():
    truth = drive.make_drive(20.0)
    found = ticks_of(drive.measure(truth, 6, imu=False), int(drive.ns(1.0)), int(drive.ns(19.0)))
    level = np.isfinite(found.inputs.value[:, Kind.LEVEL, 0])
    assert level.sum() == pytest.approx(19, abs=1)
    t = (found.stamp_ns - drive.ZERO_NS) * 1e-9
    true = 0.8 * np.interp(t, truth.t, truth.rate[:, 2])  # these wheels turn less than they say
    assert np.sqrt(np.mean((found.inputs.rate[:, 2] - true) ** 2)) < 0.03
    assert (found.inputs.mode < Mode.GYRO_TURN).all()


def test_an_outage_leaves_ticks_without_fixes_and_a_claim_that_grows_adds_to_their_error():
    m = drive.measure(drive.make_drive(60.0), 6, gnss_outages=((20.0, 40.0),))
    worse = np.where((m.gnss.stamp_ns > drive.ns(50.0))[:, None], 9.0, 1.0) * m.gnss.variance_m2
    found = ticks_of(replace(m, gnss=replace(m.gnss, variance_m2=worse)), int(drive.ns(1.0)), int(drive.ns(58.0)))
    t = (found.stamp_ns - drive.ZERO_NS) * 1e-9
    assert np.isnan(found.inputs.value[(t > 20.1) & (t < 39.9), Kind.FIX]).all()
    # By the recursion alone the correlated error has the variance that fixes claim there, in the outage as well.
    variance = found.fix_variance_m2[0].copy()
    for k in range(1, t.size):
        variance = found.inputs.fix_kept[k] ** 2 * variance + found.inputs.fix_noise[k]
        assert variance == pytest.approx(found.fix_variance_m2[k], rel=1e-9)
    ratio = found.fix_variance_m2[t > 52.0].mean(0) / found.fix_variance_m2[t < 48.0].mean(0)
    assert ratio == pytest.approx([9.0] * 3, rel=1e-6)


S = 1_000_000_000


def wheels(stamp):
    three = np.zeros((stamp.size, 3))
    return BodyVelocities(stamp, three, three + 1, three[:, 0])


def imu(stamp):
    three = np.zeros((stamp.size, 3))
    return InertialMeasurements(stamp, three, three, np.zeros((stamp.size, 4)), 0.003, 0.1)


def grid(a, b, step):
    return np.arange(a, b, step, dtype=np.int64)


def test_epochs_and_long_pauses_cut():
    first = Measurements(wheels=wheels(np.concatenate((grid(0, 10 * S, S // 10), grid(100 * S, 110 * S, S // 10)))))
    # The clock was set back: stamps of the second epoch overlap those of the first.
    second = Measurements(wheels=wheels(grid(5 * S, 9 * S, S // 10)), gnss=fixes(np.array([6 * S])))
    found = cut_sections({1: second, 0: first})
    assert [(s.clock_epoch, s.start_ns // S, -(-s.end_ns // S)) for s in found] == [
        (0, 0, 10),
        (0, 100, 110),
        (1, 5, 9),
    ]
    assert found[0].measurements.wheels.stamp_ns.size == 100
    assert found[0].measurements.gnss is None
    assert found[2].measurements.gnss.stamp_ns.size == 1


def test_a_cut_divides_a_section_before_its_stamp():
    stamps = np.concatenate((grid(0, 10 * S, S // 10), grid(13 * S, 20 * S, S // 10)))
    found = cut_sections({0: Measurements(wheels=wheels(stamps))}, [13 * S])
    assert [(s.start_ns, s.end_ns) for s in found] == [(0, stamps[99]), (13 * S, stamps[-1])]


def test_the_imu_bridges_a_pause_but_is_no_motion_by_itself():
    stamps = np.concatenate((grid(0, 10 * S, S // 10), grid(20 * S, 30 * S, S // 10)))
    bridged = Measurements(wheels=wheels(stamps), imu=imu(grid(0, 40 * S, S // 100)))
    found = cut_sections({0: bridged})
    assert len(found) == 1
    assert found[0].end_ns == stamps[-1]
    assert cut_sections({0: Measurements(imu=imu(grid(0, 9 * S, S // 100)))}) == []


def test_stamps_are_multiples_of_the_period_and_gaps_are_left_out():
    zero = 1_700_000_000 * S
    stamps = zero + 17_000_000 + np.concatenate((grid(0, 2 * S, S // 50), grid(4 * S, 5 * S, S // 50)))
    (section,) = cut_sections({0: Measurements(wheels=wheels(stamps))})
    found = make_track_stamps(section, period_ns=50_000_000, max_gap_ns=S)
    assert (found % 50_000_000 == 0).all()
    assert found[0] == zero + 50_000_000
    assert found[-1] <= stamps[-1]
    step = np.diff(found)
    assert np.unique(step).tolist() == [50_000_000, 2_100_000_000]
    # A gap no longer than allowed stays.
    assert (np.diff(make_track_stamps(section, period_ns=50_000_000, max_gap_ns=3 * S)) == 50_000_000).all()


def test_a_slow_sensor_has_no_gaps_of_its_own_making():
    (section,) = cut_sections({0: Measurements(gnss=fixes(grid(0, 60 * S, 2 * S)), imu=imu(grid(0, 60 * S, S // 50)))})
    assert (np.diff(make_track_stamps(section, period_ns=50_000_000, max_gap_ns=S)) == 50_000_000).all()
