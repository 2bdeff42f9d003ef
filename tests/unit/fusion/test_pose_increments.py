"""Velocities and rates from poses: drives written down by formula."""

import numpy as np
import pytest

from tcpipe.fusion.preparation import (
    compute_orientation_rates,
    prepare_body_velocities,
)
from tcpipe.geometry.rotation import quat_from_rpy

SPEED, RATE = 1.5, 0.3
T = np.arange(0.0, 60.0, 0.1)
STAMP_NS = (T * 1e9).astype(np.int64)


def circle(rate=RATE, start_rad=0.4):
    """A robot that only drives forward: yaw, places, and velocities along the axes of the pose's frame."""
    yaw = start_rad + rate * T
    along = SPEED * np.column_stack((np.cos(yaw), np.sin(yaw), np.zeros(T.size)))
    if not rate:
        return yaw, along * T[:, None], along
    radius = SPEED / rate
    place = radius * np.column_stack((np.sin(yaw), -np.cos(yaw), np.zeros(T.size)))
    return yaw, place, along


def quats(yaw):
    return quat_from_rpy(np.zeros(T.size), np.zeros(T.size), yaw)


@pytest.mark.parametrize("silent", [0.0, np.nan])
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_rate_that_is_zero_or_missing_throughout_is_that_of_the_orientation_that_turns(axis, silent):
    angle = 0.4 * np.sin(0.5 * T)
    rpy = np.zeros((3, T.size))
    rpy[axis] = angle
    rate = np.full((T.size, 3), 0.01)
    rate[:, axis] = silent
    found, turns = compute_orientation_rates(STAMP_NS, rate, quat_from_rpy(*rpy))
    assert turns.tolist() == [k == axis for k in range(3)]
    assert found[1:-1, axis] == pytest.approx(0.2 * np.cos(0.5 * T)[1:-1], abs=1e-3)
    assert np.isnan(found[[0, -1], axis]).all()
    assert (np.delete(found, axis, axis=1) == 0.01).all()


def test_a_rate_that_is_measured_stays_and_so_does_one_beside_an_orientation_that_does_not_turn():
    yaw, _, _ = circle()
    measured = np.zeros((T.size, 3))
    measured[7, 2] = 1e-3
    found, turns = compute_orientation_rates(STAMP_NS, measured, quats(yaw))
    assert found is measured or (found == measured).all()
    assert not turns.any()
    for quat in (quats(0.0 * yaw), np.full((T.size, 4), np.nan)):
        found, turns = compute_orientation_rates(STAMP_NS, np.zeros((T.size, 3)), quat)
        assert not found.any()
        assert not turns.any()


def twists(columns):
    given = {"xyz_m": (0.0, 0.0, 0.0), "quat_xyzw": (0.0, 0.0, 0.0, 1.0), "default_std_mps": 0.05}
    return prepare_body_velocities(STAMP_NS, columns, **given, only_forward=True)


def odometry(velocity_x, yaw, rate_z):
    """Columns of an odometry that tells no pose but its orientation."""
    nothing = np.full(T.size, np.nan)
    columns = {f"{a}_m": 0.0 * T for a in "xyz"} | {f"velocity_{a}_mps": nothing for a in "yz"}
    columns |= {f"angular_velocity_{a}_radps": nothing for a in "xy"} | {
        f"velocity_var_{a}_m2ps2": nothing for a in "xyz"
    }
    columns |= dict(zip((f"quat_{c}" for c in "xyzw"), quats(yaw).T, strict=True))
    return columns | {"velocity_x_mps": velocity_x, "angular_velocity_z_radps": rate_z, "yaw_rate_var": nothing}


def test_an_odometry_without_a_turn_rate_turns_with_its_orientation():
    yaw, _, _ = circle()
    made, prepared = twists(odometry(np.full(T.size, SPEED), yaw, np.full(T.size, np.nan)))
    assert made.yaw_rate_radps[1:-1] == pytest.approx(RATE)
    (finding,) = prepared.findings
    assert (finding.code, finding.names) == ("rate-from-orientation", {"axes": "z"})


def test_a_twist_that_tells_no_forward_velocity_is_none_where_the_poses_move():
    yaw, place, _ = circle()
    columns = odometry(np.full(T.size, np.nan), yaw, np.full(T.size, RATE))
    columns |= {"velocity_y_mps": np.full(T.size, 0.01), **{f"{a}_m": place[:, k] for k, a in enumerate("xyz")}}
    made, prepared = twists(columns)
    assert made.velocity_mps[:, 0] == pytest.approx(SPEED, rel=1e-3)
    assert [(of.code, of.subject.name) for of in prepared.findings] == [("pose-increments", "wheel_odometry")]
