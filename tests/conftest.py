"""Random tests draw the same examples on every machine; ``pytest --hypothesis-profile explore`` draws new ones."""

import gc
import os
import resource
import tomllib
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from hypothesis import settings

settings.register_profile("fixed", derandomize=True, deadline=None)
settings.register_profile("explore", deadline=None, max_examples=500)
settings.load_profile("fixed")

os.environ.setdefault("OMP_NUM_THREADS", "1")  # tests run side by side: threads of one would wait for those of another
gc.set_threshold(50_000)  # as the command does
os.fsync = lambda _: None  # a process that is killed loses nothing that it wrote, and no test cuts the power

RATCHETS = Path(__file__).parent / "architecture/ratchets.toml"


@pytest.fixture(scope="module", autouse=True)
def dataset_page(request: pytest.FixtureRequest) -> Iterator[None]:
    """Leave out page and pictures of each dataset, most of a small build, but in modules that say ``DRAWS_DATASET_PAGES = True``."""
    with pytest.MonkeyPatch.context() as patch:
        if not getattr(request.module, "DRAWS_DATASET_PAGES", False):
            patch.setattr("tcpipe.pipeline.dataset.writing.render_dataset_report", lambda *_, **__: "<!doctype html>")
            patch.setattr("tcpipe.pipeline.dataset.writing.draw_maps", lambda *_: np.zeros((2, 2), np.uint8))
        yield


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put the slowest files of the random order (pytest-randomly) first: two workers end at about the same time."""
    items.sort(key=lambda item: "end_to_end" not in item.path.parts)


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Print the CPU time of all tests, with a warning where it is above its ratchet."""
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    cpu_s = sum(each.ru_utime + each.ru_stime for each in used)
    limit_s = tomllib.loads(RATCHETS.read_text())["make_test"]["cpu_s"]
    warning = f"; WARNING: above the {limit_s} s of {RATCHETS.name}" if cpu_s > limit_s else ""
    terminalreporter.write_line(f"CPU time of the tests: {cpu_s:.0f} s{warning}")
