"""What a folder of tables could be: a recipe's tables, proposed by what the columns and files are called."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from tcpipe.errors import LogError
from tcpipe.logs.field_names import CALLED, match_field_names
from tcpipe.recipe.checking import as_toml


@dataclass(frozen=True, slots=True, kw_only=True)
class InspectedTables:
    """A folder of tables that no recipe maps: what they hold, and the recipe that is proposed."""

    kind: Literal["tables"] = "tables"
    path: str
    columns: Mapping[str, tuple[str, ...]]
    """By file, what its columns are called."""
    problems: Mapping[str, str]
    """By file, why it cannot be read."""
    recipe: str
    """TOML; "" where no column says what it is."""


_COMMAND = re.compile(r"cmd|command|joy")
_BARE = {"voltage": re.compile(r"volt"), "current": re.compile(r"curr|amp")}
_STAMP = re.compile(r"t|stamp|.*time(stamp)?.*|gpst|utc|date")


def propose_tables(folder: Path, files: Sequence[Path]) -> InspectedTables:
    """Return the columns of each table, why some cannot be read, and a recipe for the rest."""
    from tcpipe.formats.tables import read_column_names  # noqa: PLC0415  polars only where a table is read

    columns: dict[str, tuple[str, ...]] = {}
    problems: dict[str, str] = {}
    for file in files:
        name = file.relative_to(folder).as_posix()
        try:
            columns[name] = tuple(read_column_names(file))
        except LogError as error:
            problems[name] = str(error)
    return InspectedTables(
        path=str(folder), columns=columns, problems=problems, recipe="\n".join(_iterate_recipe_lines(columns))
    )


def _iterate_recipe_lines(columns: Mapping[str, Sequence[str]]) -> Iterator[str]:
    """Yield the lines of the recipe; of two tables for one role the second is a comment."""
    taken: set[str] = set()
    for file, names in columns.items():
        role, found = _match_role(file, names)
        if role is None:
            continue
        stamp = next((name for name in names if _STAMP.fullmatch(name.lower())), names[0])
        alone = role == "power" and len(found) == 1
        table = re.sub(r"\W+", "_", Path(file).stem) if alone else role
        kind = "power of drives" if alone else "power of a battery" if role == "power" else role
        once = role == "power" and alone and "power of a battery" not in taken
        again = "" if once or role not in taken else "# "
        taken |= {role, kind}
        yield from ("", f"# {role} is taken already; one of both:") if again else ("",)
        yield f"{again}[tables.{table}]"
        yield from (f'{again}role = "power"',) if alone else ()
        yield f"{again}file = {as_toml(file)}"
        yield f"{again}columns = {{ {', '.join(f'{field} = {as_toml(name)}' for field, name in found.items())} }}"
        yield f"{again}stamp = {as_toml(stamp)}"


def _match_role(file: str, names: Sequence[str]) -> tuple[str | None, dict[str, str]]:
    """Return the role that a table plays by its columns, and which column is which field."""
    for role in CALLED:
        if (role in ("command", "wheel_odometry")) and (role == "command") != bool(_COMMAND.search(file.lower())):
            continue
        found = match_field_names(role, names)
        if found and (role != "power" or len(found) == 2):
            return role, found
    for quantity, word in _BARE.items():
        if word.search(Path(file).stem.lower()) and len(names) == 2:
            return "power", {quantity: names[1]}
    return None, {}
