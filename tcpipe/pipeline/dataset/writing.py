"""Writing a dataset from chosen inputs: sample, split, audit, describe; card and page last."""

import shutil
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import pyarrow as pa

from tcpipe.formats.atomic import write_text
from tcpipe.formats.croissant import format_croissant
from tcpipe.formats.dataset_card import DatasetCard
from tcpipe.formats.dataset_files import CARD, CLASSES, CROISSANT, OVERVIEW, RELIEF, SAMPLES
from tcpipe.formats.integrity import compute_checksum, compute_checksums, seal_page, write_sealed
from tcpipe.formats.maps.map_files import MapFile
from tcpipe.formats.parquet import map_table, write_parquet_rows, write_pieces
from tcpipe.formats.place import REPORT
from tcpipe.pipeline.dataset.card import (
    CARD_COLUMNS,
    PHYSICS_COLUMNS,
    REPEATABILITY_COLUMNS,
    VELOCITY_COLUMN,
    make_dataset_card,
    measure_repeatability,
)
from tcpipe.pipeline.dataset.content import SampleTable, gather_content, write_patches
from tcpipe.pipeline.dataset.inputs import ChosenInputs
from tcpipe.pipeline.dataset.options import BuildOptions
from tcpipe.pipeline.dataset.without_coordinates import make_publication
from tcpipe.progress import logger
from tcpipe.report.dataset_report import SAMPLE_COLUMNS, render_dataset_report
from tcpipe.report.pictures import draw_classes, draw_maps, draw_relief, write_overview


def write_dataset(directory: Path, inputs: ChosenInputs, options: BuildOptions, jobs: int) -> DatasetCard:
    """Write the dataset into ``directory`` and return its card."""
    waiting, recipe = directory / "spool", options.recipe
    waiting.mkdir()
    content = gather_content(waiting, inputs, options, jobs)
    public = make_publication(content, inputs, patch_m=recipe.sample.patch_m) if options.without_coordinates else None
    if public is not None:
        content, inputs = public.convert_content(content), public.convert_inputs(inputs)
    logger.info("writing %d samples", len(content.samples))
    figures = _write_samples(directory / SAMPLES, content.samples, waiting / "figures.arrow")
    ids, compression = figures.column("sample_id"), recipe.dataset.compression
    shards = write_patches(directory, content, ids, options.file_format, jobs, compression=compression)
    if public is None and content.sources:
        _write_overviews(directory, content.sources)
    repeatability = measure_repeatability(
        figures,
        content.samples.centres_xy_m(),
        velocity_column=VELOCITY_COLUMN[recipe.label.velocity],
        chord_m=recipe.segment.chord_m,
    )
    card = make_dataset_card(figures, options, inputs, content, repeatability=repeatability, shards=shards)
    card = card if public is None else public.make_card(card)
    shutil.rmtree(waiting)
    files = compute_checksums(directory)
    write_text(directory / CROISSANT, format_croissant(card, content.samples.schema, files))
    card = replace(card, checksums={**files, CROISSANT: compute_checksum(directory / CROISSANT)})
    write_sealed(directory / CARD, card)
    write_text(directory / REPORT, seal_page(render_dataset_report(directory, samples=figures)))
    return card


def _write_samples(path: Path, samples: SampleTable, mapped: Path) -> pa.Table:
    """Write the samples; return the columns that card and page are made from, mapped from another file."""
    requested = dict.fromkeys((*CARD_COLUMNS, *PHYSICS_COLUMNS, *REPEATABILITY_COLUMNS, *SAMPLE_COLUMNS))
    schema = samples.schema
    names = [name for name in requested if name in schema.names]

    def write_both() -> Iterator[pa.Table]:
        for piece in samples.pieces():
            write(piece)
            few = piece.select(names).replace_schema_metadata(None)
            del piece  # else it is in memory beside the next one
            yield few
            del few

    with write_parquet_rows(path, schema) as write:
        write_pieces(mapped, pa.schema([schema.field(name) for name in names]), write_both())
    return map_table(mapped)


def _write_overviews(directory: Path, sources: Sequence[MapFile]) -> None:
    """Write the page's pictures of the maps: photograph (or relief), relief and classes, as far as they exist."""
    write_overview(directory / OVERVIEW, draw_maps(sources))
    layers = {layer for source in sources for layer in source.layers}
    if "ortho" in layers:
        write_overview(directory / RELIEF, draw_maps(sources, draw_relief))
    if "terrain" in layers:
        write_overview(directory / CLASSES, draw_maps(sources, draw_classes))
