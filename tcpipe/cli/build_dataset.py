"""``tcpipe build-dataset``: segments and a map to samples."""

from __future__ import annotations

from typing import cast

import click

from tcpipe.cli.options import add_options, json_option, quiet_option
from tcpipe.pipeline.dataset.build_dataset_options import BuildDatasetOptions


@click.command("build-dataset")
@add_options(BuildDatasetOptions)
@json_option
@quiet_option
def build_dataset(options: BuildDatasetOptions, *, as_json: bool, quiet: bool) -> int:
    """Sample a rotated patch for every segment, split by region, and write the dataset to OUT (default: dataset).

    A dataset that is there is built again from the runs of today if its options are the same; with others it is refused
    unless --force is given.

    Exit code 3: runs that belong in are left out or gone, or a split that was asked for is empty; each is a line with its remedy.
    """
    from dataclasses import replace

    from tcpipe.cli.output import print_json, print_line, resolve_recipe_with_source, say_lines, show_progress
    from tcpipe.pipeline.dataset.build import run_build_dataset

    ruling, source = resolve_recipe_with_source(cast("str | None", options.recipe))
    if not as_json:
        print_line(f"recipe: {source}")
    with show_progress("build-dataset", quiet=quiet) as shown:
        result = run_build_dataset(replace(options, recipe=ruling))
        shown.problem(*result.problem_lines())
    if as_json:
        print_json(replace(result, recipe=source))
    else:
        say_lines(result.without_problems())
    return result.exit_code
