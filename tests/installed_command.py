"""The installed ``tcpipe`` command, run as a user runs it.

``make test`` runs it in forks of a process that has loaded the libraries (`command_server`); with ``TEST_START=anew``, as in CI, each
call starts Python anew.
"""

import atexit
import json
import os
import socket
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

from tcpipe.cli.answers import answers
from tcpipe.formats.json_files import plain, typed

COMMAND = Path(sys.executable).parent / "tcpipe"
HANGS_S = 3600.0
"""After this long a command hangs; a machine that others use takes its time."""
_ANEW = os.environ.get("TEST_START") == "anew"
_LEARNING = {"train", "evaluate", "reproduce", "predict-path", "cost-map", "plan-path"}


def tcpipe(*arguments: str | Path, cwd: Path, env: Mapping[str, str] | None = None) -> subprocess.CompletedProcess[str]:
    """Run the command; nothing of the caller's TCPIPE_ environment reaches it."""
    clean = {key: value for key, value in os.environ.items() if not key.startswith("TCPIPE_")} | dict(env or {})
    command = [str(COMMAND), *map(str, arguments)]
    if _ANEW or "PYTHONPATH" in (env or {}):  # which Python reads when it starts
        done = subprocess.run(command, cwd=cwd, env=clean, capture_output=True, text=True, timeout=HANGS_S, check=False)
        return _as_promised(done)
    server = _server("learning" if arguments[0] in _LEARNING else "other")
    with tempfile.TemporaryFile() as out, tempfile.TemporaryFile() as err:
        request = json.dumps({"arguments": command, "cwd": str(cwd), "env": clean})
        socket.send_fds(server, [request.encode()], [out.fileno(), err.fileno()])
        code = json.loads(server.recv(100))
        printed = [os.pread(stream.fileno(), os.fstat(stream.fileno()).st_size, 0).decode() for stream in (out, err)]
    return _as_promised(subprocess.CompletedProcess(command, code, *printed))


def _as_promised(done: subprocess.CompletedProcess[str]) -> subprocess.CompletedProcess[str]:
    """Return what is given; assert that what a command printed with ``--json`` is all of its contract, and no more."""
    cls = (
        answers().get(f"{done.args[1]}.answer") if "--json" in done.args[1:] and done.returncode in {0, 1, 3} else None
    )
    if cls is not None and '"problems"' not in done.stdout[:40]:
        said = json.loads(done.stdout)
        assert plain(typed(said, cls, Path(done.args[1]))) == said
    return done


@cache
def _server(kind: str) -> socket.socket:
    """Start a server of commands, which ends with this process."""
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    ours.settimeout(HANGS_S)
    program = [sys.executable, Path(__file__).with_name("command_server.py"), str(theirs.fileno()), kind]
    with theirs:
        process = subprocess.Popen(program, pass_fds=[theirs.fileno()], stdin=subprocess.DEVNULL)
    atexit.register(process.wait)
    atexit.register(ours.close)
    return ours


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
