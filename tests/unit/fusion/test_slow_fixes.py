"""Fixes of a slow receiver alone, from starts at rest and in motion, against the truth of a drive in the plane."""

import numpy as np
import pytest
from unit.fusion.test_error_state import fuse

from tcpipe.fusion.measurements import NO_LEVER_ARM, Measurements, Positions

STD_M, SECONDS, STEP_S = 0.02, 120.0, 0.01


def make_drive(speed_mps, *, starts_moving, seed):
    """Return times [s] and true places [m] of a robot that stops twice, brakes with 0.8 m/s² and drives in curves."""
    rng = np.random.default_rng(seed)
    t = np.arange(0.0, SECONDS, STEP_S)
    wanted = np.where(((t > 40) & (t < 47)) | ((t > 80) & (t < 86)), 0.0, speed_mps)
    wanted[t < 5.0] *= starts_moving
    speed = np.empty(t.size)
    speed[0] = wanted[0]
    for k in range(1, t.size):
        speed[k] = speed[k - 1] + np.clip(wanted[k] - speed[k - 1], -0.8 * STEP_S, 0.8 * STEP_S)
    knots_s = np.arange(0.0, SECONDS + 8.0, 8.0)
    bend = np.interp(t, knots_s, rng.normal(size=knots_s.size)) * 0.1 / speed_mps
    yaw = rng.uniform(-np.pi, np.pi) + np.cumsum(bend * speed) * STEP_S
    return t, np.cumsum(speed[:, None] * np.column_stack((np.cos(yaw), np.sin(yaw), 0.0 * yaw)), axis=0) * STEP_S


@pytest.mark.parametrize(("speed_mps", "starts_moving"), [(1.0, False), (3.0, True), (6.0, True)])
def test_a_track_of_fixes_once_a_second_is_as_accurate_as_it_claims(speed_mps, starts_moving):
    t, true = make_drive(speed_mps, starts_moving=starts_moving, seed=round(speed_mps))
    fix_s = np.arange(0.3, SECONDS - 0.5, 1.0)
    noise = STD_M * np.random.default_rng(5).normal(size=(fix_s.size, 3))
    place = true[np.searchsorted(t, fix_s)] + noise
    stamp_ns = np.rint(fix_s * 1e9).astype(np.int64)
    m = Measurements(Positions(stamp_ns, place, np.full(place.shape, STD_M**2), lever_arm_std_m=NO_LEVER_ARM))
    found = fuse(m)
    rows = np.searchsorted(t, found.stamp_ns * 1e-9 - 1e-9)
    error = (found.position_enu_m - true[rows])[:, :2]
    assert np.mean(np.abs(error) < 2.0 * found.position_std_m[:, :2]) >= 0.94
    length, driven = (
        np.linalg.norm(np.diff(each[:, :2], axis=0), axis=1).sum() for each in (found.position_enu_m, true[rows])
    )
    assert length == pytest.approx(driven, rel=0.02)
    way = np.linalg.norm(true[rows][20:] - true[rows][:-20], axis=1)
    way_error = np.linalg.norm((found.position_enu_m[20:] - found.position_enu_m[:-20])[:, :2], axis=1) - way
    assert np.mean((np.abs(way_error) < 2.0 * found.displacement_std_m[:-20, 1])[way > 0.5]) >= 0.94
