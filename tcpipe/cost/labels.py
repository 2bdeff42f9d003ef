"""w, v, T, E of a segment, their σ for the *true* metre, and the error budget of E (paper IV; explanation/rulings.md).

The truth of a label is the cost of the true metre that begins where and when the segment does. If the estimated ends
are 1 m apart but the true ones 1 m + e, the true metre ends e / v_end earlier than the segment, with speed v_end and
power P_end there::

    T_true = T - e / v_end        E_true = E - P_end e / v_end

so an error e of the displacement between both ends, whose standard deviation includes their correlation, is an error of
every label.

Part of σ is one error common to all segments of a run: the scale of a single odometry, gain and zero of the power
sensor, the idle power. It has separate columns, since it adds up linearly over a path, while the rest averages out.

Quality bits of labels; none of them removes a segment.
"""

from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass

import numpy as np
from numpy.typing import NDArray

from tcpipe.arrays import Floats, Ints, Mask, count_before
from tcpipe.power.noise import compute_median_period_s
from tcpipe.power.rails import Rail, SampledSignal, is_power_only
from tcpipe.tables.bits import Quality
from tcpipe.tables.facts import CAUSES, EnergyBudget
from tcpipe.tables.findings import Findings, Subject, make_finding, read_threshold


@dataclass(frozen=True, slots=True)
class Labels:
    """The cost of each segment, all of shape (M,); NaN where there is no power.

    Attributes
    ----------
    duration_s, velocity_mps, power_watt, energy_joule : T [s], v = chord / T [m/s], w = E / T [W], E [J].
    *_std : their standard deviations as labels of the true metre, in the same units.
    *_common_std : the part of them that is one error of all segments of the run.
    """

    duration_s: Floats
    velocity_mps: Floats
    power_watt: Floats
    energy_joule: Floats
    duration_std_s: Floats
    velocity_std_mps: Floats
    power_std_watt: Floats
    energy_std_joule: Floats
    duration_common_std_s: Floats
    velocity_common_std_mps: Floats
    power_common_std_watt: Floats
    energy_common_std_joule: Floats


@dataclass(frozen=True, slots=True)
class SensorError:
    """Uncertainty of the power sensor: standard deviations, each of one error of a whole run.

    Attributes
    ----------
    gain_fraction : of its gain, shape (M,) or a number.
    offset_joule : change of each segment's energy by an error of its zero [J], shape (M,) or a number.
    sign_joule : change of each segment's energy by a lost sign [J], shape (M,) or a number.
    """

    gain_fraction: Floats | float = 0.0
    offset_joule: Floats | float = 0.0
    sign_joule: Floats | float = 0.0

    def std_joule(self, energy_joule: Floats, *, of_net_energy: bool = False) -> Floats:
        """Return the standard deviation of energies [J], shape (M,); net energy has no offset by the idle power."""
        variance = (self.gain_fraction * energy_joule) ** 2 + np.square(self.sign_joule)
        return np.sqrt(variance if of_net_energy else variance + np.square(self.offset_joule))


