"""What tests of commands share: sites that take seconds to simulate."""

import pytest

from tcpipe.simulation import SimulatedSite, simulate


@pytest.fixture(scope="session")
def tiny_site(tmp_path_factory: pytest.TempPathFactory) -> SimulatedSite:
    """The site of scenario ``tiny``; tests read it only."""
    return simulate(tmp_path_factory.mktemp("tiny") / "site", scenario="tiny", seed=3)
