"""A process that has the command's imports behind it, and in a fork becomes the installed command, once for each call.

What runs is the console script's own entry point, in a process of its own with its own directory, environment and output; the test is
only spared the seconds in which Python loads libraries. How a command starts, and what signals, limits and other users do to it, is
tested with the true one; CI starts all of them anew (`installed_command`).
"""

import importlib
import json
import os
import pkgutil
import socket
import sys
from importlib.metadata import entry_points

import tcpipe

LEARNING = ("tcpipe.learning", "tcpipe.planning", "tcpipe.dataset.torch_data")


def serve(connection, *, learning):
    """Fork for each request; return what the command exits with in a fork, and nothing when no more requests come."""
    (script,) = entry_points(group="console_scripts", name="tcpipe")
    main = script.load()
    for module in pkgutil.walk_packages(tcpipe.__path__, "tcpipe."):
        if module.name != "tcpipe.__main__" and (learning or not module.name.startswith(LEARNING)):
            importlib.import_module(module.name)
    if learning:
        importlib.import_module("keras")
    while True:
        request, files, *_ = socket.recv_fds(connection, 1 << 20, 2)
        if not request:
            return None
        child = os.fork()
        if not child:
            connection.close()
            return _become(main, files, **json.loads(request))
        for file in files:
            os.close(file)
        connection.send(json.dumps(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])).encode())


def _become(main, files, *, arguments, cwd, env):
    for file, number in zip(files, (1, 2), strict=True):
        os.dup2(file, number)
        os.close(file)
    os.chdir(cwd)
    os.environ.clear()
    os.environ.update(env)
    sys.argv = arguments
    return main()


if __name__ == "__main__":
    sys.exit(serve(socket.socket(fileno=int(sys.argv[1])), learning=sys.argv[2] == "learning"))
