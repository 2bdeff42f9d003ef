"""The demo: a simulated site through the whole pipeline, as a user would run it."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from tcpipe.errors import DatasetError
from tcpipe.formats.atomic import check_new, clear
from tcpipe.formats.dataset_card import DatasetCard
from tcpipe.formats.dataset_files import read_intact_card
from tcpipe.pipeline.dataset.build import build_dataset
from tcpipe.pipeline.ingest import IngestSummary, ingest
from tcpipe.pipeline.maps import add_map
from tcpipe.pipeline.report import report
from tcpipe.recipe import Recipe
from tcpipe.simulation import simulate


@dataclass(frozen=True, slots=True)
class DemoResult:
    """Paths of all outputs; ``str`` of it is the command's output."""

    directory: Path
    ingested: IngestSummary
    card: DatasetCard
    pages: tuple[Path, ...]
    unchanged: bool

    def __str__(self) -> str:
        """Return the paths of all outputs, and what to open."""
        here = self.directory
        return "\n".join(
            (
                "",
                f"simulated site   {here}/site          real logs, GeoTIFFs, region.geojson, and the truth behind them",
                f"store            {here}/store         {len(self.ingested.results)} runs, 1 map",
                f"dataset          {here}/dataset       {self.card.samples} samples: "
                + ", ".join(f"{count} {split}" for split, count in self.card.splits.items()),
                "",
                f"open             {self.pages[0]}",
                *(f"                 {page}" for page in self.pages[1:]),
                "",
                "train on it      import tcpipe",
                f'                 train = tcpipe.open_dataset("{here}/dataset")["train"]',
                "                 train.patches  # float32 (N, 40, 40, 3): ortho, terrain, height",
                "                 train.labels   # (N, 2): power [W], velocity [m/s]",
                *(("", "nothing to do: everything exists") if self.unchanged else ()),
            )
        )


_PARTS = 5  # steps of the demo: simulate, ingest, add-map, build-dataset, report


def run_demo(directory: Path, *, seed: int, begin_part: Callable[..., None]) -> DemoResult:
    """Simulate, ingest, add the map, build the dataset and write the reports under ``directory``.

    Raises `UsageError`: the directory has other content; `DatasetError`: a step fails (which would be a bug).
    """
    site_path, store_path, dataset_path = directory / "site", directory / "store", directory / "dataset"
    clear(directory)
    check_new(directory, "demo", "site")
    begin = partial(begin_part, total=_PARTS)
    begin(0, text="simulating a site and two drives")
    site = simulate(site_path, scenario="demo", seed=seed)
    begin(1, text=f"$ tcpipe ingest {' '.join(map(str, site.logs))}")
    ingested = ingest(site.logs, store=store_path, recipe=Recipe())
    if problems := [problem for result in ingested.results for problem in result.problems]:
        raise DatasetError(*problems)
    rasters: dict[str, Any] = site.rasters
    options = " ".join(f"--{name} {path}" for name, path in rasters.items())
    begin(2, text=f"$ tcpipe add-map site {options} --ortho-bands rgb")
    added = add_map("site", **rasters, ortho_bands="rgb", store=store_path)
    begin(3, text=f"$ tcpipe build-dataset {dataset_path} --split {site.region}")
    built = build_dataset(dataset_path, store=store_path, split=site.region, recipe=Recipe(), force=True)
    begin(4, text=f"$ tcpipe report {dataset_path}")
    of_store = report(store_path)  # first: the dataset's page leads to it
    pages = (*report(dataset_path), *of_store)
    statuses = {added.status, built.status, *(result.status for result in ingested.results)}
    unchanged = statuses == {"unchanged"} and not any(page.changed for page in pages)
    return DemoResult(
        directory, ingested, read_intact_card(dataset_path), tuple(Path(page.path) for page in pages), unchanged
    )
