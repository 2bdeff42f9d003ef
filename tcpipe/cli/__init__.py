"""The command line. Only click is imported here; modules of commands are imported when a command is asked for."""

from __future__ import annotations

import gc
import logging
import os
import platform
import select
import shlex
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import cache
from importlib import import_module
from itertools import chain
from typing import Any, NoReturn, ParamSpec, TypeVar

import click
from click.core import ParameterSource

from tcpipe import __version__
from tcpipe.cli.output import NEXT_STEP, Failure, print_failure, print_line, print_traceback, write_debug_log
from tcpipe.errors import TcpipeError, UsageError, hide_secrets

_EXTRAS = {"torch": "train", "lightgbm": "tables", "dask": "cluster", "distributed": "cluster", "dagster": "dagster"}
"""Which extra brings a package that only some commands need."""

C = TypeVar("C", bound=Callable[..., Any])
P = ParamSpec("P")
R = TypeVar("R")


_GROUPS = {
    "Start": {
        "demo": ("site_commands", "Run all commands on a simulated site"),
        "init": ("site_commands", "Write a commented recipe"),
        "inspect": ("inspect", "List the contents of a log, map, dataset or store"),
        "preflight": ("log_commands", "Check a short test recording before a campaign"),
    },
    "From logs to a dataset": {
        "ingest": ("log_commands", "Convert logs to labelled 1 m segments"),
        "status": ("log_commands", "List the state and problems of every log"),
        "acknowledge": ("log_commands", "Do not report known problems again"),
        "add-map": ("dataset_commands", "Add the rasters of a site to the store"),
        "build-dataset": ("dataset_commands", "Build a dataset from segments and maps"),
        "prune": ("log_commands", "Remove what a store no longer needs"),
    },
    "Look and check": {
        "report": ("dataset_commands", "Write the HTML page of a run, dataset or store"),
        "overlay": ("log_commands", "Write a run as MCAP, to view with its log"),
        "export": ("dataset_commands", "Export topics as Parquet"),
        "audit": ("log_commands", "Judge a track by fixes withheld from it"),
        "explain": ("dataset_commands", "Trace a sample to its log"),
        "verify": ("dataset_commands", "Read all files again, compare counts and checksums"),
        "diff": ("dataset_commands", "List the differences of two datasets, by cause"),
    },
    "Models and plans": {
        "train": ("model_commands", "Train a model on a dataset"),
        "evaluate": ("model_commands", "Evaluate a model and compare it with the paper"),
        "benchmark": ("model_commands", "Compare all kinds of model on datasets"),
        "predict-path": ("model_commands", "Predict time and energy of a path"),
        "plan-path": ("model_commands", "Plan the path of least energy, time or distance"),
        "cost-map": ("model_commands", "Compute directional cost maps of a whole map"),
        "route-graph": ("model_commands", "Write costs into a Nav2 route graph"),
        "simulate": ("site_commands", "Write a simulated site with its true values"),
        "reproduce": ("model_commands", "Repeat the paper's experiment on a simulated site"),
    },
}
"""Module and purpose of each command, in groups, in the order a user meets them; the command NAME-X is the function
NAME_X there."""
_NEXT_STEPS = {
    "demo": "tcpipe train {directory}/dataset",
    "preflight": "tcpipe ingest {log}",
    "ingest": "tcpipe report{store}, then tcpipe add-map or tcpipe build-dataset{store}",
    "status": "tcpipe report{store}",
    "acknowledge": "tcpipe status{store}",
    "add-map": "tcpipe build-dataset --split REGION.geojson{store}",
    "build-dataset": "tcpipe report {out}, then tcpipe train {out}",
    "prune": "tcpipe status{store}",
    "report": "open the first page in a browser",
    "overlay": "open {out} and its log in Foxglove",
    "export": "read {out} with pandas, polars or DuckDB",
    "audit": "tcpipe report{store}",
    "explain": "tcpipe report {dataset} shows its patch and map",
    "verify": "tcpipe diff A B compares two datasets",
    "diff": "tcpipe explain SAMPLE_ID --dataset {b}",
    "train": "tcpipe evaluate {out} {dataset}",
    "evaluate": "tcpipe predict-path {model} --path PATH.geojson{store}",
    "benchmark": "open {out}/benchmark.html",
    "predict-path": "tcpipe plan-path {model} --from LON,LAT --to LON,LAT{store}",
    "plan-path": "tcpipe predict-path {model} --path {out}{store}",
    "cost-map": "tcpipe plan-path {model} --cost-map {out} --from LON,LAT --to LON,LAT{store}",
    "route-graph": "load {out} into the route server of Nav2",
    "simulate": "tcpipe ingest {out}/logs",
    "reproduce": "open {directory}/reproduction.html",
}
"""Next step after the success of a command; the parameters of its call fill the braces."""
_WIDTH = max(map(len, chain.from_iterable(_GROUPS.values())))
_COMMANDS = {name: entry for group in _GROUPS.values() for name, entry in group.items()}


