"""Standard deviations of positions with a lever arm that is stated, or declared exact."""

import numpy as np
import pytest
from installed_command import tcpipe

from tcpipe.simulation import Faults, make_tiny, simulate
from tcpipe.store import Store
from tcpipe.tables.columns import to_floats


@pytest.fixture(scope="module")
def ingest(tmp_path_factory):
    """Return how a run of one drive comes out with the lines of a recipe."""
    here = tmp_path_factory.mktemp("arm")
    scenario = make_tiny(Faults.only("gnss_noise", "gnss_lever_arm", "imu_noise", "wheel_noise"), seconds=40.0)
    (log,) = simulate(here / "site", scenario=scenario).logs

    def run(name, lines):
        (here / "tcpipe.toml").write_text(lines)
        done = tcpipe("ingest", log, "--store", name, "--recipe", "tcpipe.toml", "--quiet", cwd=here)
        assert done.returncode == 0, done.stderr
        (found,) = Store(here / name).runs()
        return found

    return run


def test_an_arm_that_is_declared_exact_is_no_parameter_and_positions_claim_less(ingest):
    stated, exact = ingest("stated", ""), ingest("exact", "[fuse]\nlever_arm_std_m = [0.0, 0.0, 0.0]\n")
    (shown,) = (section.parameters for section in stated.manifest.info.report.facts.fuse.stretches)
    assert shown["antenna"].prior_std == (0.05, 0.05, 0.1)
    (shown,) = (section.parameters for section in exact.manifest.info.report.facts.fuse.stretches)
    assert "antenna" not in shown
    for axis, share in (("x", 0.95), ("z", 0.5)):
        std = [np.median(to_floats(run.track().table, f"{axis}_std_m")) for run in (exact, stated)]
        assert std[0] < share * std[1]


def test_axes_that_are_exact_stay_and_the_others_are_found(ingest):
    run = ingest("height", "[fuse]\nlever_arm_std_m = [0.05, 0.05, 0.0]\n")
    arm = run.manifest.info.report.facts.fuse.stretches[0].parameters["antenna"]
    assert (arm.prior_std, arm.value[2], arm.std[2]) == ((0.05, 0.05, 0.0), 0.0, 0.0)
    assert 0.0 < arm.std[0] < 0.05
