"""Commands that need no data: the demo, simulated sites, a recipe."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from tcpipe.cli.options import (
    LOG,
    OUTPUT_DIRECTORY,
    add_output,
    complete_scenarios,
    msgdef_option,
    quiet_option,
    robot_option,
    seed_option,
)
from tcpipe.cli.output import print_line, print_lines, show_progress
from tcpipe.errors import UsageError

if TYPE_CHECKING:
    from tcpipe.simulation import SimulatedSite


@click.command()
@click.argument("directory", default="tcpipe-demo", type=OUTPUT_DIRECTORY, metavar="[DIR]")
@seed_option
@quiet_option
def demo(directory: str, *, seed: int, quiet: bool) -> None:
    """Simulate a small site and two drives, run the whole pipeline on them, and print which pages to open.

    Writes to DIR (default: tcpipe-demo): real .mcap and .bag logs, real GeoTIFFs, a store, a dataset and its report.
    """
    from tcpipe.pipeline.demo import run_demo

    with show_progress("demo", quiet=quiet) as shown:
        result = run_demo(Path(directory), seed=seed, begin_part=shown.begin_part)
    print_lines(result)


@click.command()
@click.argument("directory", default=".", type=OUTPUT_DIRECTORY, metavar="[DIR]")
@click.option(
    "--from", "source", type=LOG, metavar="PATH", help="Log, or folder of tables, from which the recipe is proposed."
)
@robot_option()
@msgdef_option
def init(directory: str, *, source: str | None, robot: str | None, message_definitions: Path | None) -> None:
    """Write tcpipe.toml, the recipe: every key with its default and its meaning, commented out.

    With --from: what tcpipe finds in PATH (roles, columns, units, power, mounting), with a value of each; what you have
    to decide is commented out.
    """
    from tcpipe.formats.atomic import clear_beside, write_text
    from tcpipe.formats.recipe_toml import FILE_NAME, format_commented_toml
    from tcpipe.pipeline.proposals import propose_recipe

    path = Path(directory) / FILE_NAME
    proposed = source and propose_recipe(source, robot=robot, message_definitions=message_definitions)
    text = proposed.toml() if proposed else format_commented_toml()
    clear_beside(path)
    if path.is_file() and path.read_bytes() == text.encode():
        print_line(f"nothing to do: {path} exists")
    elif path.exists():
        raise UsageError(f"{path}: exists with other content; it is never overwritten")
    else:
        write_text(path, text)
        print_line(f"wrote {path}")
    print_lines(proposed.describe_next_step(path) if proposed else "then: tcpipe ingest LOG")


@click.command()
@click.argument("out", type=OUTPUT_DIRECTORY, metavar="OUT")
@click.option(
    "--scenario",
    default="demo",
    metavar="NAME",
    shell_complete=complete_scenarios,
    help="demo, hills12, paper, paper_quick, manoeuvres, tiny; see docs/reference/simulation.md.",
)
@seed_option
@add_output("simulate")
def simulate(out: str, *, scenario: str, seed: int) -> SimulatedSite:
    """Write a simulated site to OUT: real .mcap and .bag logs, real GeoTIFFs, and the true values."""
    from tcpipe.simulation import simulate as run

    return run(Path(out), scenario=scenario, seed=seed)
