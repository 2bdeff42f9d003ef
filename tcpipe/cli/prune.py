"""``tcpipe prune``: what a store no longer needs."""

from __future__ import annotations

import click

from tcpipe.cli.options import complete_runs, json_option, min_age_option, recipe_option, store_option


@click.command()
@store_option
@recipe_option
@click.option(
    "--keep",
    multiple=True,
    metavar="RUN|RECIPE",
    shell_complete=complete_runs,
    help="Nothing of this run or recipe goes; repeatable.",
)
@click.option(
    "--forget", multiple=True, metavar="DATASET", help="This dataset is gone; what it referred to may go; repeatable."
)
@min_age_option("1d", "What killed calls left is removed when it is so old (90, 90s, 10m, 2h, 1d).")
@click.option("--dry-run", is_flag=True, help="Say what would be removed; do nothing.")
@json_option
def prune(
    *,
    store: str,
    recipe: str | None,
    keep: tuple[str, ...],
    forget: tuple[str, ...],
    min_age_s: float,
    dry_run: bool,
    as_json: bool,
) -> int:
    """Remove results of older recipes where the ruling one has its own, superseded runs, and what killed calls left.

    Nothing goes that a dataset refers to, built from this store wherever it lies now, nor a directory that holds a file of somebody else.
    """
    from tcpipe.cli.output import resolve_recipe_with_source, say_result
    from tcpipe.pipeline.prune import prune as run

    found = run(
        store=store,
        recipe=resolve_recipe_with_source(recipe)[0],
        keep=keep,
        forget=forget,
        min_age_s=min_age_s,
        dry_run=dry_run,
    )
    say_result(found, as_json=as_json)
    return 0
