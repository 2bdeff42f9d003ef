"""Two simulated drives, made once."""

import pytest

from tcpipe.simulation import scenario, simulated_drive


@pytest.fixture(scope="session")
def truth():
    return simulated_drive(scenario("manoeuvres"))[0]


@pytest.fixture(scope="session")
def long_truth():
    return simulated_drive(scenario("hills12"))[0]
