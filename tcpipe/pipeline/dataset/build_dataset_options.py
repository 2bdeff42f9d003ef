"""The options of ``tcpipe build-dataset`` and `tcpipe.build_dataset`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import KW_ONLY, dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from tcpipe.tables.options import CLUSTER, DRY_RUN, RECIPE, SEED, STORE, Option, Range, jobs, option, tags

if TYPE_CHECKING:
    from tcpipe.formats.dataset_files import FileFormat
    from tcpipe.recipe import Recipe


@dataclass(frozen=True, slots=True)
class BuildDatasetOptions:
    """Which runs and maps a dataset is made from, and how."""

    out: str | Path = option("dataset", Option(kind="published", metavar="[OUT]", is_argument=True))
    """A directory that is new, empty or holds a dataset of the same options; or a URL, where each build is a generation."""
    _: KW_ONLY
    split: str | Path | None = option(
        None, Option("GeoJSON region (WGS84): inside is train and test, outside is unseen.", (), "input_file", "FILE")
    )
    """None: everything is train and test."""
    map_name: str | Sequence[str] | None = option(
        None,
        Option(
            "Map to sample from (default: the only one in the store); repeatable; where maps overlap, the first has priority.",
            ("--map",), "map", "NAME", repeatable=True,
        ),
    )  # fmt: skip
    robot: str | None = option(None, Option("Use only runs of this robot.", (), "robot", "NAME"))
    tags: Mapping[str, str] | None = tags("Use only runs with this tag; if repeated, with all of the tags.")
    store: str | Path = option("tcpipe-store", STORE)
    recipe: Recipe | str | Path | None = option(None, RECIPE)
    jobs: int = jobs("Runs sampled")
    cluster: str | None = option(None, CLUSTER)
    """Its workers see the store under the same absolute path or URL."""
    file_format: FileFormat = option("zarr", Option(flags=("--format",), kind=("zarr", "parquet")))
    holdout: str | None = option(
        None,
        Option(
            "Unit that is held out for test: block, sample, run, or tag:NAME for values of a tag (default: from the recipe).",
            (), "holdout", "HOW",
        ),
    )  # fmt: skip
    covariates: str | Path | Sequence[str | Path] = option(
        (),
        Option(
            "Table (CSV or Parquet) that is joined to the samples by time, such as weather or soil; repeatable.",
            (), "input_file", "FILE", repeatable=True,
        ),
    )  # fmt: skip
    seed: int | None = option(None, Option("Seed of split and row order (default: from the recipe).", (), SEED))
    keep_split: str | Path | None = option(
        None,
        Option("An earlier dataset (OUT is possible) whose samples keep their split and fold.", (), "sealed", "OLD"),
    )
    min_runs: int | None = option(
        None,
        Option(
            "Fail if fewer runs are usable; otherwise excluded and missing runs are notes.",
            (), Range(1, 1_000_000), "N",
        ),
    )  # fmt: skip
    redact: bool = option(
        False,
        Option(
            "For publication: move all positions to 0 N 0 E and omit names of logs, runs, topics, paths, hosts and users."
        ),
    )
    force: bool = option(
        False,
        Option("Replace a dataset that was made with other options (region, map, tags, recipe …)."),
    )
    dry_run: bool = option(False, DRY_RUN)
