"""The program ``tcpipe``, also as ``python -m tcpipe``."""

import sys


def main() -> None:
    """Run the command line; an interrupt while it is loaded ends it in one line with exit code 130."""
    try:
        from tcpipe.cli import main as run  # noqa: PLC0415  its own interrupts are handled there

        run()
    except KeyboardInterrupt:
        sys.stderr.write("tcpipe: interrupted before the command began\n")
        sys.exit(130)


if __name__ == "__main__":
    main()
