"""The command line, one file a command. Only click is imported here; everything else waits inside the commands."""

from __future__ import annotations

import logging
import os
import platform
import shlex
import signal
import sys
from collections.abc import Callable, Sequence
from copy import copy
from typing import Any, NoReturn, TypeVar

import click

from tcpipe import __version__
from tcpipe.cli.acknowledge import acknowledge
from tcpipe.cli.add_map import add_map
from tcpipe.cli.build_dataset import build_dataset
from tcpipe.cli.cost_map import cost_map
from tcpipe.cli.demo import demo
from tcpipe.cli.diff import diff
from tcpipe.cli.evaluate import evaluate
from tcpipe.cli.explain import explain
from tcpipe.cli.export import export
from tcpipe.cli.ingest import ingest
from tcpipe.cli.init import init
from tcpipe.cli.inspect import inspect
from tcpipe.cli.migrate import migrate
from tcpipe.cli.output import debug_log, print_traceback, say_failure
from tcpipe.cli.overlay import overlay
from tcpipe.cli.plan_path import plan_path
from tcpipe.cli.predict_path import predict_path
from tcpipe.cli.preflight import preflight
from tcpipe.cli.process import NOTHING_HALF, Ended, ended_in_time, prepare_process
from tcpipe.cli.prune import prune
from tcpipe.cli.report import report
from tcpipe.cli.reproduce import reproduce
from tcpipe.cli.schemas import schemas
from tcpipe.cli.simulate import simulate
from tcpipe.cli.status import status
from tcpipe.cli.train import train
from tcpipe.cli.verify import verify
from tcpipe.errors import TcpipeError, UsageError, hide_secrets

_EXTRAS = {"torch": "train", "lightgbm": "tables", "dask": "cluster", "distributed": "cluster", "dagster": "dagster"}
"""Which extra brings a package that only some commands need."""

C = TypeVar("C", bound=Callable[..., Any])


class _InOrder(click.Group):
    """Lists commands in the order a user meets them."""

    def list_commands(self, ctx: click.Context) -> list[str]:  # noqa: ARG002  click's signature
        return list(self.commands)


def _begin_debugging(context: click.Context, _: click.Parameter, wanted: bool) -> None:  # noqa: FBT001  click's signature
    root = context.find_root()
    if wanted and not root.meta.get("debugging"):
        root.meta["debugging"] = True
        root.with_resource(debug_log())
        where = f"tcpipe {__version__}, Python {platform.python_version()}, {platform.platform()}"
        logging.getLogger("tcpipe").debug("%s: %s", where, hide_secrets(shlex.join(sys.argv[1:])))


def _debug_option(*, hidden: bool) -> Callable[[C], C]:
    """Return ``--debug``, which stands before or after the command's name."""
    about = "Say what is done and when, and where an error comes from; also after COMMAND."
    return click.option(
        "--debug", is_flag=True, is_eager=True, expose_value=False, callback=_begin_debugging, hidden=hidden, help=about
    )


@click.group(
    cls=_InOrder,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 110, "show_default": True},
)
@click.version_option(__version__, prog_name="tcpipe")
@_debug_option(hidden=False)
def cli() -> None:
    """Turn raw robot logs into datasets that a terrain-cost model can be trained on.

    \b
    tcpipe demo                                     see everything work on a simulated site
    tcpipe inspect run.mcap                         what is in this log, and what each topic is for
    tcpipe ingest run.mcap                          log to 1 m segments with power, velocity, time, energy
    tcpipe add-map site --height dem.tif --ortho ortho.tif --terrain classes.tif
    tcpipe build-dataset --split region.geojson     segments and map to samples for any trainer

    Exit codes: 0 done; 1 failed; 2 usage; 3 done in part (each failure is named, the rest is complete).
    """  # noqa: D301  \b keeps the block's lines


for command in (
    *(demo, init, inspect, preflight, ingest, status, acknowledge, prune),
    *(add_map, build_dataset, train, evaluate, reproduce, predict_path, cost_map, plan_path),
    *(report, overlay, export, explain, verify, migrate, diff, schemas, simulate),
):
    cli.add_command(_debug_option(hidden=True)(command))

_accept = copy(acknowledge)
_accept.hidden = True
cli.add_command(_accept, "accept")  # its name before data model 3.0


def main() -> None:
    """Run the command line: errors become plain lines and exit codes, never a traceback (unless ``--debug``)."""
    prepare_process()
    _run()


@ended_in_time()
def _run() -> NoReturn:
    try:
        _refuse_empty(sys.argv[1:])
        code = cli.main(prog_name="tcpipe", standalone_mode=False)
        sys.stdout.flush()
    except (click.exceptions.Abort, KeyboardInterrupt):
        _fail([f"interrupted; {NOTHING_HALF}"], 128 + signal.SIGINT)
    except Ended as ended:
        _fail([f"{ended}; {NOTHING_HALF}"], ended.exit_code)
    except click.UsageError as error:
        if not sys.argv[1:]:
            error.show()
            sys.exit(error.exit_code)
        command = error.ctx.command_path if error.ctx else "tcpipe"
        _fail([f"{error.format_message().rstrip('.')} (see {command} --help)"], error.exit_code)
    except TcpipeError as error:
        _fail([*error.problems, *_list_causes(error)], error.exit_code)
    except BrokenPipeError:
        _drop_stdout()
        sys.exit(1)
    except OSError as error:
        where = f"{error.filename}: " if error.filename else ""
        _fail([f"{where}{error.strerror or error}"], 1)
    except Exception as error:  # noqa: BLE001  the last resort
        _fail([_unforeseen(error)], 1)
    sys.exit(code if isinstance(code, int) else 0)


def _list_causes(error: TcpipeError) -> list[str]:
    """Return the findings that an error carries as lines."""
    if not error.findings:
        return []
    from tcpipe.formats.finding_lines import format_findings

    return format_findings(error.findings)


def _unforeseen(error: Exception) -> str:
    """Return what to say of a package that only an extra brings, or of a bug."""
    lacking = str(error.name).partition(".")[0] if isinstance(error, ModuleNotFoundError) else ""
    if extra := _EXTRAS.get(lacking):
        return f"{lacking} not installed, wanted by this command: pip install 'tcpipe[{extra}]'"
    return f"internal error, {type(error).__name__}: {error}; please report it (tcpipe --debug shows where)"


def _refuse_empty(arguments: list[str]) -> None:
    for argument in arguments:
        if not argument or (argument.startswith("--") and argument.endswith("=")):
            raise UsageError(f"{argument or 'an argument'} is empty; is a variable not set?")


def _fail(problems: Sequence[str], code: int) -> NoReturn:
    """Say what went wrong, with ``--json`` as an object on stdout too, and exit."""
    if "--debug" in sys.argv:
        print_traceback()
    try:
        say_failure(problems, code, as_json="--json" in sys.argv)
        sys.stdout.flush()
    except OSError:
        _drop_stdout()
    sys.exit(code)


def _drop_stdout() -> None:
    """Let what nobody can read go nowhere."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