class _Commands(Mapping[str, click.Command]):
    """Commands by name; each is imported on demand, so that ``--help`` and every other command start fast."""

    def __getitem__(self, name: str) -> click.Command:
        return _load(name, *_COMMANDS[name])

    def __iter__(self) -> Iterator[str]:
        return iter(_COMMANDS)

    def __len__(self) -> int:
        return len(_COMMANDS)


@cache
def _load(name: str, module: str, about: str) -> click.Command:
    command: click.Command = getattr(import_module(f"tcpipe.cli.{module}"), name.replace("-", "_"))
    command.short_help = about
    if command.callback:
        command.callback = _name_next_step(_NEXT_STEPS.get(name, ""), command.callback)
    return _debug_option(hidden=True)(command)


def _name_next_step(text: str, run: Callable[P, R]) -> Callable[P, R]:
    """Return a command that prints on stderr what to do after its success; it may replace the text (`NEXT_STEP`)."""

    def call(*args: P.args, **kwargs: P.kwargs) -> R:
        code, context = run(*args, **kwargs), click.get_current_context()
        given = {name: shlex.quote(str(value)) for name, value in context.params.items()}
        is_named = context.get_parameter_source("store") is ParameterSource.COMMANDLINE
        store = f" --store {given['store']}" if is_named else ""
        step = context.meta.get(NEXT_STEP, text).format(**given | {"store": store})
        if step and not (code or context.params.get("as_json") or context.params.get("quiet")):
            print_line(f"next: {step}", err=True)
        return code

    return call


class _Group(click.Group):
    """Lists commands in the order a user meets them, without importing them."""

    def __init__(self, *arguments: Any, **settings: Any) -> None:
        super().__init__(*arguments, **settings)
        self.commands = _Commands()  # type: ignore[assignment]  # nothing is added

    def list_commands(self, ctx: click.Context) -> list[str]:  # noqa: ARG002  click's signature
        return list(self.commands)

    def format_commands(  # click's signature
        self,
        ctx: click.Context,  # noqa: ARG002
        formatter: click.HelpFormatter,
    ) -> None:
        for title, group in _GROUPS.items():
            with formatter.section(title):
                formatter.write_dl([(name.ljust(_WIDTH), about) for name, (_, about) in group.items()])


def _begin_debugging(
    context: click.Context,
    _: click.Parameter,
    wanted: bool,  # noqa: FBT001  click's signature
) -> None:
    root = context.find_root()
    if wanted and not root.meta.get("debugging"):
        root.meta["debugging"] = True
        root.with_resource(write_debug_log())
        where = f"tcpipe {__version__}, Python {platform.python_version()}, {platform.platform()}"
        logging.getLogger("tcpipe").debug("%s: %s", where, hide_secrets(shlex.join(sys.argv[1:])))


def _debug_option(*, hidden: bool) -> Callable[[C], C]:
    """Return ``--debug``, which is accepted before and after the command's name."""
    about = "Log each step with its time, and print the traceback of an error; also after COMMAND."
    return click.option(
        "--debug", is_flag=True, is_eager=True, expose_value=False, callback=_begin_debugging, hidden=hidden, help=about
    )


@click.group(
    cls=_Group, context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 110, "show_default": True}
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


_NOTHING_HALF = "no output is incomplete; run the same command again"
_LATEST_S = 4.0
"""Longest time for an orderly end [s]: a library that waits for a network or computes passes no signal to Python."""


_RECEIVED = list[int]()  # signals that ask this call to end; an import that one interrupts may fail with another error


class Terminated(BaseException):
    """A signal asks this process to end; raised where it runs, so that workers and temporary files are cleaned up."""

    def __init__(self, number: int) -> None:
        super().__init__(f"ended by {signal.Signals(number).name}")
        self.exit_code = 128 + number


def prepare_process() -> None:
    """Open standard files that are closed, print undecodable bytes as escapes, and end in order on SIGTERM and SIGHUP.

    Linear algebra gets one thread, unless the environment states otherwise: matrices here are small, more threads only
    wait for each other, and bytes would depend on their number. The cyclic garbage collector runs 70 times less often
    than by default: while numba compiles, it took a tenth of the time.
    """
    gc.set_threshold(50_000)
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    while (opened := os.open(os.devnull, os.O_RDWR)) <= 2:  # else a data file could become standard error
        pass
    os.close(opened)
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))  # noqa: SIM115, PTH123
        getattr(sys, name).reconfigure(errors="backslashreplace")
    for number in (signal.SIGTERM, signal.SIGHUP):
        if signal.getsignal(number) is not signal.SIG_IGN:  # nohup
            signal.signal(number, _end)
    sys.unraisablehook = _raise_again


@contextmanager
def terminate_on_signal() -> Iterator[None]:
    """End this process on a signal even inside a library that ignores it; the next call removes its remains."""
    read_end, write_end = os.pipe()
    os.set_blocking(write_end, False)
    before = signal.set_wakeup_fd(write_end, warn_on_full_buffer=False)
    threading.Thread(target=_watch, args=(read_end,), daemon=True).start()
    try:
        yield
    finally:
        signal.set_wakeup_fd(before)
        os.close(write_end)


