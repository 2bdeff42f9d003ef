"""The error budget of one simulated drive whose power is recorded in six ways, as docs/explanation/uncertainty.md prints it.

    python benchmarks/error_budget.py

The drive is the campaign's first, over hills, with every sensor; shares are of a segment's mean energy, and add in
square.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

from campaign import LENGTH_M
from campaign_drives import FIRST_SEED, log_of, simulated
from campaign_faults import FAULTS

from tcpipe.formats.recipe_toml import load_shipped_profiles
from tcpipe.pipeline.ingest_run import run_stages
from tcpipe.recipe import Recipe
from tcpipe.simulation.sensors import Power, Sensors
from tcpipe.stages.read import read_run
from tcpipe.tables.facts import EnergyBudget

WAYS = tuple(Power(rate_hz=rate_hz, averaged=averaged) for averaged in (False, True) for rate_hz in (1.0, 5.0, 20.0))


def budget_of(power: Power) -> EnergyBudget:
    """Return the budget of the drive's labels with its power recorded so."""
    recipe = Recipe()
    log = log_of(simulated("hills", FIRST_SEED, LENGTH_M), replace(Sensors(), power=power), FAULTS["clean"])
    read_config = replace(recipe.read, power_averaged="yes" if power.averaged else "no")
    streams = read_run(log, read_config, robot="husky", known=load_shipped_profiles())
    _, _, labelled = run_stages(streams, recipe.ingest, run_id="run")
    facts = labelled.info.report.facts.label
    if facts is None or facts.energy_budget is None:
        raise SystemExit("the drive has no labels")
    return facts.energy_budget


def main() -> None:
    print("| power | noise floor of E | power rate | noise of the current | position | with power at 20 Hz |")
    print("|---|---|---|---|---|---|")
    for power in WAYS:
        budget = budget_of(power)
        told = [f"{100 * share:.1f}" for share in (budget.rate, budget.current, budget.position)]
        at_20_hz = f"{100 * budget.at_20_hz:.1f} % " if power.rate_hz < 20 else ""
        name = f"{'averaged' if power.averaged else 'sampled'}, {power.rate_hz:g} Hz"
        print("|", " | ".join([name, f"{100 * budget.total:.1f} %", *told, at_20_hz]) + "|", flush=True)


if __name__ == "__main__":
    main()
