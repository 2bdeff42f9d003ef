"""A whole map's directional costs as files, block by block, resumable, in bounded memory.

::

    cost-map.json                      what it is made from, courses, reasons, shares, checksums
    power.tif velocity.tif             [W], [m/s]: a band a course, then min, mean, best course, std over the trusted courses
    duration.tif energy.tif            [s/m], [J/m]: the same
    reasons.tif                        `Reason` bits: a band a course, then those that all courses share
    height.tif                         of the cells' middles [m]
    duration.{yaml,pgm} energy.{…}     Nav2 maps of the mean over the trusted courses
    duration.qml energy.qml            how QGIS shows duration.tif and energy.tif: the mean, by colour
"""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from shutil import rmtree
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from tcpipe.cost.prediction_errors import Errors
from tcpipe.errors import MapError, StoreError, UsageError, clean_lines
from tcpipe.formats.atomic import clear_beside, lock_directory, write_atomic_directory, write_text
from tcpipe.formats.integrity import Checksum, compute_checksums, read_sealed_as, write_sealed
from tcpipe.formats.json_files import digest, read_json, write_json
from tcpipe.formats.maps.geotiff import read_bands, write_cog
from tcpipe.formats.maps.map_files import MapFile
from tcpipe.formats.maps.nav2 import HIGHEST, LETHAL, make_raster_style, write_nav2_map
from tcpipe.formats.object_storage import is_url
from tcpipe.formats.place import Place, find_wrong_files
from tcpipe.formats.published_outputs import fetch_directory, find_newest, write_output
from tcpipe.learning.models import Model
from tcpipe.planning.cost_grid import (
    ANGLES_DEG,
    BARRED,
    COURSES,
    CellFrames,
    Cells,
    CostGrid,
    iterate_blocks,
    iterate_row_strips,
    make_empty_grid,
    make_grid,
    read_classes,
)
from tcpipe.planning.cost_model import Reason, check_model, iterate_predictions
from tcpipe.planning.frames import Frame, make_frame
from tcpipe.tables.bits import flag_name
from tcpipe.terrain.target_grid import MapGrid

logger = logging.getLogger("tcpipe")

Floats32 = NDArray[np.float32]

Step: TypeAlias = Callable[[int, int], None]

CARD = "cost-map.json"
KIND = "tcpipe cost map"
VERSION = "1.3"

_BLOCKS_KEPT = 8
"""Blocks after which what is done is on disk."""

_QUANTITIES = {"power": "W", "velocity": "m/s", "duration": "s/m", "energy": "J/m"}
_BAND_NAMES = tuple(f"course {angle:.1f} deg" for angle in ANGLES_DEG)
_MEAN_BAND = COURSES + 2
AGGREGATION = "mean over the courses without a reason"
"""Of a cell: the mean band and the Nav2 maps."""

_GREATEST_IS_BEST = "velocity"


@dataclass(frozen=True, slots=True)
class Nav2Scale:
    """What the least and the greatest cost of a Nav2 map stand for, a metre of ground."""

    lowest: float
    highest: float


@dataclass(frozen=True, slots=True)
class CellCounts:
    """Cells of the grid, those with a cost along some course, and those of them on ground that the model knows."""

    all: int
    with_cost: int
    trusted: int


@dataclass(frozen=True, slots=True, kw_only=True)
class CostMapCard:
    """All of cost-map.json but its seal."""

    key: str
    """Of what it is made from: model, map and step."""
    map: str
    model: str
    """The model's checksum."""
    robot: str
    grid: MapGrid
    courses_deg: tuple[float, ...] = tuple(ANGLES_DEG.tolist())
    bands: Mapping[str, tuple[str, ...]] = field(
        default_factory=lambda: dict.fromkeys(_QUANTITIES, (*_BAND_NAMES, "min", "mean", "best course", "std"))
    )
    units: Mapping[str, str] = field(default_factory=lambda: _QUANTITIES)
    reasons: Mapping[str, str] = field(
        default_factory=lambda: {str(int(reason)): flag_name(reason) for reason in Reason}
    )
    """Name of each bit of reasons.tif."""
    nav2_scale: Mapping[str, Nav2Scale]
    cells: CellCounts
    reason_share: Mapping[str, float]
    """Of cells and courses."""
    barred_by: tuple[str, ...] = tuple(flag_name(reason) for reason in Reason if reason & BARRED)
    aggregation: str = AGGREGATION
    """Of the courses of a cell, in its bands and in the Nav2 maps."""
    checksums: Mapping[str, Checksum]
    origin_deg: tuple[float, float] | None = None
    """Longitude and latitude where the frame of the Nav2 maps begins; None where it is the CRS's own."""
    label_energy: str = "total"
    """``total`` or ``net``: which power and energy it is."""
    kind: str = KIND
    version: str = VERSION


