"""Smooth random fields of the plane: sums of plane waves, known exactly everywhere."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import astuple, dataclass

import numpy as np
from scipy.special import erf

from tcpipe.simulation.site import Float


@dataclass(frozen=True, slots=True)
class Wave:
    """A plane wave: amplitude in the unit of what it ripples."""

    amplitude: float
    wavelength_m: float
    direction_rad: float
    phase_rad: float


def draw_waves(
    seed: int,
    *,
    count: int,
    total: float,
    wavelength_m: tuple[float, float],
    direction_rad: tuple[float, float] = (0.0, np.pi),
) -> tuple[Wave, ...]:
    """Return plane waves of random direction and phase, log-uniform wavelength, and amplitudes that sum in square to ``total``²."""
    rng = np.random.default_rng(seed)
    amplitude = total * np.sqrt(2.0 / count)
    return tuple(
        Wave(
            amplitude,
            float(np.exp(rng.uniform(*np.log(wavelength_m)))),
            float(rng.uniform(*direction_rad)),
            float(rng.uniform(0.0, 2.0 * np.pi)),
        )
        for _ in range(count)
    )


def sum_waves(waves: Sequence[Wave], u: Float, v: Float) -> Float:
    """Sum the waves; sin(a + b) is expanded, so that row and column vectors meet in outer products only."""
    total = np.zeros(np.broadcast_shapes(np.shape(u), np.shape(v)))
    for wave in waves:
        k = 2.0 * np.pi / wave.wavelength_m
        a = k * np.cos(wave.direction_rad) * u + wave.phase_rad
        b = k * np.sin(wave.direction_rad) * v
        total += wave.amplitude * (np.sin(a) * np.cos(b) + np.cos(a) * np.sin(b))
    return total


def evaluate_field(waves: Sequence[Wave], u: Float, v: Float) -> Float:
    """Sum many waves: a row and a column meet in one product of matrices, anything else wave by wave."""
    if np.ndim(u) == np.ndim(v) == 2 and np.shape(u)[0] == np.shape(v)[1] == 1:
        amplitude, length, direction, phase = np.array([astuple(wave) for wave in waves]).T
        a = 2.0 * np.pi / length * np.cos(direction) * u.T + phase
        b = 2.0 * np.pi / length * np.sin(direction) * v
        return np.asarray((amplitude * np.cos(b)) @ np.sin(a).T + (amplitude * np.sin(b)) @ np.cos(a).T)
    total = np.zeros(np.broadcast_shapes(np.shape(u), np.shape(v)))
    for wave in waves:
        k = 2.0 * np.pi / wave.wavelength_m
        total += wave.amplitude * np.sin(
            k * np.cos(wave.direction_rad) * u + k * np.sin(wave.direction_rad) * v + wave.phase_rad
        )
    return total


def state(waves: Sequence[Wave], u: Float, v: Float) -> Float:
    """Return a field that is spread evenly over -1 … 1, of waves whose squares sum to 1."""
    return np.asarray(erf(evaluate_field(waves, u, v) / np.sqrt(2.0)))
