"""Follow a message that names a ``rio`` command: run the command as a user would type it."""

import re
import shlex
import warnings
from contextlib import chdir
from pathlib import Path

from click.testing import CliRunner
from rasterio.rio.main import main_group


def run_rio(message: str, directory: Path, **placeholders: str) -> None:
    """Run the first ``rio`` command in a message, with words such as ``in.tif`` replaced by what a user puts there."""
    (command, *_) = re.findall(r"\brio (?:[^()\"]|\"[^\"]*\")+", message)
    words = shlex.split(re.split(r"[;,] ", command)[0].rstrip(". "))
    words = [placeholders.get(word.replace(".", "_"), word) for word in words[1:]]
    words = [
        name
        for word in words
        for name in (sorted(path.name for path in directory.glob(word)) if word == "*.tif" else [word])
    ]
    with chdir(directory), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of rasterio's own commands
        done = CliRunner().invoke(main_group, words)
    assert done.exit_code == 0, done.output