@dataclass(frozen=True, slots=True)
class CostMapResult:
    """What became of a cost map; ``str`` of it is what the command prints."""

    path: str
    status: str
    """``done`` or ``unchanged``."""
    card: CostMapCard

    def __str__(self) -> str:
        """Return where it is and what it holds, as plain lines."""
        grid, cells = self.card.grid, self.card.cells
        head = f"{self.path}: {grid.rows} x {grid.cols} cells of {grid.pixel_size_m:g} m, {COURSES} courses"
        if self.status == "unchanged":
            head += "; nothing to do: it is made from the same model, map and step"
        reasons = ", ".join(f"{name.replace('_', ' ')} {share:.1%}" for name, share in self.card.reason_share.items())
        return clean_lines(
            (
                head,
                f"{cells.with_cost} cells with a cost, {cells.trusted} of them within the training range along some course",
                *((f"cells and courses: {reasons}",) if reasons else ()),
            )
        )


def make_cost_map_key(model: Model, source: MapFile, cell_size_m: float) -> str:
    """Return what a cost map is made from, as a digest."""
    return digest({"model": model.checksum, "map": source.summary(), "cell_size_m": cell_size_m, "version": VERSION})


def make_cost_map(
    model: Model,
    source: MapFile,
    out: Path | str,
    *,
    cell_size_m: float,
    origin_deg: tuple[float, float] | None = None,
    step: Step = lambda _, __: None,
) -> CostMapResult:
    """Write the cost map of a whole map to ``out``, whole or not at all; an interrupted call goes on where it was.

    Parameters
    ----------
    model, source : who predicts, and the map.
    out : its directory: new, empty, or a cost map, which is replaced unless it is made from the same; or a URL in a bucket, where it
        becomes the newest build, and an interrupted call begins anew.
    cell_size_m : side of a cell in the map's plane [m].
    origin_deg : longitude and latitude of the origin of the Nav2 maps, whose axes are true east and north; without one they are in the
        plane of the map's CRS.
    step : is told how many blocks of how many are done.

    Raises `ModelError` or `MapError` where the map lacks what the model needs, is smaller than a cell or cannot be read; `UsageError` or
    `StoreError` where ``out`` is something else or cannot be written, or the origin is far from the map.
    """
    check_model(model, source)
    key = make_cost_map_key(model, source, cell_size_m)
    if is_url(out):
        url = str(out)
        known = read_cost_map_card(fetch_directory(url)) if find_newest(url, [CARD]) else None
        if known is not None and (known.key, known.origin_deg) == (key, origin_deg):
            return CostMapResult(url, "unchanged", known)
        with write_output(url, CARD) as place:
            made = make_cost_map(model, source, place, cell_size_m=cell_size_m, origin_deg=origin_deg, step=step)
        return replace(made, path=url)
    out = Path(out)
    clear_beside(out)
    grid, frame = make_grid(source, cell_size_m), make_frame(source, origin_deg)
    if out.exists() and not (out / CARD).is_file() and (not out.is_dir() or any(out.iterdir())):
        raise UsageError(f"{out}: exists and is no cost map; give another directory")
    with _claim_spool(out) as place:
        found = read_cost_map_card(out)  # another process may have been first
        if found is not None and found.key == key and not any(find_wrong_files(Place(out), found.checksums)):
            if found.origin_deg == origin_deg:
                rmtree(place)
                return CostMapResult(str(out), "unchanged", found)
            costs = open_cost_map(out, found)
        else:
            costs = _predict_cells(model, source, place, key, grid, step)
        with write_atomic_directory(out) as directory:
            strips = _Strips(costs, model.errors, read_classes(source, grid))
            scales = _write_files(directory, strips, frame)
            cells, shares = _compute_shares(costs)
            card = CostMapCard(
                key=key, map=source.name, model=model.checksum, robot=model.card.robot, label_energy=model.card.label_energy, grid=grid,
                nav2_scale=scales, cells=cells, reason_share=shares, checksums=compute_checksums(directory), origin_deg=origin_deg,
            )  # fmt: skip
            write_sealed(directory / CARD, card)
        rmtree(place)
    return CostMapResult(str(out), "done", card)


def read_cost_map_card(path: Path) -> CostMapCard | None:
    """Return the card of a cost map, or None where there is none, or one that is not as it was written."""
    try:
        card = read_sealed_as(path / CARD, CostMapCard)
    except StoreError:
        return None
    return card if card.kind == KIND else None


