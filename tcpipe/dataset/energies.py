"""The two energies of a segment, either of which can be trained on: total, and net of the robot's idle power."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

from tcpipe.errors import DatasetError

EnergyName = Literal["total", "net"]


@dataclass(frozen=True, slots=True)
class Energy:
    """Columns of power [W] and energy [J], E = w d / v, and their standard deviations."""

    power: str
    power_std: str
    energy: str
    energy_std: str
    words: str
    """Description for pages."""


ENERGIES: Mapping[str, Energy] = {
    "total": Energy("power_watt", "power_std_watt", "energy_joule", "energy_std_joule", "total"),
    "net": Energy(
        "net_power_watt", "net_power_std_watt", "net_energy_joule", "net_energy_std_joule", "net of idle power"
    ),
}


def name_common_std(column: str) -> str:
    """Return the name of a standard deviation's part that is one error of all labels of a run."""
    return column.replace("_std_", "_common_std_")


def find_energy(name: str) -> Energy:
    """Return an energy by its name; `DatasetError` lists the known ones."""
    if name not in ENERGIES:
        raise DatasetError(f"label {name!r}: expected one of {', '.join(ENERGIES)}")
    return ENERGIES[name]
