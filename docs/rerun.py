"""Run the commands of documentation pages and write what they print back into the pages.

    python docs/rerun.py docs/tutorials/first-dataset.md docs/how-to/damaged-logs.md

Blocks fenced as ``console`` hold commands after ``$ ``, blocks fenced as ``pycon`` Python after ``>>> ``; the rest of
such a block is output and is replaced. A block fenced as ``toml`` that begins with ``# tcpipe.toml`` is added to that
file. Each page runs in a directory of its own below ~: the NAME of its line ``mkdir NAME && cd NAME``, or what the page
is called. A page that goes on from another, by ``../NAME/``, finds that one followed; ``../docs/`` is this directory.
``$DATA`` is the directory of third-party files (TCPIPE_TEST_DATA). tests/end_to_end/test_docs.py runs the pages the
same way and compares, numbers aside.
"""

from __future__ import annotations

import contextlib
import functools
import io
import os
import re
import subprocess
import sys
import tempfile
from code import InteractiveConsole
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

_DOCS = Path(__file__).resolve().parent
_HOME = re.compile(r"^mkdir (\S+) && cd \1$", re.MULTILINE)
_BLOCK = re.compile(r"^```(console|pycon|toml)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
_MARK = "\x01"


@functools.cache
def rerun(page: Path, directory: Path) -> str:
    """Return a page's text with the output of its blocks replaced; they run in the page's own directory below ``directory``."""
    text, console = page.read_text(encoding="utf-8"), InteractiveConsole(locals={})
    for other in sorted(_DOCS.rglob("*.md")):
        match = _HOME.search(other.read_text(encoding="utf-8"))
        if match and f"../{match[1]}/" in text:
            rerun(other, directory)
    own = _HOME.search(text)
    home = directory / (own[1] if own else page.stem)
    home.mkdir()
    if not (link := directory / "docs").exists():
        link.symlink_to(_DOCS)

    def block(found: re.Match[str]) -> str:
        kind, body = found[1], found[2]
        if kind == "toml":
            if body.startswith("# tcpipe.toml\n"):
                with (home / "tcpipe.toml").open("a", encoding="utf-8") as recipe:
                    recipe.write(body)
            return found[0]
        output = _run_shell(body, home) if kind == "console" else _run_python(body, home, console)
        return f"```{kind}\n{output.replace(str(directory), '~')}```"

    return _BLOCK.sub(block, text)


def find_inputs(body: str, prompt: str, continues: Callable[[str, str], bool]) -> list[str]:
    """Return the inputs of a block, each with its further lines, without outputs.

    ``continues(line_before, line)`` returns whether a line belongs to the input before it.
    """
    inputs: list[list[str]] = []
    inside = False
    for line in body.splitlines():
        if inside and continues(inputs[-1][-1], line):
            inputs[-1].append(line)
        elif inside := line.startswith(prompt):
            inputs.append([line])
    return ["\n".join(lines) for lines in inputs]


def _run_shell(body: str, directory: Path) -> str:
    inputs = find_inputs(body, "$ ", lambda before, _: before.endswith("\\"))
    # The exit code of a command stays readable as $? in the next one.
    script = "".join(f"{line.removeprefix('$ ')}\nlast=$?; printf '\\001'; (exit $last)\n" for line in inputs)
    here = Path(sys.executable).parent
    clean = {key: value for key, value in os.environ.items() if not key.startswith("TCPIPE_")}
    env = {**clean, "PATH": f"{here}{os.pathsep}{os.environ['PATH']}", "DATA": str(_test_data())}
    printed = run_script(script, cwd=directory, env=env)
    outputs = printed.split(_MARK)
    if len(outputs) != len(inputs) + 1:
        raise RuntimeError(f"commands did not all end: {printed}")
    return "".join(
        f"{line}\n{_trim_output(output)}" for line, output in zip(inputs, outputs[:-1], strict=True)
    ).replace(str(_test_data()), "$DATA")


def run_script(script: str, *, cwd: Path, env: Mapping[str, str]) -> str:
    """Return what a bash script prints; the test of the pages puts its own in place of this function."""
    return subprocess.run(
        ["bash", "-c", script],  # the pages are ours
        cwd=cwd, env=env, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, timeout=3600, check=False,
    ).stdout  # fmt: skip


def _trim_output(output: str) -> str:
    """Return output as whole lines without trailing blanks, the line about compiling, and the next step (a page names its own)."""
    left_out = ("compiling numeric kernels", "next: ")
    lines = [line.rstrip() for line in output.strip("\n").splitlines() if not line.startswith(left_out)]
    return "".join(f"{line}\n" for line in lines)


def _run_python(body: str, directory: Path, console: InteractiveConsole) -> str:
    transcript = []
    with contextlib.chdir(directory):
        for block in find_inputs(body, ">>> ", lambda _, line: line.startswith("...")):
            output = io.StringIO()
            with contextlib.redirect_stdout(output), contextlib.redirect_stderr(output):
                for line in block.splitlines():
                    more = console.push(line[4:])
                if more:
                    console.push("")
            transcript.append(f"{block}\n{_trim_output(output.getvalue())}")
    return "".join(transcript)


def _test_data() -> Path:
    return Path(os.environ.get("TCPIPE_TEST_DATA", Path(__file__).resolve().parents[2] / "shared" / "data"))


def main(names: Sequence[str]) -> None:
    """Rewrite the pages named."""
    with tempfile.TemporaryDirectory() as directory:
        here = Path(directory).resolve()
        for name in names:
            page = Path(name).resolve()
            page.write_text(rerun(page, here), encoding="utf-8")
            sys.stdout.write(f"ran {page}\n")


if __name__ == "__main__":
    main(sys.argv[1:])