def open_cost_map(path: Path, card: CostMapCard) -> CostGrid:
    """Read the costs of a cost map into memory; `MapError` names every file that is damaged."""
    read = {f"{name}.tif": card.checksums[f"{name}.tif"] for name in ("power", "velocity", "reasons", "height")}
    if problems := list(find_wrong_files(Place(path), read)):
        raise MapError(*(f"{problem}; make the cost map again" for problem in problems))
    courses = range(1, COURSES + 1)
    power, velocity, reasons = (read_bands(path / f"{name}.tif", courses) for name in ("power", "velocity", "reasons"))
    return CostGrid(card.grid, power, velocity, reasons, read_bands(path / "height.tif", (1,))[0])


_ARRAYS = ("power_watt", "velocity_mps", "reasons", "height_m")


@contextmanager
def _claim_spool(out: Path) -> Iterator[Path]:
    """Yield the directory beside ``out`` where its costs wait, for one process at a time; it stays when that is interrupted."""
    whole = out.absolute()
    place = whole.parent / f".{whole.name}.partial"
    try:
        place.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise StoreError(f"{out}: cannot be written ({error.strerror})") from None
    with lock_directory(place):
        place.mkdir(exist_ok=True)  # another process may have finished meanwhile
        yield place
    with suppress(OSError):
        place.rmdir()


def _predict_cells(  # noqa: PLR0917
    model: Model, source: MapFile, place: Path, key: str, grid: MapGrid, step: Step
) -> CostGrid:
    """Return the costs of all cells, in files of ``place`` that outlive an interruption; what is done of ``key`` is not done again."""
    if _read_job(place) != key:
        _make_spool(place, key, grid)
    held = {name: np.load(place / f"{name}.npy", mmap_mode="r+") for name in (*_ARRAYS, "done")}
    files, done = tuple(held.values()), held.pop("done")
    costs, frames = CostGrid(grid, **held), CellFrames(grid, where=f"map {source.name}")
    missing = (done == 0).reshape(grid.rows, grid.cols)
    todo = list(iterate_blocks(source, model, grid, missing))
    if not missing.all():
        logger.info("resuming: %.0f %% of the cells are done", 100.0 * (1.0 - missing.mean()))
    ready: list[Cells] = []
    answers = iterate_predictions(model, source, (frames.of(cells) for cells in todo))
    for number, (cells, found) in enumerate(zip(todo, answers, strict=True), 1):
        costs.put(cells, found)
        ready.append(cells)
        if len(ready) == _BLOCKS_KEPT or number == len(todo):
            for file in files:  # what is known, then that it is done
                file.flush()
            done[np.concatenate(ready)] = 1
            ready = []
        step(number, len(todo))
    return costs


def _make_spool(place: Path, key: str, grid: MapGrid) -> None:
    """Write files of costs of which none is known."""
    for file in place.iterdir():
        file.unlink()
    nothing = make_empty_grid(replace(grid, rows=1, cols=1))
    for name in _ARRAYS:
        one = getattr(nothing, name)
        array = np.lib.format.open_memmap(
            place / f"{name}.npy", "w+", one.dtype, (*one.shape[:-2], grid.rows, grid.cols)
        )
        _allocate(place / f"{name}.npy", array.offset + array.nbytes)
        array[...] = one
    np.save(place / "done.npy", np.zeros(grid.rows * grid.cols, np.uint8))
    write_json(place / "job.json", {"key": key})


def _allocate(path: Path, size_bytes: int) -> None:
    """Take room on the disk: where it is full that is an error here, not a crash later."""
    try:
        with path.open("r+b") as opened:
            os.posix_fallocate(opened.fileno(), 0, size_bytes)
    except OSError as error:
        raise StoreError(f"{path}: cannot be written ({error.strerror}); expected {size_bytes / 1e6:.0f} MB") from None


def _read_job(place: Path) -> str | None:
    try:
        return str(read_json(place / "job.json")["key"])
    except (StoreError, KeyError):
        return None


def _write_files(directory: Path, strips: _Strips, frame: Frame) -> dict[str, Nav2Scale]:
    """Write all files but the card; return the scales of the Nav2 maps."""
    costs, grid = strips.costs, strips.costs.grid
    for name, unit in _QUANTITIES.items():
        bands = [
            *((band, unit) for band in (*_BAND_NAMES, "min", "mean")),
            ("best course, ccw from grid east", "deg"),
            ("std of a metre", unit),
        ]
        strip = partial(strips.compute, name)
        write_cog(directory / f"{name}.tif", strip, grid, dtype="float32", bands=bands)
    bands = [(band, "bits") for band in (*_BAND_NAMES, "all courses")]
    write_cog(directory / "reasons.tif", partial(_read_reasons, costs), grid, dtype="uint16", bands=bands)
    height = [("height", "m")]
    write_cog(
        directory / "height.tif",
        lambda first, last: costs.height_m[None, first:last],
        grid,
        dtype="float32",
        bands=height,
    )
    scales = {name: _write_nav2(directory / f"{name}.yaml", strips, name, frame) for name in ("duration", "energy")}
    for name, scale in scales.items():
        write_text(directory / f"{name}.qml", make_raster_style(_MEAN_BAND, scale.lowest, scale.highest))
    return scales


