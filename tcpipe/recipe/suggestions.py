"""The parts of a recipe that messages suggest: made here alone, by the recipe's own rules, so that what is suggested is accepted."""

from __future__ import annotations

import shlex
import tomllib
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from math import isfinite
from typing import TypeAlias

from tcpipe.errors import RecipeError, clean_line
from tcpipe.recipe import Recipe
from tcpipe.recipe.checking import TO_MEASURE, as_toml, from_values, read_annotations
from tcpipe.tables.findings import Remedy

TomlValue: TypeAlias = "bool | float | str | Sequence[TomlValue] | Mapping[str, TomlValue]"
Keys: TypeAlias = Mapping[str, TomlValue]


@dataclass(frozen=True, slots=True)
class RecipeFragment:
    """A part of a recipe: the keys of each table by its dotted name, as ``read.time_offset_s``; an array of tables as a list of them.

    ``is_checked``: this recipe, or that of the version which wrote it, has accepted it. `RecipeError`: the recipe rejects it.
    """

    tables: Mapping[str, Keys | Sequence[Keys]]
    is_checked: bool = False

    def __post_init__(self) -> None:
        """Check it as a recipe that holds nothing else."""
        if not self.is_checked:
            try:
                from_values(Recipe, tomllib.loads(self.toml().replace(TO_MEASURE, "0.0")), where="suggested recipe")
            except tomllib.TOMLDecodeError as error:
                raise RecipeError(f"suggested recipe: {error}") from None

    def inline(self) -> str:
        """Return it inside a sentence, as ``[read] imu_units = "deg"``."""
        return " and ".join(f"{head} {', '.join(lines)}" for head, lines in self._format_tables())

    def toml(self) -> str:
        """Return it as lines of a recipe."""
        return "\n".join(line for head, lines in self._format_tables() for line in (head, *lines))

    def _format_tables(self) -> Iterator[tuple[str, list[str]]]:
        for name, tables in self.tables.items():
            is_one = isinstance(tables, Mapping)
            for keys in [tables] if isinstance(tables, Mapping) else tables:
                lines = [f"{key} = {as_toml(value)}" for key, value in keys.items()]
                yield f"[{name}]" if is_one else f"[[{name}]]", lines


@dataclass(frozen=True, slots=True)
class ProposedLine:
    """One line of a recipe that is proposed for a log; one that a person has to decide is a comment.

    ``table`` is the dotted name of its table, "" for keys before all tables; ``note`` is a value of the log, or what there is to decide.
    """

    table: str
    key: str
    value: TomlValue
    note: str = ""
    is_certain: bool = True


@dataclass(frozen=True, slots=True)
class ProposedRecipe:
    """The recipe that is proposed for a log: the comment above it, its lines, and a path to try it on."""

    head: Sequence[str]
    lines: Sequence[ProposedLine]
    log: str

    def __str__(self) -> str:
        """Return what is left to do."""
        decisions = sum(not line.is_certain for line in self.lines)
        left = f"{decisions} comments in it are yours to decide; " if decisions else ""
        return f"{left}then: tcpipe preflight {shlex.quote(self.log)}"

    def toml(self) -> str:
        """Return the file. The head of a table of decisions alone is a comment too; those of ``read`` and ``mask`` may be empty."""
        is_open = any(not line.is_certain for line in self.lines)
        what = " Comments below it need a decision: remove the # and correct the value." if is_open else ""
        text = [f"# Proposed by tcpipe init --from.{what}", *(f"# {clean_line(line)}".rstrip() for line in self.head)]
        tables = dict.fromkeys(line.table for line in sorted(self.lines, key=lambda line: bool(line.table)))
        for table in tables:
            mine = [line for line in self.lines if line.table == table]
            is_head = any(line.is_certain for line in mine) or table.startswith(("read.", "mask"))
            text += ["", *([f"{'' if is_head else '# '}[{table}]"] if table else [])]
            for line in mine:
                note = f"  # {' '.join(line.note.split())}" if line.note else ""
                text.append(f"{'' if line.is_certain else '# '}{line.key} = {as_toml(line.value)}{note}")
        return "\n".join(text) + "\n"


def propose_lines(
    tables: Mapping[str, Keys | Sequence[Keys]], notes: Mapping[str, str], doubt: str
) -> Iterator[ProposedLine]:
    """Yield the lines of a remedy's tables; ``notes`` are by the name of a key or an array, ``doubt`` is what they leave to a person."""
    for table, keys in tables.items():
        if not isinstance(keys, Mapping):
            yield ProposedLine("", table, keys, "; ".join(filter(None, [notes.get(table), doubt])), not doubt)
            continue
        for key, value in keys.items():
            inner = (
                {f"{key}.{name}": text for name, text in value.items()} if isinstance(value, Mapping) else {key: value}
            )
            for name, text in inner.items():
                yield ProposedLine(table, name, text, notes.get(name.rpartition(".")[2], doubt), not doubt)


def propose_decisions(
    frames: Iterable[tuple[str, str]], roles: Collection[str], *, keeps_reversing: bool = False
) -> Iterator[ProposedLine]:
    """Yield what only a person knows: where sensors are mounted, by role and frame, and whether a robot with fixes alone reversed."""
    for role, frame in frames:
        note = f"measure it from base_link: nothing places {frame or 'it'}"
        yield ProposedLine("read.extrinsics", role, make_place_to_measure(role), note, is_certain=False)
    if not keeps_reversing and "gnss" in roles and not {"wheel_odometry", "visual_odometry"} & {*roles}:
        note = "if it never reversed: fixes alone do not tell forward from backward"
        yield ProposedLine("mask", "keep_reversing", True, note, is_certain=False)


def make_place_to_measure(role: str) -> Keys:
    """Return the extrinsics of a sensor as keys whose values the user must measure; an antenna has no rotation."""
    return dict.fromkeys(("xyz_m",) if role == "gnss" else ("xyz_m", "rpy_rad"), (TO_MEASURE,) * 3)


def propose_quality(table: str, key: str, source: str) -> ProposedLine:
    """Return the line of a fix quality whose codes no name states."""
    note = "if these are its codes; else rtklib, ublox, mavlink, navsat, gps_common or words"
    return ProposedLine(table, key, source, note, is_certain=False)


def format_first(values: Iterable[float]) -> str:
    """Return the first number that is not zero, as a sample."""
    return f"{next((value for value in map(float, values) if value and isfinite(value)), 0.0):.7g}"


def suggest(name: str, tables: Mapping[str, Keys | Sequence[Keys]]) -> tuple[Remedy, ...]:
    """Return a remedy that changes keys of the recipe; none where the recipe would reject them.

    ``name`` is a key in the catalogue's ``remedies`` of the finding's code; ``tables`` are as those of `RecipeFragment`.
    """
    try:
        RecipeFragment(tables)
    except RecipeError:
        return ()
    return (Remedy(name, recipe=tables),)


@cache
def format_recipe_key(name: str) -> str:
    """Return the dotted name of a key whose value only the reader knows, as a message names it; `RecipeError` for another name."""
    section, _, key = name.partition(".")
    known = read_annotations(Recipe)
    if section not in known or (key and key not in read_annotations(known[section])):
        raise RecipeError(f"there is no key {name} in a recipe")
    return f"recipe key {name}"