def _watch(read_end: int) -> None:
    """Wait for a signal, and then for the other end to be closed, but not too long."""
    end, ending, left_s = 0.0, 0, None
    while select.select([read_end], [], [], left_s)[0]:
        if not (received := os.read(read_end, 1)):
            os.close(read_end)
            return
        if not ending and received[0] in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            end, ending = time.monotonic() + _LATEST_S, received[0]
            _RECEIVED.append(ending)
        left_s = max(0.0, end - time.monotonic()) if ending else None
    failure = Failure(128 + ending, (f"{Terminated(ending)}; {_NOTHING_HALF}",), transient=True)
    print_failure(failure, as_json="--json" in sys.argv)
    os._exit(failure.exit_code)


def _end(number: int, _: object) -> None:
    raise Terminated(number)


def _raise_again(unraisable: sys.UnraisableHookArgs) -> None:
    """Raise a signal again if it came in a place that ignores errors (a destructor, a callback)."""
    error = unraisable.exc_value
    if not isinstance(error, Terminated | KeyboardInterrupt):
        sys.__unraisablehook__(unraisable)
        return

    def raise_it(_: int, __: object) -> None:
        raise error

    signal.signal(signal.SIGALRM, raise_it)
    signal.setitimer(signal.ITIMER_REAL, 0.01)


def main() -> None:
    """Run the command line: errors become plain lines and exit codes, never a traceback (unless ``--debug``)."""
    try:
        prepare_process()
        _run()
    except Terminated as ended:  # before a command begins
        _fail([f"{ended}; {_NOTHING_HALF}"], ended.exit_code, ended)


@terminate_on_signal()
def _run() -> NoReturn:
    _RECEIVED.clear()
    try:
        _refuse_empty(sys.argv[1:])
        code = cli.main(prog_name="tcpipe", standalone_mode=False)
        sys.stdout.flush()
    except (click.exceptions.Abort, KeyboardInterrupt) as interrupt:
        _fail([f"interrupted; {_NOTHING_HALF}"], 128 + signal.SIGINT, interrupt)
    except Terminated as ended:
        _fail([f"{ended}; {_NOTHING_HALF}"], ended.exit_code, ended)
    except click.UsageError as error:
        if not sys.argv[1:]:
            error.show()
            sys.exit(error.exit_code)
        command = error.ctx.command_path if error.ctx else "tcpipe"
        _fail([f"{error.format_message().rstrip('.')} (see {command} --help)"], error.exit_code, error)
    except TcpipeError as error:
        _fail([*error.problems, *_list_causes(error)], error.exit_code, error)
    except BrokenPipeError:
        _drop_stdout()
        sys.exit(1)
    except OSError as error:
        where = f"{error.filename}: " if error.filename else ""
        _fail([f"{where}{error.strerror or error}"], 1, error)
    except Exception as error:  # noqa: BLE001  the last resort
        time.sleep(0.05)  # until the thread that watches for signals has run
        if _RECEIVED:
            _fail([f"{Terminated(_RECEIVED[0])}; {_NOTHING_HALF}"], 128 + _RECEIVED[0], error)
        _fail([_describe_unforeseen(error)], 1, error)
    sys.exit(code if isinstance(code, int) else 0)


def _list_causes(error: TcpipeError) -> list[str]:
    """Return the findings that an error carries as lines."""
    if not error.findings:
        return []
    from tcpipe.formats.finding_lines import format_findings

    return format_findings(error.findings)


def _describe_unforeseen(error: Exception) -> str:
    """Return the message for a package that only an extra installs, or for a bug."""
    lacking = str(error.name).partition(".")[0] if isinstance(error, ModuleNotFoundError) else ""
    if extra := _EXTRAS.get(lacking):
        return f"{lacking} not installed, required by this command: pip install 'tcpipe[{extra}]'"
    return f"internal error, {type(error).__name__}: {error}; please report it (tcpipe --debug shows where)"


def _refuse_empty(arguments: list[str]) -> None:
    for argument in arguments:
        if not argument or (argument.startswith("--") and argument.endswith("=")):
            raise UsageError(f"{argument or 'an argument'} is empty; is a variable not set?")


def _fail(problems: Sequence[str], code: int, error: BaseException) -> NoReturn:
    """Print the problems, with ``--json`` as an object on stdout too, and exit."""
    if "--debug" in sys.argv:
        print_traceback()
    try:
        print_failure(Failure(code, tuple(problems), _is_transient(error)), as_json="--json" in sys.argv)
        sys.stdout.flush()
    except OSError:
        _drop_stdout()
    sys.exit(code)


def _is_transient(error: BaseException) -> bool:
    """Return whether the same call may succeed later; not for an impossible call or a missing package."""
    if isinstance(error, click.exceptions.Abort | KeyboardInterrupt | Terminated):
        return True
    if isinstance(error, click.UsageError | UsageError | ModuleNotFoundError):
        return False
    from tcpipe.pipeline.log_sources import is_transient

    return is_transient(error)


def _drop_stdout() -> None:
    """Discard output after the reader closed the pipe."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
