"""``python -m tcpipe``: the same command line."""

from tcpipe.cli import main

if __name__ == "__main__":
    main()