@dataclass(frozen=True, slots=True)
class _Strips:
    """Rows of a quantity, from the costs, the errors of the model's predictions and the class of each cell."""

    costs: CostGrid
    errors: Mapping[str, Errors] | None
    class_id: NDArray[np.uint8]

    def compute(self, name: str, first: int, last: int) -> Floats32:
        """Return a quantity of rows, and its minimum, mean, best course and standard deviation, shape (20, rows, cols).

        The last four are over the courses without a reason. The standard deviation is that of a metre, mean over the courses.
        """
        power, velocity = self.costs.power_watt[:, first:last], self.costs.velocity_mps[:, first:last]
        values = {"power": power, "velocity": velocity}.get(name)
        if values is None:
            values = 1.0 / velocity if name == "duration" else power / velocity
        trusted = np.where(self.costs.reasons[:, first:last] == 0, values, np.float32(np.nan))
        is_known = ~np.isnan(trusted)
        worth = np.where(is_known, -trusted if name == _GREATEST_IS_BEST else trusted, np.inf)
        best, least = ANGLES_DEG[worth.argmin(axis=0)], np.where(is_known, trusted, np.inf).min(axis=0)
        some = is_known.any(axis=0)
        nothing = np.full(trusted.shape, np.nan)
        std = nothing if self.errors is None else self.errors[name].compute_std(trusted, self.class_id[first:last])
        more = [*(np.where(some, band, np.nan) for band in (least, _mean(trusted), best)), _mean(std)]
        return np.concatenate([values, np.stack(more)]).astype(np.float32)


def _mean(values: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return the mean over the courses that have a value; NaN where none has."""
    known = ~np.isnan(values)
    count = known.sum(axis=0)
    total = np.where(known, values, 0.0).sum(axis=0, dtype=np.float64)
    return np.asarray(np.where(count > 0, total / np.maximum(count, 1), np.nan))


def _read_reasons(costs: CostGrid, first: int, last: int) -> NDArray[np.uint16]:
    bits = np.asarray(costs.reasons[:, first:last])
    return np.concatenate([bits, np.bitwise_and.reduce(bits, axis=0)[None]])


def _write_nav2(path: Path, strips: _Strips, name: str, frame: Frame) -> Nav2Scale:
    """Write the mean over the trusted courses from 0 to `HIGHEST` on a grid of the frame; return what these two stand for."""
    grid = strips.costs.grid
    mean = np.concatenate(
        [strips.compute(name, first, last)[_MEAN_BAND - 1] for first, last in iterate_row_strips(grid)]
    )
    known = np.isfinite(mean)
    low, high = np.percentile(mean[known], (1.0, 99.0)).tolist() if known.any() else (0.0, 1.0)
    share = (np.where(known, mean, low) - low) / max(high - low, 1e-9)
    cost = np.where(known, np.rint(HIGHEST * np.clip(share, 0.0, 1.0)), LETHAL).astype(np.uint8)
    unit = _QUANTITIES[name]
    meaning = (
        f"{name} a metre, {AGGREGATION}: 0 is {low:.6g} {unit}, {HIGHEST} is {high:.6g} {unit}, {LETHAL} is not crossed"
    )
    own = frame.cover(grid)
    cells, is_on = frame.find_cells(grid, own)
    there = np.where(is_on, cost.reshape(-1)[cells], LETHAL).astype(np.uint8).reshape(own.rows, own.cols)
    write_nav2_map(path, there, own, frame=frame.description, meaning=meaning)
    return Nav2Scale(low, high)


def _compute_shares(costs: CostGrid) -> tuple[CellCounts, dict[str, float]]:
    """Return how many cells have a cost, and the share of cells and courses that each reason holds."""
    counts, with_cost, trusted = dict.fromkeys(Reason, 0), 0, 0
    for first, last in iterate_row_strips(costs.grid):
        bits = np.asarray(costs.reasons[:, first:last])
        with_cost += int(np.count_nonzero((~np.isnan(costs.velocity_mps[:, first:last])).any(axis=0)))
        trusted += int(np.count_nonzero((bits == 0).any(axis=0)))
        for reason in counts:
            counts[reason] += int(np.count_nonzero(bits & reason))
    shares = {flag_name(reason): count / costs.reasons.size for reason, count in counts.items() if count}
    return CellCounts(costs.grid.rows * costs.grid.cols, with_cost, trusted), shares
