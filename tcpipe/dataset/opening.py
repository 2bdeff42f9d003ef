"""A dataset as a mapping of its splits."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np

from tcpipe.dataset.energies import Energy, find_energy
from tcpipe.dataset.pixels import SampleView, StoredPixels
from tcpipe.dataset.split import SampleColumns, Split
from tcpipe.dataset.tensor import make_tensor_layout
from tcpipe.errors import DatasetError
from tcpipe.formats.bucket_directories import fetch_directory_by_range
from tcpipe.formats.dataset_card import DatasetCard
from tcpipe.formats.dataset_files import find_rows_in_files, is_shard, open_patches, read_current_card, read_samples
from tcpipe.terrain.layers import LAYERS


class Dataset(Mapping[str, Split]):
    """The splits ``train``, ``test``, ``unseen`` and ``buffer`` by name (a split may be empty), and the card."""

    def __init__(self, path: Path, card: DatasetCard, splits: Mapping[str, Split]) -> None:
        self.path = path
        self.card = card
        self._splits = dict(splits)

    def __getitem__(self, name: str) -> Split:
        """Return one split."""
        try:
            return self._splits[name]
        except KeyError:
            raise KeyError(f"{self.path}: no split {name!r}; there are {', '.join(self._splits)}") from None

    def __iter__(self) -> Iterator[str]:
        """Iterate over the names of the splits."""
        return iter(self._splits)

    def __len__(self) -> int:
        """Return the number of splits."""
        return len(self._splits)

    def __repr__(self) -> str:
        """Name the dataset and its splits."""
        counts = ", ".join(f"{name} {len(split)}" for name, split in self._splits.items())
        return f"Dataset({str(self.path)!r}: {counts})"


def open_dataset(path: str | Path, *, layers: Sequence[str] | None = None, label: str = "total") -> Dataset:
    """Open a dataset that ``tcpipe build-dataset`` wrote.

    Parameters
    ----------
    path
        Its directory, of either format, or the URL of one in a bucket (``s3://…``): patches are fetched when they are read, and cached.
    layers
        The tensor's channels, in this order; None: the paper's ``ortho``, ``terrain``, ``height``, those of them that are there.
    label
        Which energy the labels are of: ``total``, all that the power source measured, or ``net``, less what the robot draws
        while it stands. T = d / v and E = w d / v hold for either.

    Returns
    -------
    A mapping from ``train``, ``test``, ``unseen``, ``buffer`` to `Split`; patches are read when they are asked for.

    Raises
    ------
    DatasetError
        There is no dataset, it is of another data model, or its samples do not fit its card, or it has no such layer or label.

    """
    energy = find_energy(label)
    directory, fetched = fetch_directory_by_range(path, by_range=is_shard)
    card = read_current_card(directory)
    split = read_samples(directory, ["split"]).column("split").to_numpy()
    if len(split) != card.samples:
        raise DatasetError(
            f"{directory}: samples.parquet has {len(split)} rows, its card says {card.samples}; build it again"
        )
    _refuse_without(energy, directory, card)
    files = open_patches(directory, card, fetched)
    asked = [name for name in LAYERS if name in files.layers] if layers is None else layers
    form = make_tensor_layout(asked, files.layers)
    parts = {}
    for name, rows in find_rows_in_files(card, split).items():
        columns = SampleColumns(directory, np.flatnonzero(split == name))
        parts[name] = Split(
            name, card, columns, SampleView(StoredPixels(files, rows), np.arange(len(rows)), form), energy
        )
    return Dataset(directory, card, parts)


def _refuse_without(energy: Energy, directory: Path, card: DatasetCard) -> None:
    """Raise an error if no sample of the dataset has the label."""
    column = read_samples(directory, [energy.power]).column(energy.power)
    if card.samples and column.null_count == len(column):
        raise DatasetError(
            f"{directory}: no sample has {energy.power}: its robot hardly stood in any run, or they were ingested before data model 1.3; "
            "ingest the logs and build it again, or take the label total"
        )
