"""The picture of one labelled metre for the README: `python docs/metre.py DEMO OUT.png` (`make pictures`)."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import polars as pl
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

import tcpipe

_SIZE_PX = (1600, 760)
_PATCH_PX = 340
_LAYERS = ("ortho_red", "ortho_green", "ortho_blue", "terrain", "height")
_SPAN_S = 12.0
"""Length of the power record that is drawn [s]."""
_INK, _GREY, _PAPER, _MARK, _LINE = "#14191e", "#5b6670", "#ffffff", "#ffe2a8", "#1f5fa8"
_CLASS_COLOURS = {"grass": "#6aa84f", "mud": "#7a5230", "unpaved road": "#b5a58a", "paved road": "#8c9196"}


def draw_metre(demo: Path, out: Path) -> None:
    """Draw the sample on two classes whose energy is nearest to the median: labels, patches and its part of the log."""
    dataset = tcpipe.open_dataset(demo / "dataset", layers=_LAYERS)
    split = dataset["train"]
    energy = np.asarray(split.column("energy_joule"))
    mixed = np.asarray(split.column("terrain_purity")) < 1.0
    row = int(np.argmin(np.abs(energy - np.median(energy)) + np.where(mixed, 0.0, 1e6)))
    sample = split.samples.slice(row, 1).to_pylist()[0]
    layers = split.layers([row])
    picture = Image.new("RGB", _SIZE_PX, _PAPER)
    pen = ImageDraw.Draw(picture)
    _write(pen, (40, 24), f"One metre of {sample['terrain_name']}, driven in {_format(sample, 'duration', 's', 3)}", 40)
    facts = (
        f"energy {_format(sample, 'energy', 'J', 0)}",
        f"net of idle power {_format(sample, 'net_energy', 'J', 0)}",
        f"slip {100 * sample['slip_fraction']:.1f} ± {100 * sample['slip_std_fraction']:.1f} %",
        f"slope {np.degrees(sample['slope_rad']):+.1f}°",
        f"position ± {sample['position_std_m']:.2f} m",
    )
    _write(pen, (40, 84), "   ·   ".join(facts), 27, _GREY)
    images = (
        ("orthophoto", np.stack([layers[name][0] for name in _LAYERS[:3]], axis=-1)),
        ("terrain class", _colour_classes(layers["terrain"][0], dataset.card)),
        ("height", _shade(layers["height"][0])),
    )
    for number, (title, image) in enumerate(images):
        left = 40 + number * (_PATCH_PX + 30)
        patch = Image.fromarray(image.astype(np.uint8)).resize((_PATCH_PX, _PATCH_PX), Image.Resampling.NEAREST)
        picture.paste(patch, (left, 140))
        _draw_chord(pen, left, 140)
        _write(pen, (left, 140 + _PATCH_PX + 6), title, 24, _GREY)
    _write(pen, (1170, 140), "1 m by 1 m of map,", 27)
    _write(pen, (1170, 176), "turned into the direction of travel", 27)
    _write(pen, (1170, 236), f"run {sample['run_id']}", 22, _GREY)
    start_s = (sample["start_ns"] - _find_start(demo, sample["run_id"])) / 1e9
    _write(pen, (1170, 268), f"at {start_s:.1f} s, split {sample['split']}", 22, _GREY)
    _write(pen, (1170, 300), f"map {sample['map']}, quality flags {sample['quality']}", 22, _GREY)
    _draw_power(pen, demo, sample)
    picture.quantize(128, dither=Image.Dither.NONE).save(out, optimize=True)


def _format(sample: dict[str, float], name: str, unit: str, digits: int) -> str:
    suffix = {"s": "s", "J": "joule"}[unit]
    return f"{sample[f'{name}_{suffix}']:.{digits}f} ± {sample[f'{name}_std_{suffix}']:.{digits}f} {unit}"


def _write(pen: ImageDraw.ImageDraw, at: tuple[float, float], text: str, size: int, ink: str = _INK) -> None:
    pen.text(at, text, fill=ink, font=ImageFont.load_default(size))


def _colour_classes(ids: NDArray[np.uint8], card: object) -> NDArray[np.uint8]:
    image = np.zeros((*ids.shape, 3), np.uint8)
    for terrain in card.classes:  # type: ignore[attr-defined]
        colour = _CLASS_COLOURS.get(terrain.name, "#3c5a2a")
        image[ids == terrain.id] = [int(colour[begin : begin + 2], 16) for begin in (1, 3, 5)]
    return image


def _shade(height: NDArray[np.uint16]) -> NDArray[np.float64]:
    """Return heights as grey, from the lowest to the highest pixel."""
    value = height.astype(float)
    grey = 40.0 + 200.0 * (value - value.min()) / max(float(np.ptp(value)), 1.0)
    return np.repeat(grey[:, :, None], 3, axis=2)


def _draw_chord(pen: ImageDraw.ImageDraw, left: int, top: int) -> None:
    middle, right = top + _PATCH_PX // 2, left + _PATCH_PX
    pen.line((left, middle, right - 12, middle), fill="#ffffff", width=4)
    pen.polygon(((right, middle), (right - 22, middle - 11), (right - 22, middle + 11)), fill="#ffffff")


def _manifest(demo: Path, run_id: str) -> dict[str, object]:
    runs = (json.loads(path.read_text(encoding="utf-8")) for path in sorted((demo / "store/runs").iterdir()))
    return next(run for run in runs if run["run_id"] == run_id)


def _find_start(demo: Path, run_id: str) -> int:
    return int(str(_manifest(demo, run_id)["start_ns"]))


def _draw_power(pen: ImageDraw.ImageDraw, demo: Path, sample: dict[str, int]) -> None:
    """Draw the power around the metre, with its own time marked; its area is the energy."""
    run = _manifest(demo, str(sample["run_id"]))
    track = pl.read_parquet(demo / f"store/blobs/{run['blob']}/track.parquet", columns=["stamp_ns", "power_watt"])
    middle = (sample["start_ns"] + sample["end_ns"]) / 2
    seconds = (track["stamp_ns"].to_numpy() - middle) / 1e9
    shown = np.abs(seconds) < _SPAN_S / 2
    seconds, watt = seconds[shown], track["power_watt"].to_numpy()[shown]
    left, right, top, bottom = 120, 1560, 560, 710
    most = 50.0 * np.ceil(np.nanmax(watt) / 50.0)

    def place(s: float, w: float) -> tuple[float, float]:
        return left + (s / _SPAN_S + 0.5) * (right - left), bottom - max(w, 0.0) / most * (bottom - top)

    begin, end = ((sample[f"{name}_ns"] - middle) / 1e9 for name in ("start", "end"))
    inside = (seconds >= begin) & (seconds <= end)
    curve = [place(s, w) for s, w in zip(seconds[inside], watt[inside], strict=True)]
    pen.polygon([(curve[0][0], bottom), *curve, (curve[-1][0], bottom)], fill=_MARK)
    pen.line([place(s, w) for s, w in zip(seconds, watt, strict=True)], fill=_LINE, width=3, joint="curve")
    pen.line((left, bottom, right, bottom), fill=_GREY, width=2)
    _write(pen, (40, top - 6), f"{most:.0f} W", 22, _GREY)
    _write(pen, (72, bottom - 22), "0", 22, _GREY)
    note = "power of the drives; the marked area is the energy of this metre"
    _write(pen, (place(end, 0)[0] + 12, top - 14), note, 22, _GREY)
    _write(pen, (left, bottom + 10), f"{_SPAN_S:.0f} s of the log", 22, _GREY)


if __name__ == "__main__":
    draw_metre(Path(sys.argv[1]), Path(sys.argv[2]))
