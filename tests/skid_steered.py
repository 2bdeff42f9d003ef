"""A skid-steered robot whose power is computed from force times speed and torque times rate."""

import numpy as np

from tcpipe.cost.physics import FitSamples

NEWTON, RECOVERED, STANDING_WATT = 953.4, 0.40, 14.0
RESISTANCE = {"grass": 0.17, "paved": 0.115}
TURNING = {"grass": 264.0, "paved": 180.0}  # W per rad/s


def made(
    seed=0,
    count=400,
    *,
    noise_watt=0.0,
    steepest=0.35,
    classes=("grass", "paved"),
    speeds=(0.6, 1.0),
    drivetrain_newton=0.0,
    steeper=0.0,
):
    """Power of metres driven over slopes and round bends, computed from force times speed and torque times rate."""
    rng = np.random.default_rng(seed)
    terrain = np.array(classes)[np.arange(count) // 25 % len(classes)]
    angle, speed = np.arctan(rng.uniform(-steepest, steepest, count) + steeper), rng.uniform(*speeds, count)
    rate = np.abs(rng.normal(0.0, 0.2, count))
    rolling, turning = (np.array([of[name] for name in terrain]) for of in (RESISTANCE, TURNING))
    work = NEWTON * (rolling * np.cos(angle) + np.sin(angle)) * speed / np.cos(angle) + turning * rate
    always = STANDING_WATT + drivetrain_newton * speed / np.cos(angle)
    power = always + np.where(work > 0, work, RECOVERED * work) + noise_watt * rng.standard_normal(count)
    return FitSamples(power, speed, np.tan(angle), rate, terrain)
