"""What unit tests share; a fixture imported by each module would be made for each."""

from collections.abc import Iterator

import pytest
from object_gateway import gateway, served

__all__ = ["gateway", "served"]


@pytest.fixture(scope="module", autouse=True)
def dataset_page(request: pytest.FixtureRequest) -> Iterator[None]:
    """Leave out the page of each dataset, two thirds of a small build, but in modules that say ``DRAWS_DATASET_PAGES = True``."""
    with pytest.MonkeyPatch.context() as patch:
        if not getattr(request.module, "DRAWS_DATASET_PAGES", False):
            patch.setattr("tcpipe.pipeline.dataset.build.render_dataset_report", lambda *_, **__: "<!doctype html>")
        yield
