"""The truth of a drive against physics and against the world it stands on."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tcpipe.errors import UsageError
from tcpipe.simulation import compute_true_cost
from tcpipe.simulation.robot import GRAVITY_MPS2, GroundModel, SimulatedRobot
from tcpipe.simulation.route import Leg, Pause, simulate_drive
from tcpipe.simulation.scenarios import make_small_world
from tcpipe.simulation.world import GRASS, Site, World

DT_S = 0.005


def test_position_stands_on_the_surface_and_agrees_with_pyproj(truth):
    world = make_small_world()
    np.testing.assert_allclose(
        truth.alt_m, world.height_m(truth.x_map_m, truth.y_map_m) + world.site.geoid_m, atol=1e-9
    )
    x, y = world.site.map_xy_m(truth.lon_deg, truth.lat_deg)
    np.testing.assert_allclose(x, truth.x_map_m, atol=1e-6)
    np.testing.assert_allclose(y, truth.y_map_m, atol=1e-6)


def test_velocity_points_forward_and_is_as_fast_as_said(truth):
    forward = Rotation.from_quat(truth.quat_xyzw).apply([1.0, 0.0, 0.0])
    said = truth.forward_velocity_mps[:, None] * forward
    np.testing.assert_allclose(truth.velocity_enu_mps, said, atol=2e-3)
    along = np.sum(truth.velocity_enu_mps * forward, axis=1)
    assert np.sqrt(np.mean((along - truth.forward_velocity_mps) ** 2)) < 1e-4


def test_yaw_is_the_true_course_not_the_grids(truth):
    moving = truth.forward_velocity_mps > 0.3
    yaw = Rotation.from_quat(truth.quat_xyzw).as_euler("ZYX")[:, 0]
    course = np.arctan2(truth.velocity_enu_mps[:, 1], truth.velocity_enu_mps[:, 0])
    off = (yaw - course + np.pi) % (2 * np.pi) - np.pi
    assert np.abs(off[moving]).max() < 2e-3
    grid = np.arctan2(np.gradient(truth.y_map_m), np.gradient(truth.x_map_m))
    from_grid = (grid - course + np.pi) % (2 * np.pi) - np.pi
    assert np.degrees(np.median(from_grid[moving])) == pytest.approx(1.9, abs=0.05)


def test_body_rates_integrate_to_the_attitude(truth):
    part = slice(0, 6000)
    steps = Rotation.from_rotvec(truth.angular_velocity_radps[part] * DT_S)
    pose = Rotation.from_quat(truth.quat_xyzw[0])
    for step in steps:
        pose = pose * step
    left = (pose.inv() * Rotation.from_quat(truth.quat_xyzw[6000])).magnitude()
    assert np.degrees(left) < 0.2


def test_manoeuvres_are_what_they_are_called(truth):
    reversing = truth.forward_velocity_mps < -0.3
    assert reversing.sum() * DT_S > 2.0
    assert (truth.command_velocity_mps[reversing] <= 0).all()
    stuck = (truth.wheel_velocity_mps > 0.5) & (truth.forward_velocity_mps == 0)
    assert stuck.sum() * DT_S == pytest.approx(2.3, abs=0.3)
    turning = (np.abs(truth.angular_velocity_radps[:, 2]) > 0.3) & (np.abs(truth.forward_velocity_mps) < 1e-9)
    assert turning.sum() * DT_S > 5.0
    assert (truth.command_velocity_mps == 0.5).any()


def test_slope_slows_the_robot_and_costs_what_gravity_asks():
    plain = SimulatedRobot(resistance_noise=0.0, ground={GRASS: GroundModel(0.9, 0.0, 0.15)})
    site = Site()
    rise = 0.3
    # 40 km of sine look straight over 30 m: a plane of 30 % along the map's x axis
    flat, tilted = World(site, 600.0), World(site, 600.0, waves=small_tilt(rise))
    powers = {}
    for name, world in (("flat", flat), ("tilted", tilted)):
        truth = simulate_drive(
            world,
            [Pause(1.0), Leg(((70.0, 40.0),))],
            start_m=(40.0, 40.0),
            robot=plain,
            weave_m=0.0,
            rng=np.random.default_rng(0),
        )
        steady = slice(truth.stamp_ns.size // 2, truth.stamp_ns.size // 2 + 400)
        powers[name] = (
            truth.power_watt[steady].mean(),
            truth.forward_velocity_mps[steady].mean(),
            truth.slope_rad[steady].mean(),
        )
    angle = np.arctan(rise)
    assert powers["tilted"][2] == pytest.approx(angle, abs=2e-3)
    weight = plain.mass_kg * GRAVITY_MPS2
    velocity = 0.9 * (1 - plain.uphill_slowdown * np.sin(angle) / np.sin(np.radians(22.5)))
    slip = plain.slope_slip * np.sin(angle) / np.sin(np.radians(22.5))
    wanted = plain.idle_watt + weight * (0.15 * np.cos(angle) + np.sin(angle)) * velocity / plain.drive_efficiency
    assert powers["tilted"][0] == pytest.approx(wanted, rel=2e-3)
    assert powers["tilted"][1] == pytest.approx(velocity * (1 - slip), rel=2e-3)
    assert powers["flat"][0] == pytest.approx(plain.idle_watt + weight * 0.15 * 0.9 / plain.drive_efficiency, rel=1e-3)


def small_tilt(rise):
    from tcpipe.simulation.world import Wave

    wavelength_m = 40000.0
    return (Wave(rise * wavelength_m / (2 * np.pi), wavelength_m, 0.0, 0.0),)


def test_true_cost_against_a_plain_search(truth):
    start = truth.stamp_ns[::97] + 1_234_567
    cost = compute_true_cost(truth, start)
    seconds = (truth.stamp_ns - truth.stamp_ns[0]) * 1e-9
    fine = np.arange(0.0, seconds[-1], 0.0005)
    east, north = (np.interp(fine, seconds, truth.enu_m[:, i]) for i in (0, 1))
    energy = np.interp(fine, seconds, truth.energy_joule)
    checked = 0
    for i in range(0, start.size, 5):
        t0 = (start[i] - truth.stamp_ns[0]) * 1e-9
        x0, y0 = (np.interp(t0, seconds, truth.enu_m[:, k]) for k in (0, 1))
        after = np.flatnonzero((fine > t0) & (np.hypot(east - x0, north - y0) >= 1.0))
        if not after.size:
            assert np.isnan(cost.duration_s[i])
            continue
        checked += 1
        assert cost.duration_s[i] == pytest.approx(fine[after[0]] - t0, abs=6e-4)
        assert cost.energy_joule[i] == pytest.approx(
            energy[after[0]] - np.interp(t0, seconds, truth.energy_joule), abs=0.5
        )
        assert cost.velocity_mps[i] == pytest.approx(1.0 / cost.duration_s[i])
        assert cost.arc_length_m[i] >= 1.0 - 1e-6
    assert checked > 35
    assert np.isnan(compute_true_cost(truth, np.array([truth.stamp_ns[0] - 1, truth.stamp_ns[-1]])).energy_joule).all()


def test_an_empty_plan_is_refused():
    with pytest.raises(UsageError, match="plan is empty"):
        simulate_drive(
            make_small_world(), [], start_m=(14.0, 34.0), robot=SimulatedRobot(), rng=np.random.default_rng(0)
        )
