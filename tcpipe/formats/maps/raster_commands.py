"""Commands of the installation (``rio``, the shell) that correct a raster, for messages."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

_MAX_COLOURS = 32
"""Most colours that are proposed as classes."""


def describe_colours(colours: NDArray[np.int64], path: Path, bands: Sequence[int]) -> str:
    """Return the problem that classes are shown by colours, with the commands that make each a value, and a table of them."""
    values, counts = np.unique(colours, return_counts=True)
    names = {value: f"#{value:06x}" for value in sorted(values[np.argsort(-counts)][:_MAX_COLOURS].tolist())}
    r, g, b = (f"(read 1 {band} 'int32')" for band in bands)
    return (
        f"{path}: has bands of red, green and blue, expected one of class values; make each colour a value: rio calc --not-masked "
        f'"(+ (* 65536 {r}) (* 256 {g}) {b})" {shlex.quote(str(path))} classes.tif --dtype int32; write a table of the commonest of '
        f"{len(values)} colours: {make_table_command(names)}; fill in each ? and use --terrain classes.tif --classes classes.csv"
    )


def make_table_command(names: Mapping[int, str]) -> str:
    """Return the shell command that writes a class table of named values; each ``?`` has to be filled in before the table is read."""
    rows = [f"{value},{number},{name},?" for number, (value, name) in enumerate(names.items(), 1)]
    quoted = " ".join(f'"{row}"' for row in ("value,id,name,traversable", *rows))
    return f'printf "%s\\n" {quoted} > classes.csv'


def suggest_bytes(nodata: float | None, path: Path, highest: float) -> str:
    """Return the command that writes an orthophoto with 8 bits: values from 0 to ``highest`` as 1 to 255, no data as 0."""
    text = f"(where (> (read 1) {highest:.6g}) 255 (+ 1 (* {254.0 / highest:.6g} (read 1))))"
    options = [] if nodata is None else ["--co", "nodata=0"]
    if nodata is not None and not np.isnan(nodata):  # NaN becomes 0 by itself
        text = f"(where (== (read 1) {nodata:.9g}) 0 {text})"
    files = [str(path), str(path.with_name(f"{path.stem}-8bit.tif"))]
    return shlex.join(["rio", "calc", "--not-masked", "--dtype", "uint8", *options, text, *files])


def suggest_nodata(dataset: Any, path: Path, scale: tuple[float, float], value: float) -> str:
    """Return the command that declares a value as no data; none if a mask, or nodata of several bands prevents it."""
    nodata = None if dataset.nodata is None or np.isnan(dataset.nodata) else f"{dataset.nodata:.9g}"
    has_mask = any(flag.name == "per_dataset" for flag in dataset.mask_flag_enums[0])
    if has_mask or (nodata and dataset.count > 1):
        return ""
    raw, copy = f"{(value - scale[1]) / scale[0]:.9g}", path.with_stem(f"{path.stem}-nodata")
    changed = ["calc", "--not-masked", f"(where (== (read 1) {raw}) {nodata} (read 1))", str(path), str(copy)]
    return shlex.join(["rio", *(changed if nodata else ["edit-info", "--nodata", raw, str(path)])])
