"""The ``tcpipe`` command as a user types it, and what it prints.

`tcpipe` runs the console script's own entry point in the process of the tests, which has loaded the libraries, with a directory,
environment and standard files of its own. Where the start of a process, signals, limits or workers that die are the thing under test,
tests start `COMMAND`, the installed one.
"""

import json
import os
import signal
import socket
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import chdir, contextmanager, suppress
from pathlib import Path
from typing import Any
from unittest.mock import patch

from json_contracts import json_output_types

from tcpipe.cli import main
from tcpipe.formats import object_storage
from tcpipe.formats.json_files import parse_typed, to_plain

COMMAND = Path(sys.executable).parent / "tcpipe"
HANGS_S = 3600.0
"""After this long a command hangs; a machine that others use takes its time."""


def tcpipe(*arguments: str | Path, cwd: Path, env: Mapping[str, str] | None = None) -> subprocess.CompletedProcess[str]:
    """Run the command; nothing of the caller's TCPIPE_ environment reaches it."""
    clean = {key: value for key, value in os.environ.items() if not key.startswith("TCPIPE_")} | dict(env or {})
    command = [str(COMMAND), *map(str, arguments)]
    if "PYTHONPATH" in (env or {}):  # which Python reads when it starts
        done = subprocess.run(command, cwd=cwd, env=clean, capture_output=True, text=True, timeout=HANGS_S, check=False)
        return _as_promised(done)
    with tempfile.TemporaryFile() as out, tempfile.TemporaryFile() as err:
        code = _run_here(command, Path(cwd), clean, out.fileno(), err.fileno())
        printed = [os.pread(stream.fileno(), os.fstat(stream.fileno()).st_size, 0).decode() for stream in (out, err)]
    return _as_promised(subprocess.CompletedProcess(command, code, *printed))


def run_script(script: str, *, cwd: Path, env: Mapping[str, str]) -> str:
    """Run a bash script of which each ``tcpipe`` is done in this process; return what all of it printed."""
    with tempfile.TemporaryDirectory() as place, socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as server:
        client = Path(place, "tcpipe")
        client.write_text(_CLIENT.format(python=sys.executable, address=f"{place}/socket"))
        client.chmod(0o755)
        server.bind(f"{place}/socket")
        server.listen()
        server.settimeout(0.01)
        path = f"{place}{os.pathsep}{env['PATH']}"
        with tempfile.TemporaryFile() as printed:
            with subprocess.Popen(
                ["bash", "-c", script], cwd=cwd, env={**env, "PATH": path}, stdout=printed, stderr=subprocess.STDOUT
            ) as running:
                while running.poll() is None:
                    with suppress(TimeoutError):
                        _serve(server.accept()[0])
            return os.pread(printed.fileno(), os.fstat(printed.fileno()).st_size, 0).decode()


_CLIENT = """#!{python} -IS
import json, os, socket, sys
with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as server:
    server.connect({address!r})
    call = json.dumps([sys.argv, os.getcwd(), dict(os.environ)]).encode()
    socket.send_fds(server, [call], [1, 2])
    code = server.recv(1)[0]
sys.exit(code)
"""


def _serve(client: socket.socket) -> None:
    """Do what one ``tcpipe`` of a script asks for, with its directory, environment and files."""
    with client:
        call, (out, err), _, _ = socket.recv_fds(client, 1 << 17, 2)
        command, cwd, env = json.loads(call)
        code = 1
        with suppress(BrokenPipeError):  # a reader, as head, that has seen enough
            code = _run_here(command, Path(cwd), env, out, err)
        for file in (out, err):
            os.close(file)
        client.send(bytes([code]))


def _run_here(command: list[str], cwd: Path, env: Mapping[str, str], out: int, err: int) -> int:
    new = patch.dict(object_storage._has_answered, clear=True)  # as in a process that has had no answer
    with chdir(cwd), patch.dict(os.environ, env, clear=True), new, _standard_files(out, err):
        return _exit_code(command)


@contextmanager
def _standard_files(out: int, err: int) -> Iterator[None]:
    """Redirect all output, of Python and of the libraries below it, to these files, with new streams."""
    kept = {number: os.dup(number) for number in (1, 2)}
    os.dup2(out, 1)
    os.dup2(err, 2)
    try:
        with (
            open(1, "w", encoding="utf-8", closefd=False) as stdout,
            open(2, "w", encoding="utf-8", closefd=False, buffering=1) as stderr,
            patch.multiple(sys, stdout=stdout, stderr=stderr),
        ):
            yield
    finally:
        for number, file in kept.items():
            os.dup2(file, number)
            os.close(file)


def _exit_code(command: list[str]) -> int:
    """Run the entry point; what it sets for its process is set back."""
    numbers = signal.SIGTERM, signal.SIGHUP
    handlers = [signal.getsignal(number) for number in numbers]
    try:
        with patch.multiple(sys, argv=command, unraisablehook=sys.unraisablehook):
            main()
    except SystemExit as ended:
        return int(ended.code or 0)
    finally:
        for number, handler in zip(numbers, handlers, strict=True):
            signal.signal(number, handler)
    raise AssertionError("the entry point returned instead of exiting")


def _as_promised(done: subprocess.CompletedProcess[str]) -> subprocess.CompletedProcess[str]:
    """Return what is given; assert that what a command printed with ``--json`` is all of its contract, and no more."""
    command, known = done.args[1], json_output_types()
    if "--json" in done.args[1:] and done.stdout.strip():
        for text in done.stdout.splitlines() if command == "ingest" else [done.stdout]:
            said = json.loads(text)
            name = "evaluation" if command == "evaluate" else f"{command}.answer"  # it prints its file
            kind = str(said.get("kind")).removeprefix("tcpipe ")
            cls = known.get(f"{kind}.answer" if kind == "failure" else f"{command}-{kind}.answer") or known.get(name)
            assert cls is not None, f"{command} --json has no contract"
            assert to_plain(parse_typed(said, cls, Path(command))) == said
    return done


def told(done: subprocess.CompletedProcess[str]) -> dict[str, Any]:
    """Return the last JSON object of ``ingest --json``, that of all logs; those before are of the same logs, one each."""
    *each, of_all = [json.loads(line) for line in done.stdout.splitlines()]
    assert {line["kind"] for line in each} <= {"log"}
    assert of_all["kind"] == "summary"
    assert sorted(line["log"] for line in each) == sorted(result["log"] for result in of_all["results"])
    return of_all


def plain_lines(done: subprocess.CompletedProcess[str], code: int, most: int = 3) -> str:
    """Assert that the command ended with ``code`` and at most ``most`` plain lines, no traceback; return stderr."""
    assert done.returncode == code, done.stderr
    assert "Traceback" not in done.stderr
    lines = [line for line in done.stderr.splitlines() if line.startswith("tcpipe:") or "FAILED" in line]
    assert 1 <= len(lines) <= most, done.stderr
    return done.stderr
