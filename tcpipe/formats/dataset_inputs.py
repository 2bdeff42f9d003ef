"""The record of what a dataset is made of: its digest decides whether to build; two records are compared by entry."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, fields

from tcpipe.formats.integrity import Checksum
from tcpipe.formats.json_files import Json, digest, to_plain
from tcpipe.recipe import Recipe
from tcpipe.tables.findings import LEFT_OUT


@dataclass(frozen=True, slots=True)
class RunInputs:
    """One run of a dataset, by the content of its log and segments."""

    recipe_id: str
    robot: str
    logs: tuple[str, ...]
    """Names of its log's files."""
    sha256: str
    """Checksum of its log."""
    segments_sha256: str | None
    tags: Mapping[str, str]
    size_bytes: int = 0
    """Size of its log; 0: not recorded."""
    parts: tuple[Checksum, ...] = field(default=(), metadata=LEFT_OUT)
    """Size and sha256 of each log, in order, where several were ingested as one."""
    robot_requested: str | None = field(default=None, metadata=LEFT_OUT)
    message_definitions: str = field(default="", metadata={"json": ("",)})
    """Hash of the definitions that were given for types which the log does not define."""


@dataclass(frozen=True, slots=True)
class ExclusionInputs:
    """One list of excluded samples."""

    sha256: str
    reason: str


@dataclass(frozen=True, slots=True, kw_only=True)
class DatasetInputs:
    """Everything that a dataset is made of; files are named by the sha256 of their content."""

    versions: Mapping[str, str]
    """``results`` and ``tables``."""
    recipe: Recipe
    """Without its section ``train``."""
    runs: Mapping[str, RunInputs] = field(default_factory=dict)
    """By id."""
    robots: tuple[str, ...]
    """The robots that recorded the runs."""
    tags: Mapping[str, str] = field(default_factory=dict)
    """Tags that a run had to have."""
    maps: Mapping[str, str] = field(default_factory=dict)
    """By name: sha256 over the map's files."""
    map_names: tuple[str, ...] = ()
    """In order of priority where maps overlap; none: a dataset without patches."""
    region: Mapping[str, str] | None = None
    """By kind of polygon: the sha256 of its coordinates."""
    covariates: Mapping[str, str] = field(default_factory=dict)
    """By file: its sha256."""
    exclusions: Mapping[str, ExclusionInputs] = field(default_factory=dict)
    """By file."""
    kept_split: str | None = None
    """The sha256 of the splits of the earlier dataset, which its samples keep."""
    file_format: str
    labels: tuple[str, ...] = ()
    """Labels that every sample needs; none: the default."""
    without_patches: bool = False
    """Whether the user declined patches (``--without-patches``)."""
    without_coordinates: bool

    @property
    def parts(self) -> dict[str, str]:
        """Hash of each part, by the name of its field."""
        return {entry.name: digest([getattr(self, entry.name)]) for entry in fields(self)}

    @property
    def digest(self) -> str:
        """Hash over all of it: the same inputs make the same dataset."""
        return digest(self.parts)


@dataclass(frozen=True, slots=True)
class Change:
    """One entry of a record that differs from another's."""

    path: tuple[str, ...]
    """Field, then keys below it."""
    was: Json
    """None: it was not there."""
    now: Json
    """None: it is not there any more."""

    @property
    def name(self) -> str:
        """Keys below the field, with dots between."""
        return ".".join(self.path[1:])


def compare_records(was: DatasetInputs, now: DatasetInputs) -> Iterator[Change]:
    """Yield every entry in which two records differ, in the order of their fields."""
    yield from _compare((), to_plain(was), to_plain(now))


def _compare(path: tuple[str, ...], was: Json, now: Json) -> Iterator[Change]:
    if isinstance(was, Mapping) and isinstance(now, Mapping):
        for key in dict.fromkeys((*was, *now)):
            yield from _compare((*path, key), was.get(key), now.get(key))
    elif was != now:
        yield Change(path, was, now)


_LONGEST_VALUE = 80


def format_value(value: Json) -> str:
    """Return a value of a record as text, a long one cut, with a digest of the whole."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, Mapping):
        value = [f"{key}={item}" for key, item in value.items()]
    if isinstance(value, list | tuple):
        value = ", ".join(map(str, value))
    text = "none" if value in (None, "") else str(value)
    return text if len(text) <= _LONGEST_VALUE else f"{text[:_LONGEST_VALUE]}… ({digest(text)[:8]})"