def compute_labels(
    *,
    chord_m: Floats,
    duration_s: Floats,
    energy_joule: Floats,
    end_velocity_mps: Floats,
    end_power_watt: Floats,
    displacement_std_m: Floats,
    energy_noise_joule: Floats,
    common_displacement_std_m: Floats | float = 0.0,
    sensor: SensorError = SensorError(),
) -> Labels:
    """Return w, v, T = d / v and E = w d / v (identities) and their standard deviations; every array has shape (M,).

    Parameters
    ----------
    chord_m, duration_s : [m], [s], both > 0.
    energy_joule : [J]; NaN without power.
    end_velocity_mps, end_power_watt : [m/s], [W], at the segment's end; the speed is at least a tenth of the mean.
    displacement_std_m : [m], of the displacement between both estimated ends, their correlation counted.
    energy_noise_joule : [J], from sampling, noise and quantisation of the power, independent of the displacement.
    common_displacement_std_m : [m], the part of the displacement's that is one error of the run.
    sensor : of the power.
    """
    velocity_mps, power_watt = chord_m / duration_s, energy_joule / duration_s
    end_power_watt = np.where(np.isfinite(energy_joule), end_power_watt, np.nan)
    end_mps = np.maximum(np.abs(end_velocity_mps), 0.1 * velocity_mps)
    common_s = common_displacement_std_m / end_mps
    duration_std_s = np.maximum(displacement_std_m, common_displacement_std_m) / end_mps
    sensor_joule = sensor.std_joule(energy_joule)
    record_joule = np.hypot(energy_noise_joule, sensor_joule)
    return Labels(
        duration_s=duration_s,
        velocity_mps=velocity_mps,
        power_watt=power_watt,
        energy_joule=energy_joule,
        duration_std_s=duration_std_s,
        velocity_std_mps=velocity_mps * duration_std_s / duration_s,
        power_std_watt=np.hypot((end_power_watt - power_watt) * duration_std_s, record_joule) / duration_s,
        energy_std_joule=np.hypot(end_power_watt * duration_std_s, record_joule),
        duration_common_std_s=common_s,
        velocity_common_std_mps=velocity_mps * common_s / duration_s,
        power_common_std_watt=np.hypot((end_power_watt - power_watt) * common_s, sensor_joule) / duration_s,
        energy_common_std_joule=np.hypot(end_power_watt * common_s, sensor_joule),
    )


def subtract_idle_power(
    cost: Labels,
    *,
    idle_watt: float,
    idle_std_watt: float,
    end_power_watt: Floats,
    energy_noise_joule: Floats,
    sensor: SensorError = SensorError(),
) -> dict[str, Floats]:
    """Return columns of net labels, shape (M,): E_true = E - P0 T - (P_end - P0) e / v_end (see the module).

    ``idle_watt``: P0, the idle power, NaN if unknown; the error of P0 is common to a whole run. Again E = w d / v. The
    other parameters are those of `compute_labels`.
    """
    energy_joule = cost.energy_joule - idle_watt * cost.duration_s
    known = np.isfinite(energy_joule)
    common_joule = np.hypot(sensor.std_joule(energy_joule, of_net_energy=True), idle_std_watt * cost.duration_s)
    total_joule = np.hypot(energy_noise_joule, common_joule)
    # An error of T is multiplied with these powers.
    of_energy, of_power = end_power_watt - idle_watt, end_power_watt - cost.power_watt
    values: dict[str, Floats | float] = {
        "idle_power_watt": idle_watt,
        "idle_power_std_watt": idle_std_watt,
        "net_power_watt": cost.power_watt - idle_watt,
        "net_power_std_watt": np.hypot(of_power * cost.duration_std_s, total_joule) / cost.duration_s,
        "net_power_common_std_watt": np.hypot(of_power * cost.duration_common_std_s, common_joule) / cost.duration_s,
        "net_energy_joule": energy_joule,
        "net_energy_std_joule": np.hypot(of_energy * cost.duration_std_s, total_joule),
        "net_energy_common_std_joule": np.hypot(of_energy * cost.duration_common_std_s, common_joule),
    }
    return {name: np.where(known, value, np.nan) for name, value in values.items()}


def estimate_energy_budget(energy_joule: Floats, variance_j2: Mapping[str, Floats]) -> EnergyBudget | None:
    """Return the noise floor of E, shape (M,) [J], NaN without a label; None without energies.

    ``variance_j2``: variances, shape (M,) [J²], of the `CAUSES`, which are independent and add up, and of other keys of
    the budget.
    """
    known = np.isfinite(energy_joule)
    mean_joule = float(np.abs(energy_joule[known]).mean()) if known.any() else 0.0
    if mean_joule <= 0.0:
        return None
    mean_square = {name: float(values[known].mean()) for name, values in variance_j2.items()}
    total = sum(mean_square[cause] for cause in CAUSES)
    shares = {name: float(np.sqrt(value)) / mean_joule for name, value in {"total": total, **mean_square}.items()}
    return EnergyBudget(int(known.sum()), mean_joule, **shares)


