"""Random tests draw the same examples on every machine; ``pytest --hypothesis-profile explore`` draws new ones."""

import os

import pytest
from hypothesis import settings

settings.register_profile("fixed", derandomize=True, deadline=None)
settings.register_profile("explore", deadline=None, max_examples=500)
settings.load_profile("fixed")

os.environ.setdefault("OMP_NUM_THREADS", "1")  # tests run side by side: threads of one would wait for those of another


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Of the random order (pytest-randomly), the files that take longest come first: two workers end at about the same time."""
    items.sort(key=lambda item: "end_to_end" not in item.path.parts)
