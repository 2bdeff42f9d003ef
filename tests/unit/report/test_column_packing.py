"""Columns inside a page, read back as its script reads them."""

import numpy as np
import pytest
from page_reading import unpacked

from tcpipe.report.page import pack_columns

COUNT = 1000


@pytest.fixture(scope="module")
def columns():
    chance = np.random.default_rng(5)
    wide = chance.normal(size=COUNT) * 10.0 ** chance.uniform(-4, 6, COUNT)
    wide[::7] = np.nan
    return {
        "flag": ("u8", chance.integers(0, 255, COUNT)),
        "stamp": ("u32", chance.integers(0, 2**32, COUNT)),
        "label": ("f32", wide),
        "std": ("half", np.abs(wide)),
        "x": ("steps", np.where(np.isnan(wide), np.nan, chance.uniform(697_000.0, 698_000.0, COUNT))),
        "run": ("u16", chance.integers(0, 65_535, COUNT)),
    }


def test_what_is_packed_is_read_back_as_well_as_the_kind_says(columns):
    told = pack_columns(columns)
    values = {name: unpacked(told, name) for name in columns}
    for name in ("flag", "stamp", "run"):
        np.testing.assert_array_equal(values[name], columns[name][1])
    np.testing.assert_array_equal(values["label"], columns["label"][1].astype(np.float32))
    np.testing.assert_allclose(values["std"], columns["std"][1], rtol=0.004)
    np.testing.assert_allclose(values["x"], columns["x"][1], rtol=0.0, atol=1000.0 / 65_534)
    assert pack_columns(columns) == told
