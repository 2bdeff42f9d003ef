"""Gates against scipy's inverse of the chi-square distribution."""

import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.special import chdtri

from tcpipe.fusion.signals import find_chi_square_threshold


@given(st.integers(1, 9), st.floats(1e-3, 1.0 - 1e-9))
def test_as_scipy(freedom, probability):
    assert find_chi_square_threshold(freedom, probability) == pytest.approx(
        chdtri(freedom, 1.0 - probability), rel=1e-7
    )
