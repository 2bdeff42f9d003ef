"""``tcpipe build-dataset``: segments and a map to samples."""

from __future__ import annotations

from typing import Literal

import click

from tcpipe.cli.options import json_option, quiet_option, recipe_option, store_option, tag_values


@click.command("build-dataset", short_help="Segments and map to a dataset")
@click.argument("out", default="dataset", metavar="[OUT]")
@click.option("--split", metavar="FILE", help="GeoJSON region (WGS84): inside is train and test, outside is unseen.")
@click.option(
    "--map",
    "map_name",
    metavar="NAME",
    multiple=True,
    help="Map to sample from (default: the only one in the store); repeat it for several, the first rules where they overlap.",
)
@click.option("--robot", metavar="NAME", help="Only runs of this robot.")
@click.option(
    "--tag",
    "tags",
    multiple=True,
    metavar="K=V",
    callback=tag_values,
    help="Only runs with this tag; repeat it for several, all of them.",
)
@store_option
@recipe_option
@click.option(
    "--jobs", "-j", default=1, show_default=True, type=click.IntRange(1, 1024), help="Runs sampled side by side."
)
@click.option("--format", "file_format", default="zarr", show_default=True, type=click.Choice(["zarr", "parquet"]))
@click.option(
    "--holdout", type=click.Choice(["block", "sample", "run"]), help="How test is drawn (default: the recipe's)."
)
@click.option("--seed", type=int, help="Seed of split and row order (default: the recipe's).")
@click.option(
    "--keep-split", metavar="OLD", help="An earlier dataset (OUT, too): its samples keep their split and fold."
)
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
    file_format: Literal["zarr", "parquet"],
    holdout: Literal["block", "sample", "run"] | None,
    seed: int | None,
    keep_split: str | None,
    as_json: bool,
    quiet: bool,
) -> None:
    """Sample a rotated patch for every segment, split by region, and write the dataset to OUT (default: dataset)."""
    from dataclasses import asdict

    from tcpipe.cli.output import print_json, progress, ruling_recipe, say
    from tcpipe.pipeline.build import build_dataset as run

    ruling, source = ruling_recipe(recipe)
    if not as_json:
        say(f"recipe: {source}")
    with progress("build-dataset", 1, quiet=quiet):
        result = run(
            out,
            store=store,
            split=split,
            map_name=map_name,
            robot=robot,
            tags=tags,
            recipe=ruling,
            jobs=jobs,
            file_format=file_format,
            holdout=holdout,
            seed=seed,
            keep_split=keep_split,
        )
    if as_json:
        print_json({**asdict(result), "recipe": source})
    else:
        click.echo(str(result))
