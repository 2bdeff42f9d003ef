"""Predictions sample by sample: which are worst, and how far what is stated of them is true."""

import numpy as np
import pyarrow as pa
import pytest
from scipy.stats import norm

from tcpipe.learning.predictions import LEVELS, compute_calibration, find_worst_rows, make_column_name


def table(label, said, std=None, split=None):
    count = len(label)
    return pa.table(
        {
            "split": split or ["unseen"] * count,
            make_column_name("E"): label,
            make_column_name("E", "predicted"): said,
            make_column_name("E", "predicted_std"): [None] * count if std is None else std,
        },
    ).cast(
        pa.schema(
            [
                ("split", pa.string()),
                *((make_column_name("E", of), pa.float64()) for of in ("", "predicted", "predicted_std")),
            ]
        )
    )


def test_the_worst_of_each_split_come_first():
    label, said = [10.0, 10.0, 10.0, 10.0, 10.0], [10.0, 4.0, 13.0, None, 11.0]
    split = ["test", "test", "test", "unseen", "unseen"]
    assert find_worst_rows(table(label, said, split=split), 2).tolist() == [1, 2, 4]


@pytest.mark.parametrize("shrunk", [1.0, 0.5])
def test_calibration_is_that_of_the_normal_it_states(shrunk):
    """Labels at even quantiles of a normal around each prediction; where half of its deviation is stated, more fall outside."""
    quantiles = norm.ppf((np.arange(4000) + 0.5) / 4000)
    said = np.linspace(100.0, 400.0, 4000)
    found = compute_calibration(table(said + 20.0 * quantiles, said, np.full(4000, 20.0 * shrunk)), "E")
    np.testing.assert_allclose(found, norm.cdf(shrunk * norm.ppf(LEVELS)), atol=1e-3)
    assert compute_calibration(table([1.0], [2.0]), "E") is None, "nothing is stated"
