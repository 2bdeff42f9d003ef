"""Models of the user's own code, loaded only where a command names them: a class or a function in a file, or an entry point.

A folder of a model never names code; it has arrays, and the digest of the code that made them.
"""

from __future__ import annotations

import hashlib
import inspect
import logging
import sys
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.metadata import entry_points
from pathlib import Path
from types import ModuleType
from typing import Any

from tcpipe.errors import ModelError, TcpipeError, UsageError
from tcpipe.learning.predictor import Predictor

logger = logging.getLogger("tcpipe")

GROUP = "tcpipe.predictors"
"""Group of entry points of packages that bring models."""


@dataclass(frozen=True, slots=True)
class OwnKind:
    """A kind of model of the user's own code."""

    source: str
    """As the user gave it."""
    digest: str
    """Of the file's bytes; of a package its name and version."""
    kind: type[Predictor]


def load_own_kind(source: str) -> OwnKind:
    """Return the kind of model that ``FILE.py``, ``FILE.py:NAME`` or the name of an entry point stands for; this runs its code."""
    path, name = source, ""
    if not source.endswith(".py") and ".py:" in source:
        path, _, name = source.rpartition(":")
    if path.endswith(".py"):
        return _load_file(source, Path(path), name)
    points = {point.name: point for point in entry_points(group=GROUP)}
    if source not in points:
        found = ", ".join(sorted(points)) or "none"
        raise UsageError(
            f"--predictor {source}: no such entry point of group {GROUP} (there are: {found}); give one, or FILE.py[:NAME]"
        )
    point = points[source]
    with report_errors(source):
        found = point.load()
    digest = f"{point.dist.name} {point.dist.version}" if point.dist is not None else point.value
    return OwnKind(source, digest, _make_kind(found, source))


def _load_file(source: str, path: Path, name: str) -> OwnKind:
    if not path.is_file():
        raise UsageError(f"--predictor {source}: there is no file {path}")
    code = path.read_bytes()
    digest = hashlib.sha256(code).hexdigest()
    module = ModuleType(f"tcpipe_own_{digest[:16]}")
    module.__file__ = str(path.resolve())
    sys.modules[module.__name__] = module  # dataclasses look for their module there
    # Bytecode in a cache may be of an earlier file: what runs is what the digest is of.
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
    """Return a class with every method of `Predictor`: those of the user, and the defaults."""
    if inspect.isclass(found) and hasattr(found, "predict"):
        return found if Predictor in found.__mro__ else type(found.__name__, (found, Predictor), {})
    if callable(found):
        methods = {"predict": lambda _, patches, features: found(patches, features)}
        return type(getattr(found, "__name__", "function"), (Predictor,), methods)
    raise UsageError(f"--predictor {source}: neither a class with a method predict nor a function")


@contextmanager
def report_errors(own: OwnKind | str | None) -> Iterator[None]:
    """Turn what the user's code raises into a `ModelError` that says where; None: no such code runs."""
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
        in_file = next((frame for frame in reversed(frames) if Path(frame.filename).name == _file_name(source)), None)
        at = in_file or next(
            (frame for frame in reversed(frames) if not frame.filename.startswith(package)), frames[-1]
        )
        where = f"{at.filename}, line {at.lineno}, in {at.name}"
        raise ModelError(f"--predictor {source}: {type(error).__name__}: {error} ({where})") from error


def _file_name(source: str) -> str:
    return Path(source if source.endswith(".py") else source.rpartition(":")[0]).name
