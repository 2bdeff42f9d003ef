"""How far the error of each sensor changes over a time difference, by the noise fitted to a run and by its covariances."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from tcpipe.fusion.densities import GaussMarkov, NoiseModel
from tcpipe.fusion.measurements import GNSS, IMU, Measurements
from tcpipe.fusion.pair_residuals import TIMES_S
from tcpipe.fusion.signals import compute_median_period_ns
from tcpipe.tables.facts import NoiseFacts

Floats = NDArray[np.float64]
_Parts = Sequence[tuple[Floats, float]]
"""Variances over `TIMES_S`, and the share of each that the data determine."""

_TIME_S = np.array(TIMES_S)
_DRIVING_MPS = 0.1


def describe_noise(m: Measurements, noise: NoiseModel) -> Mapping[str, NoiseFacts]:
    """Return the noise of each sensor of a section by name: fixes along an axis, distances of odometries, turns."""
    return dict([*_describe_fixes(m, noise), *_describe_distances(m, noise), *_describe_turns(m, noise)])


def _describe_fixes(m: Measurements, noise: NoiseModel) -> Iterator[tuple[str, NoiseFacts]]:
    for name, fixes in ((GNSS, noise.horizontal), (f"{GNSS} height", noise.vertical)):
        if m.gnss is not None and fixes is not None:
            one = np.ones(_TIME_S.size)
            fitted = [
                (2.0 * fixes.white_m2 * one, fixes.white_told),
                (fixes.correlated.difference_variance(_TIME_S), fixes.correlated.told),
            ]
            yield name, _make_facts("m", fitted, 2.0 * fixes.claimed_m2 * one)


def _describe_distances(m: Measurements, noise: NoiseModel) -> Iterator[tuple[str, NoiseFacts]]:
    for role, odometry in m.odometries().items():
        speed_mps = np.abs(odometry.velocity_mps[:, 0])
        driving = speed_mps > _DRIVING_MPS
        usual_mps = float(np.median(speed_mps[driving])) if driving.any() else 0.0
        own = noise.odometries[role]
        scales = [(usual_mps**2 * _integrate(each), each.told) for each in (own.scale, noise.shared_scale)]
        fitted = [(own.velocity_m2ps * _TIME_S, own.velocity_told), *scales]
        yield role, _make_facts("m", fitted, _sum_white(odometry.stamp_ns, odometry.variance_m2ps2[:, 0]))


def _describe_turns(m: Measurements, noise: NoiseModel) -> Iterator[tuple[str, NoiseFacts]]:
    """Yield the noise of turn rates without that of their scales, which a straight drive does not feel."""
    for role, turns in noise.turns.items():
        if role == IMU and m.imu is not None:
            claimed = _sum_white(m.imu.stamp_ns, np.array([m.imu.gyro_std_radps**2]))
        else:
            odometry = m.odometries()[role]
            claimed = _sum_white(odometry.stamp_ns, odometry.yaw_rate_var)
        fitted = [(turns.white_rad2ps * _TIME_S, turns.white_told), (_integrate(turns.bias), turns.bias.told)]
        yield f"{role} turn", _make_facts("rad", fitted, claimed)


def _integrate(process: GaussMarkov) -> Floats:
    """Return the variance of the integral of a process over each time difference."""
    times = _TIME_S / process.time_s
    return np.asarray(2.0 * process.variance * process.time_s**2 * (times + np.expm1(-times)))


def _sum_white(stamp_ns: NDArray[np.int64], variance: Floats) -> Floats:
    """Return the variance of the integral of a rate whose samples err independently of each other by a variance."""
    return np.asarray(np.nanmedian(variance) * compute_median_period_ns(stamp_ns) * 1e-9 * _TIME_S)


def _make_facts(unit: str, fitted: _Parts, claimed: Floats) -> NoiseFacts:
    whole = np.sum([variance for variance, _ in fitted], axis=0)
    from_data = np.sum([share * variance for variance, share in fitted], axis=0) / whole
    rows = (np.sqrt(whole), np.sqrt(claimed), from_data)
    return NoiseFacts(unit, TIMES_S, *(tuple(float(f"{value:.4g}") for value in row) for row in rows))
