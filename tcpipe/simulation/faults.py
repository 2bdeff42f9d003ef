"""Faults of the simulated sensors; each is switched on alone, and `sensors` states its size.

Switching one changes nothing of another: every noise has a random stream of its own.
"""

from __future__ import annotations

from dataclasses import dataclass, fields


@dataclass(frozen=True, slots=True)
class Faults:
    """Switches; all off is a perfect sensor set at base_link."""

    gnss_noise: bool = False  # position noise, most of it correlated in time
    gnss_lever_arm: bool = False  # the antenna is not at base_link
    gnss_outliers: bool = False  # multipath: some fixes are metres off, with the same covariance
    gnss_outage: bool = False  # no fix for ten seconds (half of it said with status -1, half in silence)
    gnss_stamp_jitter: bool = False  # the stamp is not quite the time of measurement
    wheel_noise: bool = False  # white noise of speed and yaw rate
    wheel_scale: bool = False  # a wrong wheel radius, and a yaw rate that a skid-steered robot overstates
    wheel_slip: bool = False  # the wheels run faster than the ground passes
    imu_noise: bool = False  # white noise of gyroscope and accelerometer
    imu_bias: bool = False  # constant biases that wander
    imu_vibration: bool = False  # shaking while driving
    imu_mounting: bool = False  # the unit is turned, and not at base_link
    imu_yaw_offset: bool = False  # its orientation, where it gives one, has a magnetic yaw error
    visual_noise: bool = False  # white noise of the velocity
    visual_scale: bool = False  # a wrong scale
    visual_outliers: bool = False  # single frames that are far off
    visual_dropouts: bool = False  # stretches without visual odometry
    power_noise: bool = False  # white noise and quantisation of voltage and currents
    power_gap: bool = False  # a stretch without power messages
    command_jitter: bool = False  # a joystick that is never still
    transport_delay: bool = False  # messages reach the recorder late, each by another time
    duplicates: bool = False  # some messages are recorded twice
    clock_step: bool = False  # in the middle all header stamps jump ahead for good, while the recorder's clock runs on
    gnss_clock_offset: bool = False  # the receiver's header stamps are late by a constant
    wheel_clock_offset: bool = False  # the wheels' header stamps are late by a constant
    imu_clock_offset: bool = False  # the inertial unit's header stamps are late by a constant
    visual_clock_offset: bool = False  # the camera's header stamps are late by a constant
    power_clock_offset: bool = False  # the header stamps of voltage and currents are late by a constant

    @classmethod
    def every(cls) -> Faults:
        """Return all of them switched on but those of the clocks, after which stamps are not the truth's any more."""
        return cls(**{field.name: "clock" not in field.name for field in fields(cls)})

    @classmethod
    def only(cls, *names: str) -> Faults:
        """Return those named switched on, all others off."""
        return cls(**dict.fromkeys(names, True))
