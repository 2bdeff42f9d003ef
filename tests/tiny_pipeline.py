"""Simulate half a minute, ingest it and build a dataset: ``python tests/tiny_pipeline.py OUT [SITE]``.

With SITE, the OUT of an earlier call, its log and rasters are taken. `make test` runs it once for the kernels that it compiles.
"""

import sys
from pathlib import Path

from tcpipe.pipeline.dataset.build import build_dataset
from tcpipe.pipeline.ingest import ingest
from tcpipe.pipeline.maps import add_map
from tcpipe.simulation import Faults, make_tiny, simulate


def main(out: Path, first: Path) -> None:
    site = simulate(out / "site", scenario=make_tiny(Faults.every()))
    layers = {name: first / path.relative_to(out) for name, path in site.rasters.items()}
    assert ingest([first / path.relative_to(out) for path in site.logs], store=out / "store").exit_code == 0
    add_map("site", **layers, store=out / "store")
    build_dataset(out / "dataset", store=out / "store")


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[-1]))
