"""``tcpipe build-dataset``: segments and a map to samples."""

from __future__ import annotations

import re
from typing import Literal

import click

from tcpipe.cli.options import (
    INPUT_FILE,
    PUBLISHED,
    SEALED,
    SEED,
    cluster_option,
    complete_maps,
    dry_run_option,
    jobs_option,
    json_option,
    quiet_option,
    recipe_option,
    robot_option,
    store_option,
    tag_option,
)


def _holdout(context: click.Context, parameter: click.Parameter, value: str | None) -> str | None:
    """Let pass what draws test; anything else is a usage error."""
    if value is not None and re.fullmatch(r"block|sample|run|tag:.+", value) is None:
        raise click.BadParameter(f"{value!r}: wanted block, sample, run, or tag:NAME", ctx=context, param=parameter)
    return value


@click.command("build-dataset", short_help="Segments and map to a dataset")
@click.argument("out", default="dataset", type=PUBLISHED, metavar="[OUT]")
@click.option(
    "--split",
    type=INPUT_FILE,
    metavar="FILE",
    help="GeoJSON region (WGS84): inside is train and test, outside is unseen.",
)
@click.option(
    "--map",
    "map_name",
    metavar="NAME",
    shell_complete=complete_maps,
    multiple=True,
    help="Map to sample from (default: the only one in the store); repeat it for several, the first rules where they overlap.",
)
@robot_option("Only runs of this robot.")
@tag_option("Only runs with this tag; repeat it for several, all of them.")
@store_option
@recipe_option
@jobs_option("Runs sampled")
@cluster_option
@click.option("--format", "file_format", default="zarr", type=click.Choice(["zarr", "parquet"]))
@click.option(
    "--holdout",
    metavar="HOW",
    callback=_holdout,
    help="How test is drawn: block, sample, run, or tag:NAME, which holds out values of a tag (default: the recipe's).",
)
@click.option(
    "--covariates",
    multiple=True,
    type=INPUT_FILE,
    metavar="FILE",
    help="Table (CSV or Parquet) whose columns are joined to the samples by time, as weather or soil; repeat it for several.",
)
@click.option("--seed", type=SEED, help="Seed of split and row order (default: the recipe's).")
@click.option(
    "--keep-split",
    type=SEALED,
    metavar="OLD",
    help="An earlier dataset (OUT, too): its samples keep their split and fold.",
)
@click.option(
    "--min-runs",
    type=click.IntRange(1, 1_000_000),
    metavar="N",
    help="Build nothing from fewer runs; so many are enough: that others are left out or gone is a note then.",
)
@click.option(
    "--redact",
    is_flag=True,
    help="For the public: moved to 0 N 0 E as a whole, and no log, run, topic, path, host or user is named.",
)
@click.option(
    "--force",
    is_flag=True,
    help="Replace a dataset that was made with other options (region, map, tags, recipe …); in a bucket nothing is replaced.",
)
@dry_run_option
@json_option
@quiet_option
def build_dataset(
    out: str,
    *,
    split: str | None,
    map_name: tuple[str, ...],
    robot: str | None,
    tags: dict[str, str],
    store: str,
    recipe: str | None,
    jobs: int,
    cluster: str | None,
    file_format: Literal["zarr", "parquet"],
    holdout: str | None,
    covariates: tuple[str, ...],
    seed: int | None,
    keep_split: str | None,
    min_runs: int | None,
    redact: bool,
    force: bool,
    dry_run: bool,
    as_json: bool,
    quiet: bool,
) -> int:
    """Sample a rotated patch for every segment, split by region, and write the dataset to OUT (default: dataset).

    A dataset that is there is built again from the runs of today if its options are the same; with others it is refused
    unless --force is given.

    Exit code 3: runs that belong in are left out or gone, or a split that was asked for is empty; each is a line with its remedy.
    """
    from dataclasses import replace

    from tcpipe.cli.output import print_json, progress, ruling_recipe, say, say_lines
    from tcpipe.pipeline.dataset.build import build_dataset as run

    ruling, source = ruling_recipe(recipe)
    if not as_json:
        say(f"recipe: {source}")
    with progress("build-dataset", quiet=quiet) as shown:
        result = run(
            out,
            store=store,
            split=split,
            map_name=map_name,
            robot=robot,
            tags=tags,
            recipe=ruling,
            jobs=jobs,
            cluster=cluster,
            file_format=file_format,
            holdout=holdout,
            seed=seed,
            keep_split=keep_split,
            covariates=covariates,
            min_runs=min_runs,
            redact=redact,
            force=force,
            dry_run=dry_run,
        )
        shown.problem(*result.problem_lines())
    if as_json:
        print_json(replace(result, recipe=source))
    else:
        say_lines(result.without_problems())
    return result.exit_code
