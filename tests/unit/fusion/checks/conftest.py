"""A drive over rough ground, what its sensors measured, and a track that is the truth."""

import pytest
from rough_drive import drive, measured, true_track


@pytest.fixture(scope="session")
def truth():
    return drive(120.0, 3)


@pytest.fixture(scope="session")
def sensors(truth):
    return measured(truth, 3)


@pytest.fixture(scope="session")
def track(truth):
    return true_track(truth)
