"""The best predictor of simulated costs, against the simulator's own truth where nothing is hidden."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from tcpipe.experiment.simulation_floor import compute_true_costs
from tcpipe.simulation.route import Leg, Pause, simulate_drive
from tcpipe.simulation.scenarios import make_paper_site, make_paper_surface, make_small_world
from tcpipe.simulation.truth import compute_true_cost


@pytest.mark.parametrize("surface", [None, make_paper_surface()], ids=["even", "uneven"])
def test_without_hidden_effects_the_truth_is_what_it_says(surface):
    robot = replace(make_paper_site().robot, resistance_noise=0.0, scrub_torque_nm=0.0)
    world = replace(make_small_world(), resistance=(), surface=surface)
    plan = [Pause(1.0), Leg(((56.0, 52.0),)), Pause(1.0)]
    truth = simulate_drive(world, plan, start_m=(6.0, 52.0), robot=robot, weave_m=0.0, rng=np.random.default_rng(0))
    steady = np.flatnonzero((truth.command_velocity_mps > 0.99) & (truth.forward_velocity_mps > 0.5))[300:-600:100]
    start = truth.stamp_ns[steady]
    cost = compute_true_cost(truth, start)
    end = truth.at(cost.end_ns.astype(np.int64))
    chords = {
        "start_lon_deg": truth.lon_deg[steady], "start_lat_deg": truth.lat_deg[steady],
        "end_lon_deg": end.lon_deg, "end_lat_deg": end.lat_deg, "mean_abs_yaw_rate_radps": np.zeros(len(steady)),
    }  # fmt: skip
    told = compute_true_costs(world, robot, SimpleNamespace(column=chords.__getitem__))
    assert len(start) > 40
    assert np.ptp(np.degrees(truth.slope_rad[steady])) > 20.0
    assert told["v"] == pytest.approx(cost.velocity_mps, rel=0.02)
    assert told["T"] == pytest.approx(cost.duration_s, rel=0.02)
    assert told["E"] == pytest.approx(cost.energy_joule, rel=0.05)
    assert np.median(np.abs(told["E"] / cost.energy_joule - 1.0)) < 0.01
