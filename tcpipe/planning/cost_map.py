"""A whole map's directional costs as files, block by block, resumable, in bounded memory.

::

    cost-map.json                      sources, courses, reasons, shares, checksums
    power.tif velocity.tif             [W], [m/s]: a band a course; min, mean, best course, std over trusted courses
    duration.tif energy.tif            [s/m], [J/m]: the same
    reasons.tif                        `Reason` bits: a band a course, then those that all courses share
    height.tif                         of the cells' middles [m]
    duration.{yaml,pgm} energy.{…}     Nav2 maps of the mean over the trusted courses
    keepout.{yaml,pgm} speed.{…}       Nav2 costmap filter masks: ground without a trusted course; mean velocity
    nav2.yaml                          parameters of Nav2 for these maps
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from shutil import rmtree

import numpy as np
from numpy.typing import NDArray

from tcpipe.arrays import Bytes, Floats, Floats32
from tcpipe.cost.prediction_errors import QuantityErrors
from tcpipe.errors import MapError, StoreError, clean_lines
from tcpipe.formats.atomic import Location, check_new, clear_beside, lock_directory, make_scratch_directory, write_text
from tcpipe.formats.integrity import FileChecksums, compute_checksums, read_sealed_as, write_sealed
from tcpipe.formats.json_files import digest
from tcpipe.formats.maps.geotiff import read_bands, write_cog
from tcpipe.formats.maps.map_files import MapFile
from tcpipe.formats.maps.nav2 import HIGHEST, LETHAL, format_nav2_parameters, write_nav2_map, write_nav2_mask
from tcpipe.formats.object_storage import is_url
from tcpipe.formats.place import Place, find_wrong_files
from tcpipe.formats.published_outputs import fetch_directory, find_newest, publish_directory
from tcpipe.formats.weights import read_arrays, write_arrays
from tcpipe.learning.models import Model
from tcpipe.planning.cost_grid import (
    ANGLES_DEG,
    BARRED,
    COURSES,
    CellFrames,
    CostGrid,
    average_known,
    iterate_blocks,
    iterate_row_strips,
    make_empty_grid,
    make_grid,
    read_classes,
)
from tcpipe.planning.cost_model import Reason, check_model, iterate_predictions
from tcpipe.planning.frames import Frame, make_frame
from tcpipe.progress import Meter
from tcpipe.tables.bits import flag_name
from tcpipe.terrain.target_grid import MapGrid

CARD = "cost-map.json"
KIND = "tcpipe cost map"
VERSION = "1.4"

_BLOCKS_KEPT = 64  # blocks in a file of finished cells

_QUANTITIES = {"power": "W", "velocity": "m/s", "duration": "s/m", "energy": "J/m"}
_BAND_NAMES = tuple(f"course {angle:.1f} deg" for angle in ANGLES_DEG)
_MEAN_BAND = COURSES + 2
AGGREGATION = "mean over the courses without a reason"
"""Aggregation of the courses of a cell in the mean band and the Nav2 maps."""

_GREATEST_IS_BEST = "velocity"


@dataclass(frozen=True, slots=True)
class Nav2Scale:
    """Costs of a metre of ground for the smallest and the largest value of a Nav2 map."""

    lowest: float
    highest: float


@dataclass(frozen=True, slots=True)
class CellCounts:
    """Numbers of cells: of the grid, with a cost along some course, and of these inside the training range."""

    all: int
    with_cost: int
    trusted: int


@dataclass(frozen=True, slots=True, kw_only=True)
class CostMapCard:
    """All of cost-map.json but its seal."""

    key: str
    """Hash of model, map and cell size."""
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
    """Share of cells and courses with each reason."""
    barred_by: tuple[str, ...] = tuple(flag_name(reason) for reason in Reason if reason & BARRED)
    aggregation: str = AGGREGATION
    """Aggregation of the courses of a cell in its bands and in the Nav2 maps."""
    checksums: FileChecksums
    origin_deg: tuple[float, float] | None = None
    """Longitude and latitude of the origin of the Nav2 maps; None: they are in the plane of the CRS."""
    label_energy: str = "total"
    """``total`` or ``net``: which power and energy it is."""
    kind: str = KIND
    version: str = VERSION


@dataclass(frozen=True, slots=True)
class CostMapResult:
    """Result of a cost map; the command prints its ``str``."""

    path: str
    status: str
    """``done`` or ``unchanged``."""
    card: CostMapCard

    def __str__(self) -> str:
        """Return path and content as plain lines."""
        grid, cells = self.card.grid, self.card.cells
        head = f"{self.path}: {grid.rows} x {grid.cols} cells of {grid.pixel_size_m:g} m, {COURSES} courses"
        if self.status == "unchanged":
            head += "; nothing to do: it is made from the same model, map and step"
        reasons = ", ".join(f"{name.replace('_', ' ')} {share:.1%}" for name, share in self.card.reason_share.items())
        return clean_lines(
            (
                head,
                (
                    f"{cells.with_cost} cells with a cost, "
                    f"{cells.trusted} of them within the training range along some course"
                ),
                *((f"cells and courses: {reasons}",) if reasons else ()),
            )
        )


def make_cost_map_key(model: Model, source: MapFile, cell_size_m: float) -> str:
    """Return the hash of the inputs of a cost map."""
    return digest({"model": model.checksum, "map": source.summary(), "cell_size_m": cell_size_m, "version": VERSION})


def make_cost_map(
    model: Model, source: MapFile, out: Location, *, cell_size_m: float, origin_deg: tuple[float, float] | None = None
) -> CostMapResult:
    """Write the cost map of a whole map to ``out``, complete or not at all; an interrupted call resumes.

    Parameters
    ----------
    model, source : the model and the map.
    out : its directory: new, empty, or a cost map, which is replaced unless its inputs are the same; or a URL in a
        bucket, where it becomes the newest build, and an interrupted call starts again.
    cell_size_m : side of a cell in the map's plane [m].
    origin_deg : longitude and latitude of the origin of the Nav2 maps, with true east and north axes; default: the
        plane of the map's CRS.

    Raises `ModelError` or `MapError` if the map lacks a layer, is smaller than a cell or cannot be read; `UsageError`
    or `StoreError` if ``out`` is something else or cannot be written, or the origin is far from the map.
    """
    check_model(model, source)
    key, out = make_cost_map_key(model, source, cell_size_m), str(out).rstrip("/")
    grid, frame = make_grid(source, cell_size_m), make_frame(source, origin_deg)
    if not is_url(out):
        clear_beside(Path(out))
        check_new(Path(out), "cost map", CARD)
    with _claim_spool(out) as spool:
        found = _read_known(out, key)  # after the lock: another process may have been first
        if found is not None and found.origin_deg == origin_deg:
            return CostMapResult(out, "unchanged", found)
        known = None if found is None else open_cost_map(fetch_directory(out), found)
        costs = known or _predict_cells(model, source, spool, key, grid)
        with publish_directory(out, CARD) as directory:
            scales = _write_files(directory, _Strips(costs, model.errors, read_classes(source, grid)), frame)
            cells, shares = _compute_shares(costs)
            card = CostMapCard(
                key=key, map=source.name, model=model.checksum, robot=model.card.robot,
                label_energy=model.card.label_energy, grid=grid, nav2_scale=scales, cells=cells, reason_share=shares,
                checksums=compute_checksums(directory), origin_deg=origin_deg,
            )  # fmt: skip
            write_sealed(directory / CARD, card)
    return CostMapResult(out, "done", card)


def _read_known(out: str, key: str) -> CostMapCard | None:
    """Return the card of the complete cost map with this key in a directory, or of the newest at a URL; else None."""
    if is_url(out) and find_newest(out, [CARD]) is None:
        return None
    place = fetch_directory(out)
    card = read_cost_map_card(place)
    is_same = card is not None and card.key == key and not any(find_wrong_files(Place(place), card.checksums))
    return card if is_same else None


def read_cost_map_card(path: Path) -> CostMapCard | None:
    """Return the card of a cost map; None without one, or if it has changed since it was written."""
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


@contextmanager
def _claim_spool(out: str) -> Iterator[Path]:
    """Yield a directory for finished cells beside ``out``, locked by one process and kept after an interruption."""
    if is_url(out):
        with make_scratch_directory() as scratch:
            yield scratch
        return
    whole = Path(out).absolute()
    place = whole.parent / f".{whole.name}.partial"
    try:
        place.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise StoreError(f"{out}: cannot be written ({error.strerror})") from None
    with lock_directory(place):
        place.mkdir(exist_ok=True)  # another process may have finished meanwhile
        yield place
        rmtree(place)


def _predict_cells(model: Model, source: MapFile, spool: Path, key: str, grid: MapGrid) -> CostGrid:
    """Return the costs of all cells; files of ``spool`` keep finished ones, so that an interrupted call resumes."""
    costs, frames = make_empty_grid(grid), CellFrames(grid, where=f"map {source.name}")
    blocks = list(iterate_blocks(source, model, grid))
    meter = Meter("predicting", len(blocks))
    for other in spool.iterdir():
        if not other.name.startswith(key[:16]):
            other.unlink()
    for first in range(0, len(blocks), _BLOCKS_KEPT):
        here, file = blocks[first : first + _BLOCKS_KEPT], spool / f"{key[:16]}-{first}.npz"
        cells = np.concatenate(here)
        if file.is_file():
            costs.load(cells, read_arrays(file))
            meter.add(len(here))
        else:
            answers = iterate_predictions(model, source, (frames.of(block) for block in here))
            for block, found in zip(here, answers, strict=True):
                costs.put(block, found)
                meter.add(1)
            write_arrays(file, costs.take(cells))
    return costs


def _write_files(directory: Path, strips: _Strips, frame: Frame) -> dict[str, Nav2Scale]:
    """Write all files but the card; return the scales of the Nav2 maps."""
    costs, grid = strips.costs, strips.costs.grid
    for name, unit in _QUANTITIES.items():
        bands = [
            *((band, unit) for band in (*_BAND_NAMES, "min", "mean")),
            ("best course, ccw from grid east", "deg"),
            ("std of a metre", unit),
        ]
        write_cog(directory / f"{name}.tif", partial(strips.compute, name), grid, dtype="float32", bands=bands)
    bands = [(band, "bits") for band in (*_BAND_NAMES, "all courses")]

    def read_reasons(first: int, last: int) -> NDArray[np.uint16]:
        bits = np.asarray(costs.reasons[:, first:last])
        return np.concatenate([bits, np.bitwise_and.reduce(bits, axis=0)[None]])

    write_cog(directory / "reasons.tif", read_reasons, grid, dtype="uint16", bands=bands)
    height = [("height", "m")]
    write_cog(
        directory / "height.tif",
        lambda first, last: costs.height_m[None, first:last],
        grid,
        dtype="float32",
        bands=height,
    )
    scales = {name: _write_nav2(directory / f"{name}.yaml", strips, name, frame) for name in ("duration", "energy")}
    step_mps = _write_masks(directory, strips, frame)
    energy = asdict(scales["energy"]) | {"quantity": "energy", "unit": _QUANTITIES["energy"]}
    write_text(directory / "nav2.yaml", format_nav2_parameters(**energy, speed_step_mps=step_mps))
    return scales


@dataclass(frozen=True, slots=True)
class _Strips:
    """Rows of a quantity, from the costs, the errors of the model's predictions and the class of each cell."""

    costs: CostGrid
    errors: Mapping[str, QuantityErrors] | None
    class_id: Bytes

    def compute(self, name: str, first: int, last: int) -> Floats32:
        """Return a quantity of rows, and its minimum, mean, best course and standard deviation, shape (20, rows, cols).

        The last four are over the courses without a reason. The standard deviation is that of a metre, averaged over
        the courses.
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
        more = [
            *(np.where(some, band, np.nan) for band in (least, average_known(trusted, 0), best)),
            average_known(std, 0),
        ]
        return np.concatenate([values, np.stack(more)]).astype(np.float32)


def _compute_mean(strips: _Strips, name: str) -> Floats:
    """Return the mean of a quantity over the trusted courses, shape (rows, cols); NaN without any."""
    rows = iterate_row_strips(strips.costs.grid)
    return np.concatenate([strips.compute(name, first, last)[_MEAN_BAND - 1] for first, last in rows])


def _resample(values: Bytes, outside: int, grid: MapGrid, frame: Frame) -> tuple[Bytes, MapGrid]:
    """Return the values of cells on a grid of the frame, and the grid."""
    own = frame.cover(grid)
    cells, is_on = frame.find_cells(grid, own)
    return np.where(is_on, values.reshape(-1)[cells], outside).astype(np.uint8).reshape(own.rows, own.cols), own


def _write_nav2(path: Path, strips: _Strips, name: str, frame: Frame) -> Nav2Scale:
    """Write the mean over the trusted courses, scaled to 0..`HIGHEST`, on a grid of the frame; return the scale."""
    mean = _compute_mean(strips, name)
    known = np.isfinite(mean)
    low, high = np.percentile(mean[known], (1.0, 99.0)).tolist() if known.any() else (0.0, 1.0)
    share = (np.where(known, mean, low) - low) / max(high - low, 1e-9)
    cost = np.where(known, np.rint(HIGHEST * np.clip(share, 0.0, 1.0)), LETHAL).astype(np.uint8)
    unit = _QUANTITIES[name]
    meaning = (
        f"{name} a metre, {AGGREGATION}: 0 is {low:.6g} {unit}, {HIGHEST} is {high:.6g} {unit}, {LETHAL} is not crossed"
    )
    write_nav2_map(path, *_resample(cost, LETHAL, strips.costs.grid, frame), frame=frame.description, meaning=meaning)
    return Nav2Scale(low, high)


def _write_masks(directory: Path, strips: _Strips, frame: Frame) -> float:
    """Write the masks of the keepout and the speed filter; return the speed of one step of the latter [m/s]."""
    mean_mps, grid = _compute_mean(strips, "velocity"), strips.costs.grid
    known = np.isfinite(mean_mps)
    step_mps = float(mean_mps[known].max()) / 100.0 if known.any() else 0.01
    speed = np.where(known, np.maximum(np.nan_to_num(mean_mps) / step_mps, 1.0), 0.0).astype(np.uint8)
    masks = {
        "keepout": (np.where(known, 0, LETHAL).astype(np.uint8), LETHAL, f"{LETHAL} is not crossed"),
        "speed": (speed, 0, f"speed limit: value * {step_mps:.9f} m/s, {AGGREGATION}; 0: no limit"),
    }
    for name, (values, outside, meaning) in masks.items():
        there = _resample(values, outside, grid, frame)
        write_nav2_mask(directory / f"{name}.yaml", *there, frame=frame.description, meaning=meaning)
    return step_mps


def _compute_shares(costs: CostGrid) -> tuple[CellCounts, dict[str, float]]:
    """Return the numbers of cells, and the share of cells and courses with each reason."""
    counts, with_cost, trusted = dict.fromkeys(Reason, 0), 0, 0
    for first, last in iterate_row_strips(costs.grid):
        bits = np.asarray(costs.reasons[:, first:last])
        with_cost += int(np.count_nonzero((~np.isnan(costs.velocity_mps[:, first:last])).any(axis=0)))
        trusted += int(np.count_nonzero((bits == 0).any(axis=0)))
        for reason in counts:
            counts[reason] += int(np.count_nonzero(bits & reason))
    shares = {flag_name(reason): count / costs.reasons.size for reason, count in counts.items() if count}
    return CellCounts(costs.grid.rows * costs.grid.cols, with_cost, trusted), shares