def pool_budgets(budgets: Iterable[EnergyBudget | None]) -> EnergyBudget | None:
    """Return the budget of several sets of segments together; None without any."""
    known = [asdict(budget) for budget in budgets if budget is not None]
    count = sum(each["segments"] for each in known)
    if not count:
        return None
    mean_joule = sum(each["segments"] * each["mean_energy_joule"] for each in known) / count
    squares = {
        name: sum(each["segments"] * (each[name] * each["mean_energy_joule"]) ** 2 for each in known) / count
        for name in ("total", *CAUSES, "at_20_hz", "common", "delay")
        if all(each[name] is not None for each in known)
    }
    return EnergyBudget(
        count, mean_joule, **{name: float(np.sqrt(square)) / mean_joule for name, square in squares.items()}
    )


def find_noise(budget: EnergyBudget | None, subject: Subject) -> Findings:
    """Return the finding that the noise floor of E is high."""
    if budget is None or budget.total < read_threshold("energy-noise", "max_total_fraction"):
        return ()
    numbers = {f"{name}_fraction": getattr(budget, name) for name in ("total", *CAUSES, "at_20_hz")}
    return (make_finding("energy-noise", subject, **numbers),)


MIN_INSTANTANEOUS_HZ = 10.0
MIN_AVERAGED_HZ = 2.0
_VOLTAGE_SHARE = 0.02
_RATE_TOLERANCE = 0.98  # a 10 Hz source is 10 Hz though its stamps jitter


def combine_flags(flags: dict[Quality, Mask], count: int) -> NDArray[np.uint32]:
    """Return the flags of ``count`` segments as bits, shape (M,)."""
    quality = np.zeros(count, dtype=np.uint32)
    for bit, flagged in flags.items():
        quality[flagged] |= np.uint32(bit)
    return quality


def find_wanted_rate(*, averaged: bool) -> float:
    """Return the required rate of power [Hz]."""
    return MIN_AVERAGED_HZ if averaged else MIN_INSTANTANEOUS_HZ


def is_too_slow(rate_hz: float, *, averaged: bool) -> bool:
    """Return whether a rate of power [Hz] is below the required rate."""
    return rate_hz < _RATE_TOLERANCE * find_wanted_rate(averaged=averaged)


def has_low_power_rate(rails: list[Rail]) -> bool:
    """Return whether a rail has current below 10 Hz (averaged by its source: 2 Hz), or a varying voltage below it.

    A voltage varies if its RMS change from sample to sample exceeds 2 %; a battery's mostly changes less.
    """
    return any(
        _is_slow(each.current, each) or (_is_slow(each.voltage, each) and _is_varying(each.voltage)) for each in rails
    )


def _is_slow(signal: SampledSignal, each: Rail) -> bool:
    return is_too_slow(1.0 / compute_median_period_s(signal), averaged=each.averaged)


def _is_varying(voltage: SampledSignal) -> bool:
    steps = np.diff(voltage.value)
    return steps.size > 0 and float(np.sqrt(np.mean(steps**2))) > _VOLTAGE_SHARE * abs(float(np.mean(voltage.value)))


def touches_voltage_outside(
    rails: list[Rail], start_ns: Ints, end_ns: Ints, *, range_volt: tuple[float, float] | None
) -> Mask:
    """Return the spans that touch a voltage sample outside the range [V], shape (M,); none without a range."""
    outside = np.zeros(len(start_ns), dtype=bool)
    low, high = range_volt or (-np.inf, np.inf)
    for voltage in (rail.voltage for rail in rails if not is_power_only(rail.voltage.value)):
        bad = count_before((voltage.value < low) | (voltage.value > high))
        first = np.maximum(np.searchsorted(voltage.stamp_ns, start_ns, side="right") - 1, 0)
        last = np.minimum(np.searchsorted(voltage.stamp_ns, end_ns, side="left") + 1, len(voltage.value))
        outside |= bad[last] > bad[first]
    return outside


def spans_near(position_m: Floats, start_m: Floats, end_m: Floats, *, within_m: float) -> Mask:
    """Return the spans of path length [m], (M,), with a position [m], (G,), inside or nearer than ``within_m``."""
    ordered = np.sort(position_m)
    first = np.searchsorted(ordered, start_m - within_m, side="left")
    last = np.searchsorted(ordered, end_m + within_m, side="right")
    return last > first
