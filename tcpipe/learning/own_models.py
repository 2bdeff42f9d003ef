"""Models of the user's own code, loaded only where a command names them: a class or a function in a file.

A model folder never names code; it contains arrays, and the digest of the code that made them.
"""

import hashlib
import inspect
import sys
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

from tcpipe.errors import ModelError, TcpipeError, UsageError
from tcpipe.learning.predictor import Predictor


@dataclass(frozen=True, slots=True)
class OwnKind:
    """A kind of model of the user's own code."""

    source: str
    """As the user gave it."""
    digest: str
    """SHA-256 of the file."""
    kind: type[Predictor]


def load_own_kind(source: str) -> OwnKind:
    """Return the kind of model in ``FILE.py`` or ``FILE.py:NAME``; this runs its code."""
    file, _, name = source.rpartition(":") if ".py:" in source else (source, "", "")
    path = Path(file)
    if not path.is_file():
        raise UsageError(f"--predictor {source}: there is no file {path}; expected FILE.py[:NAME]")
    code = path.read_bytes()
    digest = hashlib.sha256(code).hexdigest()
    module = ModuleType(f"tcpipe_own_{digest[:16]}")
    module.__file__ = str(path.resolve())
    sys.modules[module.__name__] = module  # dataclasses look for their module there
    # Cached bytecode may be of an earlier file: run the bytes of the digest.
    with report_errors(source):
        exec(compile(code, module.__file__, "exec"), vars(module))  # noqa: S102  the user names this file
    own = {key: item for key, item in vars(module).items() if getattr(item, "__module__", "") == module.__name__}
    models = {
        key: item
        for key, item in own.items()
        if hasattr(item, "predict") or (inspect.isfunction(item) and key == "predict")
    }
    if name:
        models = {name: getattr(module, name)} if hasattr(module, name) else {}
    if len(models) != 1:
        wanted = name or "a class with a method predict, or a function predict"
        raise UsageError(
            f"--predictor {source}: has {', '.join(models) or 'no ' + wanted}; expected one: name it as {path}:NAME"
        )
    return OwnKind(source, digest, _make_kind(next(iter(models.values())), source))


def _make_kind(found: Any, source: str) -> type[Predictor]:
    """Return a class with the user's methods, and with the defaults of `Predictor` for all others."""
    if inspect.isclass(found) and hasattr(found, "predict"):
        return found if Predictor in found.__mro__ else type(found.__name__, (found, Predictor), {})
    if callable(found):
        methods = {"predict": lambda _, patches, features: found(patches, features)}
        return type(getattr(found, "__name__", "function"), (Predictor,), methods)
    raise UsageError(f"--predictor {source}: neither a class with a method predict nor a function")


@contextmanager
def report_errors(own: OwnKind | str | None) -> Iterator[None]:
    """Convert exceptions of the user's code into `ModelError` with the location; with None, do nothing."""
    source = own.source if isinstance(own, OwnKind) else own
    try:
        yield
    except ModelError as error:
        if source is None:
            raise
        raise ModelError(*(f"--predictor {source}: {problem}" for problem in error.problems)) from None
    except TcpipeError:
        raise
    except Exception as error:
        if source is None:
            raise
        frames = traceback.extract_tb(error.__traceback__)
        package = str(Path(__file__).parents[1])
        file_name = Path(source if source.endswith(".py") else source.rpartition(":")[0]).name
        in_file = next((frame for frame in reversed(frames) if Path(frame.filename).name == file_name), None)
        at = in_file or next(
            (frame for frame in reversed(frames) if not frame.filename.startswith(package)), frames[-1]
        )
        where = f"{at.filename}, line {at.lineno}, in {at.name}"
        raise ModelError(f"--predictor {source}: {type(error).__name__}: {error} ({where})") from error
