"""Worlds and drives with known truth, written as real logs and GeoTIFFs.

`simulate` writes a whole site: a `scenarios.Scenario` of a `world.World`, drives (routes and faults) and the rasters'
grids. `simulate_readings` returns truth and readings of a drive; `truth.compute_true_cost` the cost of a true metre.
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
