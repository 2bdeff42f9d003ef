"""Integrals of straight-line signals by hand."""

import numpy as np
import pytest
from made_tracks import stamps

from tcpipe.geometry.piecewise_linear import (
    integrate_held_to,
    interpolate,
    mean_between,
)

SECONDS = stamps(3, step_ns=1_000_000_000)


def at(*seconds):
    return SECONDS[0] + np.round(np.array(seconds) * 1e9).astype(np.int64)


def test_held_back_takes_the_value_of_the_right_end():
    value = np.array([9.0, 2.0, 5.0])
    assert integrate_held_to(SECONDS, value, at(0, 0.25, 1, 1.5, 2)) == pytest.approx([0, 0.5, 2, 4.5, 7])


def test_interpolation_resolves_nanoseconds_far_from_the_epoch():
    assert interpolate(SECONDS, np.array([0.0, 1e9, 2e9]), SECONDS[:1] + 7)[0] == pytest.approx(7, abs=1e-3)


def test_mean_between_is_exact_and_unknown_where_a_sample_is():
    value = np.array([1.0, 3.0, np.nan])
    assert mean_between(SECONDS, value, at(0, 0.5), at(1, 1.0)) == pytest.approx([2.0, 2.5])
    assert np.isnan(mean_between(SECONDS, value, at(0.5), at(1.5)))
