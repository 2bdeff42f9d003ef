"""w, v, T, E of a metre, and how wrong each may be as the cost of the *true* metre (paper, section IV; docs/explanation/rulings.md).

The truth of a label is the cost of the true metre that begins where and when the segment does. If the estimated ends are 1 m apart
but the true ones 1 m + e, the true metre ends e / v_end earlier than the segment, with v_end and P_end the speed and power there::

    T_true = T - e / v_end        E_true = E - P_end e / v_end

so an error e of the displacement between both ends, whose standard deviation counts their correlation, is an error of every label.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Labels:
    """The cost of each segment, all of shape (M,); NaN where there is no power.

    Attributes
    ----------
    duration_s, velocity_mps, power_watt, energy_joule : T [s], v = chord / T [m/s], w = E / T [W], E [J].
    *_std : their standard deviations as labels of the true metre, in the same units.
    """

    duration_s: Floats
    velocity_mps: Floats
    power_watt: Floats
    energy_joule: Floats
    duration_std_s: Floats
    velocity_std_mps: Floats
    power_std_watt: Floats
    energy_std_joule: Floats


def compute_labels(
    *,
    chord_m: Floats,
    duration_s: Floats,
    energy_joule: Floats,
    end_velocity_mps: Floats,
    end_power_watt: Floats,
    displacement_std_m: Floats,
    energy_noise_joule: Floats,
) -> Labels:
    """Return w, v, T, E with T = d / v and E = w d / v as identities, and their standard deviations.

    Parameters
    ----------
    chord_m, duration_s : [m], [s], shape (M,), both > 0.
    energy_joule : [J], shape (M,); NaN without power.
    end_velocity_mps, end_power_watt : [m/s], [W], shape (M,), at the segment's end; a speed below a tenth of the mean is taken as that.
    displacement_std_m : [m], shape (M,), of the displacement between both estimated ends, their correlation counted.
    energy_noise_joule : [J], shape (M,), from sampling, noise and quantisation of the power, independent of the displacement.
    """
    velocity_mps, power_watt = chord_m / duration_s, energy_joule / duration_s
    end_power_watt = np.where(np.isfinite(energy_joule), end_power_watt, np.nan)
    duration_std_s = displacement_std_m / np.maximum(np.abs(end_velocity_mps), 0.1 * velocity_mps)
    return Labels(
        duration_s=duration_s,
        velocity_mps=velocity_mps,
        power_watt=power_watt,
        energy_joule=energy_joule,
        duration_std_s=duration_std_s,
        velocity_std_mps=velocity_mps * duration_std_s / duration_s,
        power_std_watt=np.hypot((end_power_watt - power_watt) * duration_std_s, energy_noise_joule) / duration_s,
        energy_std_joule=np.hypot(end_power_watt * duration_std_s, energy_noise_joule),
    )


@dataclass(frozen=True, slots=True)
class NetLabels:
    """What of each segment's cost is not what the robot draws while it stands, all of shape (M,); NaN where either is not known.

    Attributes
    ----------
    idle_power_watt : P0 [W].
    net_power_watt, net_energy_joule : w - P0 [W], E - P0 T [J]; again E = w d / v.
    *_std : their standard deviations as labels of the true metre, in the same units; that of P0 is one error of a whole run.
    """

    idle_power_watt: Floats
    idle_power_std_watt: Floats
    net_power_watt: Floats
    net_power_std_watt: Floats
    net_energy_joule: Floats
    net_energy_std_joule: Floats


def subtract_idle_power(
    cost: Labels, *, idle_watt: float, idle_std_watt: float, end_power_watt: Floats, energy_noise_joule: Floats
) -> NetLabels:
    """Return the labels less what standing takes: E_true = E - P0 T - (P_end - P0) e / v_end, as in the head of this module.

    Parameters
    ----------
    idle_watt, idle_std_watt : [W], P0 and its standard deviation; NaN where it is not known.
    end_power_watt, energy_noise_joule : as in `compute_labels`.
    """
    noise_joule = np.hypot(energy_noise_joule, idle_std_watt * cost.duration_s)
    energy_joule = cost.energy_joule - idle_watt * cost.duration_s
    known = np.isfinite(energy_joule)
    displaced_joule = (end_power_watt - idle_watt) * cost.duration_std_s
    return NetLabels(
        idle_power_watt=np.where(known, idle_watt, np.nan),
        idle_power_std_watt=np.where(known, idle_std_watt, np.nan),
        net_power_watt=cost.power_watt - idle_watt,
        net_power_std_watt=np.where(known, np.hypot(cost.power_std_watt, idle_std_watt), np.nan),
        net_energy_joule=energy_joule,
        net_energy_std_joule=np.where(known, np.hypot(displaced_joule, noise_joule), np.nan),
    )
