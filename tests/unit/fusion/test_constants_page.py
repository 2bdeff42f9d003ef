"""docs/explanation/fusion.md lists the estimators' constants as they are."""

import importlib
import re
from pathlib import Path

import pytest

PAGE = Path(__file__).parents[3] / "docs" / "explanation" / "fusion.md"
ROWS = re.findall(r"^\| `([\w.]+)\.(\w+)` \| ([-+.e\d]+) \|", PAGE.read_text(encoding="utf-8"), flags=re.MULTILINE)
WHOLLY = (
    "process",
    "initial",
    "course",
    "gnss_faults",
    "preparation",
    "checks.audit",
    "checks.doppler",
    "checks.mounting",
    "checks.odometry_scale",
)
"""Modules of which every number is listed."""
UNLISTED = {"_MAX_GAP_NS", "_GRAVITY_BAND_MPS2"}  # the recipe's default beside the recipe; a band, told in words
UNLISTED |= {"_PIECE"}  # rows that are computed at once; no result depends on it
UNLISTED |= {"WHEEL_SCALE_STD", "VISUAL_SCALE_STD", "FIXES_S", "DOPPLER_LASTS_S"}  # listed where they are made


@pytest.mark.parametrize(("module", "name", "value"), ROWS, ids=lambda of: of)
def test_a_constant_has_the_value_on_the_page(module, name, value):
    assert getattr(importlib.import_module(f"tcpipe.fusion.{module}"), name) == float(value)


@pytest.mark.parametrize("module", WHOLLY)
def test_every_number_of_a_module_is_on_the_page(module):
    own = vars(importlib.import_module(f"tcpipe.fusion.{module}"))
    numbers = {name for name, value in own.items() if name.isupper() and isinstance(value, int | float)}
    listed = {name for of, name, _ in ROWS if of == module}
    assert numbers - UNLISTED <= listed
    assert len(ROWS) > 60
