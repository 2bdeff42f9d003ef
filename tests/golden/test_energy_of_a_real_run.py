"""The whole-run energy of a real Warthog against the trapezoid sum published with it, and the difference explained exactly."""

import json

import numpy as np
import pytest
from shared_data import shared_data

from tcpipe.formats.logs.log_file import open_log
from tcpipe.formats.recipe_toml import load_shipped_profiles
from tcpipe.power.rails import integrate_recorded_energy
from tcpipe.recipe import ReadConfig
from tcpipe.stages import read
from tcpipe.stages.message_arrays import make_rails
from tcpipe.stages.read import read_run


def read_rails():
    """Return the rails of the Warthog's run, their first and last stamps, and the trapezoid sum that was published."""
    reference = json.loads(shared_data("warthog_grass_a/reference.json").read_text())["E_trapezoid_joule"]
    with open_log(shared_data("warthog_grass_a/run.mcap")) as log:
        rails = make_rails(read_run(log, ReadConfig(), robot=None, known=load_shipped_profiles()), 0)
    ends = [np.array([pick(each.stamp_ns[k] for each in rails)]) for pick, k in ((min, 0), (max, -1))]
    return rails, ends, reference


def test_exact_and_trapezoid_energy_of_the_warthog(monkeypatch):
    """Its messages repeat readings of 1 Hz twenty times each; the published sum counts each."""
    monkeypatch.setattr(read, "remove_repeats", lambda streams: (streams, []))
    rails, ends, reference = read_rails()
    assert len(rails) == 2
    exact = integrate_recorded_energy(rails, *ends, rule="exact")[0]
    trapezoid, correction = 0.0, 0.0
    for each in rails:
        t = (each.stamp_ns - ends[0][0]) * 1e-9
        power = each.voltage_volt * each.current_amp
        trapezoid += np.trapezoid(power, t)
        # The trapezoid of a product of two straight lines is too large by h ΔV ΔI / 6 on every interval.
        correction -= (np.diff(t) * np.diff(each.voltage_volt) * np.diff(each.current_amp)).sum() / 6
    assert trapezoid == pytest.approx(reference, rel=1e-6)
    assert exact - trapezoid == pytest.approx(correction, rel=1e-6)
    assert exact == pytest.approx(reference, rel=2e-5)


def test_the_readings_alone_hold_the_same_energy():
    rails, ends, reference = read_rails()
    for each in rails:
        assert np.median(np.diff(each.current.stamp_ns)) == pytest.approx(1e9, rel=0.01)
    assert integrate_recorded_energy(rails, *ends, rule="exact")[0] == pytest.approx(reference, rel=2e-3)
