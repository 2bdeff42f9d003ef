"""Worlds and drives with known truth, written as real logs and GeoTIFFs.

`simulate` writes a whole site. In pieces: a `scenarios.Scenario` holds a `world.World`, drives (`route` says where to, `faults` what goes
wrong, `sensors` how strongly) and the rasters' grids; `simulate_readings` gives the truth and the readings of one drive in memory;
`truth.compute_true_cost` is the cost of the true metre that begins at any time.
"""

from tcpipe.simulation.scenarios import Scenario, find_scenario, make_tiny
from tcpipe.simulation.sensors import Faults
from tcpipe.simulation.site_files import SimulatedSite, read_truth, simulate, simulate_readings
from tcpipe.simulation.truth import TrueCost, Truth, compute_true_cost

__all__ = [
    "Faults",
    "Scenario",
    "SimulatedSite",
    "TrueCost",
    "Truth",
    "compute_true_cost",
    "find_scenario",
    "make_tiny",
    "read_truth",
    "simulate",
    "simulate_readings",
]
