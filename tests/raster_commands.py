"""Follow a message that names a ``rio`` command: run the command as a user would type it."""

import re
import shlex
import subprocess
import sys
from pathlib import Path


def run_rio(message: str, directory: Path, **placeholders: str) -> None:
    """Run the first ``rio`` command in a message, with words such as ``in.tif`` replaced by what a user puts there."""
    (command, *_) = re.findall(r"\brio (?:[^()\"]|\"[^\"]*\")+", message)
    words = shlex.split(re.split(r"[;,] ", command)[0].rstrip(". "))
    program = Path(sys.executable).with_name("rio")
    words = [placeholders.get(word.replace(".", "_"), word) for word in words[1:]]
    words = [
        name
        for word in words
        for name in (sorted(path.name for path in directory.glob(word)) if word == "*.tif" else [word])
    ]
    subprocess.run([program, *words], cwd=directory, check=True, capture_output=True)
