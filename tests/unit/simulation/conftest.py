"""Two simulated drives, made once."""

import pytest

from tcpipe.simulation import find_scenario, simulate_readings


@pytest.fixture(scope="session")
def truth():
    return simulate_readings(find_scenario("manoeuvres"))[0]


@pytest.fixture(scope="session")
def long_truth():
    return simulate_readings(find_scenario("hills12"))[0]
