"""``tcpipe explain``: where a sample came from."""

from __future__ import annotations

import click

from tcpipe.cli.options import SEALED, json_option, quiet_option, store_option


@click.command()
@click.argument("sample_id", metavar="SAMPLE_ID")
@click.option("--dataset", default="dataset", type=SEALED, metavar="DIR", help="The dataset that holds it.")
@store_option
@json_option
@quiet_option
def explain(sample_id: str, *, dataset: str, store: str, as_json: bool, quiet: bool) -> int:
    """Trace SAMPLE_ID to its log, stamps, messages, masked rows, map tiles and recipe, and make it again: exit code 1 if it differs."""
    from tcpipe.cli.output import say_result, show_progress
    from tcpipe.pipeline.explain import explain as run

    with show_progress("explain", quiet=quiet):
        found = run(sample_id, dataset=dataset, store=store)
    say_result(found, as_json=as_json)
    return 1 if found.differences else 0
