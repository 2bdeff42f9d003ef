"""An ingest, and a build with nothing to do, import no heavy module that they do not use."""

import subprocess
import sys

import numpy as np
from simulated_streams import log_of
from synthetic_store import add_run, lanes, open_world, segments

from tcpipe.pipeline.dataset.build import build_dataset
from tcpipe.simulation import make_tiny

UNUSED = {
    "pandas", "filterpy", "pydantic", "zarr", "rasterio", "matplotlib", "polars", "pyproj", "shapely", "mcap", "torch", "lightgbm",
    "ruamel.yaml", "scipy.signal", "scipy.stats",
}  # fmt: skip
PROGRAM = """
import sys
import tcpipe.cli
if __name__ == "__main__":
    from tcpipe.pipeline.ingest import ingest
    summary = ingest(sys.argv[3:], store=sys.argv[1], jobs=int(sys.argv[2]))
    assert summary.exit_code == (0 if sys.argv[2] == "1" else 1), summary
    print(*sorted(sys.modules))
"""


def loaded(tmp_path, jobs, *logs):
    program = tmp_path / "program.py"
    program.write_text(PROGRAM)
    command = [sys.executable, program, tmp_path / "store", str(jobs), *logs]
    return set(subprocess.run(command, capture_output=True, text=True, check=True, timeout=300).stdout.split())


def test_an_ingest_loads_nothing_that_it_does_not_use(tmp_path):
    scenario = make_tiny()
    assert not loaded(tmp_path, 1, log_of(scenario, scenario.drives[0], tmp_path / "site")) & UNUSED


def test_where_workers_do_the_work_their_parent_loads_no_kernel(tmp_path):
    logs = [tmp_path / name for name in ("a.mcap", "b.mcap")]
    for log in logs:
        log.write_bytes(log.name.encode())
    assert not loaded(tmp_path, 2, *logs) & (UNUSED | {"numba", "scipy"})


BUILD = """
import sys
import tcpipe.cli
from tcpipe.pipeline.dataset.build import build_dataset
assert build_dataset(sys.argv[1], store=sys.argv[2]).status == "unchanged"
print(*sorted(sys.modules))
"""


def test_a_build_with_nothing_to_do_loads_nothing_that_writes_a_dataset(tmp_path):
    store, out = open_world(tmp_path), tmp_path / "dataset"
    add_run(store, "a", segments("a", *lanes(np.array([-3.0, 3.0]), -8.0, 8.0)))
    build_dataset(out, store=store.root)
    command = [sys.executable, "-c", BUILD, out, store.root]
    modules = set(subprocess.run(command, capture_output=True, text=True, check=True, timeout=300).stdout.split())
    assert not modules & (UNUSED - {"shapely"} | {"numba", "scipy", "bokeh", "PIL"})
