"""From pairs to one clock: who is late is settled by least squares and by the majority; worked out by hand."""

import pytest

from tcpipe.fusion.clock_offsets import Pair, _settled


def pair(late, against, offset_s, std_s=0.002, explained=0.9):
    return Pair(late, against, "speed", offset_s, std_s, explained)


def test_the_one_that_differs_is_the_one_that_is_late():
    found = _settled((pair("gnss", "wheel_odometry", 0.25), pair("wheel_odometry", "imu", 0.001)))
    assert found.reference == "imu"
    assert found.offsets["gnss"].offset_s == pytest.approx(0.251)
    assert {role: offset.noted for role, offset in found.offsets.items()} == {"wheel_odometry": False, "gnss": True}


def test_the_majority_rules_over_the_order():
    pairs = pair("wheel_odometry", "imu", 0.1), pair("visual_odometry", "imu", 0.1), pair("gnss", "wheel_odometry", 0.0)
    found = _settled(pairs)
    assert found.reference == "wheel_odometry"
    assert {role for role, offset in found.offsets.items() if offset.noted} == {"imu"}
    assert found.offsets["imu"].offset_s == pytest.approx(-0.1)


def test_a_doubtful_clock_is_no_reference():
    """Against power, known to 0.035 s, nobody is surely off; against the wheels the IMU is."""
    pairs = (
        pair("wheel_odometry", "imu", 0.1),
        pair("visual_odometry", "imu", 0.1),
        pair("power", "wheel_odometry", -0.02, 0.035),
    )
    found = _settled(pairs)
    assert found.reference == "wheel_odometry"
    assert {role for role, offset in found.offsets.items() if offset.noted} == {"imu"}


def test_pairs_in_a_ring_are_weighed_by_their_variances():
    """0.10 ± 0.01 directly, 0.14 ± 0.01·√2 round the third: weights 2 : 1 give 0.1133 ± 0.01·√(2/3)."""
    ring = (
        pair("visual_odometry", "imu", 0.10, 0.01),
        pair("wheel_odometry", "imu", 0.04, 0.01),
        pair("visual_odometry", "wheel_odometry", 0.10, 0.01),
    )
    offset = _settled(ring).offsets["visual_odometry"]
    assert offset.offset_s == pytest.approx(0.34 / 3)
    assert offset.std_s == pytest.approx(0.01 * (2 / 3) ** 0.5)


@pytest.mark.parametrize(
    ("offset_s", "std_s", "explained", "determined"),
    [
        (0.0, 0.019, 0.9, True),
        (0.0, 0.03, 0.9, False),
        (0.3, 0.05, 0.9, True),
        (0.3, 0.07, 0.9, False),
        (0.3, 0.01, 0.2, False),
    ],
)
def test_what_is_not_known_well_is_not_spoken_of(offset_s, std_s, explained, determined):
    found = _settled((pair("gnss", "wheel_odometry", offset_s, std_s, explained),))
    assert found.pairs[0].determined == determined
    assert bool(found.offsets) == determined


def test_small_offsets_are_not_noted_and_power_may_be_off_by_more():
    pairs = pair("gnss", "wheel_odometry", 0.045), pair("power", "wheel_odometry", 0.075)
    assert not any(offset.noted for offset in _settled(pairs).offsets.values())
    pairs = pair("gnss", "wheel_odometry", -0.055), pair("power", "wheel_odometry", 0.085)
    assert all(_settled(pairs).offsets[role].noted for role in ("gnss", "power"))
