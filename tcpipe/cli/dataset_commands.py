"""Commands on maps, datasets and stores."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, cast

import click

from tcpipe.cli.options import (
    LOG,
    OUTPUT_DIRECTORY,
    SEALED,
    add_options,
    add_output,
    add_path_or_run,
    json_option,
    msgdef_option,
    quiet_option,
    recipe_option,
    store_option,
)
from tcpipe.cli.output import find_recipe_with_source, print_json, print_line, print_lines, show_progress
from tcpipe.errors import UsageError
from tcpipe.pipeline.options import AddMapOptions, BuildDatasetOptions

if TYPE_CHECKING:
    from tcpipe.pipeline.diff import Difference
    from tcpipe.pipeline.explain import Explained
    from tcpipe.pipeline.export import Exported
    from tcpipe.pipeline.maps import AddedMap
    from tcpipe.pipeline.verify import Verified


@click.command("add-map")
@add_options(AddMapOptions)
@click.argument("strays", nargs=-1, metavar="")
@add_output("add-map")
def add_map(options: AddMapOptions, *, strays: tuple[str, ...]) -> AddedMap:
    """Put rasters on one common grid and add them to the store as map NAME; grids, resolutions and CRS may differ.

    A raster is a GeoTIFF, JPEG 2000 or ERDAS Imagine file. For a raster of many tiles, give a pattern in quotes,
    --height 'dem/*.tif', or repeat the option; where tiles overlap, tcpipe uses the last one.
    """
    from tcpipe.pipeline.maps import run_add_map

    if strays:
        raise UsageError(f"{strays[0]}: belongs to no option; quote patterns, as in --height 'dem/*.tif'")
    return run_add_map(options)


@click.command("build-dataset")
@add_options(BuildDatasetOptions)
@json_option
@quiet_option
def build_dataset(options: BuildDatasetOptions, *, as_json: bool, quiet: bool) -> int:
    """Sample a rotated patch for every segment, split by region, and write the dataset to OUT (default: dataset).

    An existing dataset with the same options is built again from the current runs. If its options differ, the command
    fails, unless --force is given.

    Exit code 3: runs are excluded or missing, or a requested split is empty; a line for each names the remedy.
    """
    from tcpipe.pipeline.dataset.build import run_build_dataset

    path, source = find_recipe_with_source(cast("str | None", options.recipe))
    if not as_json:
        print_line(f"recipe: {source}")
    with show_progress("build-dataset", quiet=quiet) as shown:
        result = run_build_dataset(replace(options, recipe=path))
        shown.problem(*result.finding_lines(problems=True))
    if as_json:
        print_json(replace(result, recipe=source))
    else:
        print_lines(result.format())
    return result.exit_code


@click.command()
@add_path_or_run("path", "[PATH|RUN]", required=False)
@click.option(
    "--no-runs", is_flag=True, help="For a store: write only its own page, with links to existing pages of runs."
)
@recipe_option
def report(path: str, *, store: str, no_runs: bool, recipe: str | None) -> None:
    """Write report.html for PATH (dataset or store), or RUN or RUN/RECIPE of the store; print the robots' physics.

    Without an argument: for the store and all of its runs. The page of the store sums over the runs of the current
    recipe. A page needs no network; tcpipe does not write a page again whose inputs have not changed.
    """
    from tcpipe.pipeline.report import report as run

    written = run(path, store=store, recipe=recipe, runs=not no_runs)
    for page in written:
        print_line(page.path)
        for line in page.physics:
            print_line(f"  {line}")
    if not any(page.changed for page in written):
        print_line("nothing to do: the pages are up to date")


@click.command()
@click.argument("log", type=LOG, metavar="LOG")
@click.argument("names", nargs=-1, metavar="[TOPIC]...")
@click.argument("out", type=OUTPUT_DIRECTORY, metavar="OUT")
@click.option("--topics", multiple=True, metavar="NAME[,NAME]", help="Only these topics; repeatable (default: all).")
@msgdef_option
@add_output()
def export(
    log: str, out: str, *, names: tuple[str, ...], topics: tuple[str, ...], message_definitions: Path | None
) -> Exported:
    """Write topics of LOG to OUT as Parquet, one file per topic, one row per message, columns by dotted field name.

    The metadata of the files has the definition of the message. tcpipe does not write topics again that OUT already
    contains from the same log.
    """
    import resource

    from tcpipe.formats.finding_lines import describe_finding
    from tcpipe.pipeline.export import export as run

    most = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
    resource.setrlimit(resource.RLIMIT_NOFILE, (most, most))  # the files of all topics are open at the same time
    exported = run(log, Path(out), topics=(*topics, *names), message_definitions=message_definitions)
    for kind, findings in (("damage", exported.damage), ("remark", exported.notes)):
        for finding in findings:
            print_line(f"{kind}: {describe_finding(finding)} [{finding.code}]", err=True)
    return exported


@click.command()
@click.argument("sample_id", metavar="SAMPLE_ID")
@click.option("--dataset", default="dataset", type=SEALED, metavar="DIR", help="The dataset that contains the sample.")
@store_option
@add_output("explain")
def explain(sample_id: str, *, dataset: str, store: str) -> Explained:
    """Trace SAMPLE_ID to its log, stamps, messages, masked rows, map and recipe."""
    from tcpipe.pipeline.explain import explain as run

    return run(sample_id, dataset=dataset, store=store)


@click.command()
@add_path_or_run("path", "[PATH|RUN]", required=False)
@add_output()
def verify(path: str, *, store: str) -> Verified:
    """Compare checksums and counts of the dataset, map, model or cost map at PATH, of RUN, or of the whole store.

    Exit code 1: a file has changed, is missing or contradicts another.
    """
    from tcpipe.pipeline.verify import verify as run

    return run(path, store=store)


@click.command()
@click.argument("a", type=SEALED, metavar="A")
@click.argument("b", type=SEALED, metavar="B")
@add_output()
def diff(a: str, b: str) -> Difference:
    """List changes from A to B, causes (log, recipe key, map, region, code) and label shifts; exit code 1 if any."""
    from tcpipe.pipeline.diff import diff as run

    return run(a, b)
