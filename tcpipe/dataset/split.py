"""A dataset as a mapping of its splits: patches and labels as arrays, as batches, and as a map-style dataset."""

from __future__ import annotations

import base64
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import ArrayLike

from tcpipe.arrays import AnyArray, Floats, Floats32, GenericArray, Ints
from tcpipe.dataset.batches import Batches, SampleView, StoredPixels
from tcpipe.dataset.energies import ENERGIES, Energy, find_energy, name_common_std
from tcpipe.dataset.tensor import TensorLayout, make_tensor_layout
from tcpipe.errors import DatasetError, list_first
from tcpipe.formats.atomic import Location
from tcpipe.formats.dataset_card import DatasetCard
from tcpipe.formats.dataset_files import (
    OVERVIEW,
    find_places_in_files,
    is_shard,
    open_patches,
    read_intact_card,
    read_sample_ids,
    read_samples,
    sample_columns,
)
from tcpipe.formats.published_outputs import fetch_directory_by_range
from tcpipe.formats.runs import format_html_table
from tcpipe.splits.assignment import SPLITS
from tcpipe.tables.bits import Quality, flag_name
from tcpipe.tables.levels import LABELS
from tcpipe.terrain.layers import LAYERS

if TYPE_CHECKING:
    from tcpipe.dataset.torch_data import TorchBatches


_MIN_STD = 0.1  # least standard deviation, as a share of their median [1]: bounds the weight of a sample

_NAMED = 5  # most unknown ids in one message


@dataclass(slots=True)
class SampleColumns:
    """Columns of samples.parquet for some of its rows, read when they are asked for."""

    directory: Path
    rows: Ints
    _read: dict[str, GenericArray] = field(default_factory=dict)

    def __getitem__(self, name: str) -> GenericArray:
        """Return one column, nulls as NaN or None, shape (N,)."""
        if name not in self._read:
            known_columns = sample_columns(self.directory)
            if name not in known_columns:
                raise DatasetError(
                    f"{self.directory}: its samples have no column {name!r}; it has {', '.join(known_columns)}"
                )
            self._read[name] = read_samples(self.directory, [name]).column(name).take(self.rows).to_numpy()
        return self._read[name]

    def table(self) -> pa.Table:
        """Return all columns."""
        return read_samples(self.directory).take(self.rows)


@dataclass(eq=False, repr=False)
class Split:
    """Samples of one split, in the dataset's order; methods that narrow it return another one over the same files.

    Attributes
    ----------
    name : ``train``, ``test``, ``unseen`` or ``buffer``; ``selection`` for a selection of several.
    view : its samples among the stored pixels.
    energy : which of the two energies its labels are of.
    has_energy : whether any sample of the dataset has that energy.
    """

    name: str
    _card: DatasetCard
    _columns: SampleColumns
    view: SampleView
    energy: Energy = ENERGIES["total"]
    has_energy: bool = True

    def __len__(self) -> int:
        """Return the number of samples."""
        return len(self.view.at)

    def __repr__(self) -> str:
        """Name the split, its size and its channels."""
        return f"Split({self.name!r}: {len(self)} samples of {', '.join(self.channels) or 'labels, without patches'})"

    def __getitem__(self, index: int) -> tuple[Floats32, Floats32]:
        """Return the patch, shape (px, px, channels) in [0, 1], and the labels, shape (labels,), of one sample."""
        if not -len(self) <= index < len(self):
            raise IndexError(f"sample {index} of {len(self)} in split {self.name}")
        patches, labels = self.batch([index])
        return patches[0], labels[0]

    def __getitems__(self, indices: Sequence[int]) -> list[tuple[Floats32, Floats32]]:
        """Return many samples at once; torch's loader asks for whole batches this way."""
        patches, labels = self.batch(indices)
        return list(zip(patches, labels, strict=True))

    def __iter__(self) -> Iterator[tuple[Floats32, Floats32]]:
        """Iterate over the samples in order."""
        return (
            (patch, label) for patches, labels in self.batches(64) for patch, label in zip(patches, labels, strict=True)
        )

    def __getstate__(self) -> dict[str, Any]:
        """Leave formed tensors behind when a loader's worker process receives the split."""
        return {name: value for name, value in self.__dict__.items() if name != "patches"}

    @property
    def channels(self) -> tuple[str, ...]:
        """Channels of the tensor: the requested ones, else ortho, terrain and height as far as the map has them."""
        return self.view.form.channels

    @property
    def has_coordinates(self) -> bool:
        """Whether its samples have longitude and latitude; else x and y of all runs are in one frame."""
        return not self._card.without_coordinates

    @property
    def samples(self) -> pa.Table:
        """Every column of samples.parquet, one row a sample."""
        return self._columns.table().take(self.view.at)

    @property
    def label_columns(self) -> tuple[str, ...]:
        """Columns of samples.parquet that train: power of its energy, and the card's velocity (alone if no energy)."""
        velocity = self._card.label.columns[1]
        return (self.energy.power, velocity) if self.has_energy else (velocity,)

    @cached_property
    def labels(self) -> Floats32:
        """Power [W] and velocity [m/s], or velocity alone, float32, shape (N, labels): its `label_columns`."""
        return np.column_stack([self.column(name) for name in self.label_columns]).astype(np.float32)

    @cached_property
    def weights(self) -> Floats32:
        """Inverse variance of each label over its mean, float32, shape (N, labels); 0 if the variance is unknown.

        The part that all labels of a run share is excluded: no weights average it out.
        """
        names = (self.energy.power_std, "velocity_std_mps")[-len(self.label_columns) :]
        std = np.column_stack([self.own_std(name) for name in names])
        return np.column_stack([_compute_inverse_variance_weights(column) for column in std.T]).astype(np.float32)

    @cached_property
    def patches(self) -> Floats32:
        """The tensor of all samples, float32 in [0, 1], shape (N, px, px, channels); formed once, then kept."""
        return self._form_tensor(np.arange(len(self)))

    def column(self, name: str) -> GenericArray:
        """Return a column of samples.parquet, shape (N,)."""
        return self._columns[name][self.view.at]

    def own_std(self, name: str) -> Floats:
        """Return σ ``name`` of each label without the part that is common to all labels of a run, shape (N,)."""
        total = self.column(name).astype(np.float64)
        shared = np.nan_to_num(self.column(name_common_std(name)).astype(np.float64))
        return np.sqrt(np.maximum(total**2 - shared**2, 0.0))

    def layers(self, indices: Ints) -> dict[str, AnyArray]:
        """Return the stored layers of samples, each of shape (B, px, px): as ``dataset.json`` says of each."""
        return self.view.stored.gather(self.view.at[indices], self.view.form.layers)

    def batch(self, indices: ArrayLike) -> tuple[Floats32, Floats32]:
        """Return patches, shape (B, px, px, channels), and labels, shape (B, labels), of the samples ``indices``."""
        at = np.asarray(indices, dtype=np.int64)
        at = np.where(at < 0, at + len(self), at)
        patches = self.patches[at] if "patches" in self.__dict__ else self._form_tensor(at)
        return patches, self.labels[at]

    def with_channels(self, *channels: str) -> Split:
        """Return the split with channels: layers by name, or ``terrain_one_hot`` (one a class; any classes)."""
        files = self.view.stored.files
        form = make_tensor_layout(channels, files.layers, files.patch_px)
        return replace(self, view=replace(self.view, form=form))

    def with_layout(self, layout: TensorLayout) -> Split:
        """Return the split with tensors as another dataset's: its channels, scaled by its ranges."""
        return replace(self, view=replace(self.view, form=layout))

    def take(self, chosen: ArrayLike) -> Split:
        """Return some samples: their indices, or a mask of shape (N,)."""
        return replace(self, view=replace(self.view, at=self.view.at[np.asarray(chosen)]))

    def select(self, ids: Location | Iterable[str]) -> Split:
        """Return the samples with these ``sample_id``s, in the order given.

        Parameters
        ----------
        ids : ids; or a file with them, as written by the dataset's page: a CSV with a column ``sample_id``, or one id a
            line.

        Raises
        ------
        DatasetError : ids that the split does not have, all in one error, or a file that cannot be read.
        """
        wanted = pa.array(read_sample_ids(Path(ids)) if isinstance(ids, str | Path) else list(ids), pa.string())
        row = pc.index_in(wanted, value_set=pa.array(self.column("sample_id"), pa.string()))
        if row.null_count:
            raise DatasetError(self._describe_unknown(wanted.filter(row.is_null())))
        return self.take(row.to_numpy())

    def _describe_unknown(self, ids: pa.Array) -> str:
        """Return which ids are not in the split, and how many of them are in others."""
        table = read_samples(self._columns.directory, ["sample_id", "split"])
        others = table.filter(pc.is_in(table.column("sample_id"), value_set=ids)).column("split").value_counts()
        where = "".join(f"; {group['counts']} of them in {group['values']}" for group in others.to_pylist())
        return f"{self._columns.directory}: no sample {list_first(ids.to_pylist(), _NAMED)} in {self.name}{where}"

    def clean(
        self,
        without: Iterable[str] = (),
        *,
        max_power_std_watt: float | None = None,
        max_velocity_std_mps: float | None = None,
    ) -> Split:
        """Return the samples whose labels are trusted.

        Parameters
        ----------
        without : names of quality bits (``near_gap``, ``high_slip`` …); samples with any of them are left out.
        max_power_std_watt, max_velocity_std_mps : samples with a larger standard deviation are left out [W], [m/s].
        """
        named = {flag_name(bit): int(bit) for bit in Quality}
        unknown = [name for name in without if name not in named]
        if unknown:
            raise DatasetError(f"quality {', '.join(unknown)}: expected some of {', '.join(named)}")
        bits = sum(named[name] for name in set(without))
        good = (self.column("quality").astype(np.int64) & bits) == 0
        for name, limit in ((self.energy.power_std, max_power_std_watt), ("velocity_std_mps", max_velocity_std_mps)):
            if limit is not None:
                good &= self.column(name).astype(np.float64) <= limit
        return self.take(good)

    def fold(self, number: int) -> tuple[Split, Split]:
        """Return the split without a fold of spatial cross-validation, to fit, and that fold, for early stopping."""
        held = self.column("fold") == number
        return self.take(~held), self.take(held)

    def batches(
        self,
        size: int,
        *,
        shuffle: bool = False,
        seed: int = 0,
        mirror: bool = False,
        weights: bool = False,
        features: Sequence[str] = (),
        drop_last: bool = False,
        from_disk: bool | None = None,
    ) -> Batches:
        """Return batches as numpy arrays, an epoch each time they are iterated over.

        Parameters
        ----------
        size : samples in a batch, 1 or more.
        shuffle, seed : another order every epoch, drawn from the seed; from disk, samples are shuffled within pools of
            shuffled chunks.
        mirror : mirror every other sample across its direction of travel, at random: rows of the patch are reversed,
            labels are unchanged.
        weights : third element of each batch: `weights`.
        features : columns of samples.parquet beside the patches: ``slope_rad``, ``cross_slope_rad`` (its sign follows
            the mirror) ….
        drop_last : leave out a last batch that is not full.
        from_disk : decode chunk by chunk instead of keeping the split in memory; None decides by its size.
        """
        if size < 1:
            raise DatasetError(f"batches of {size} samples: expected 1 or more")
        self._require_patches()
        columns = tuple((name, self.column(name)) for name in features)
        textual = [name for name, column in columns if column.dtype.kind not in "biuf"]
        if textual:
            raise DatasetError(f"features {', '.join(textual)}: expected columns of numbers")
        disk = not self.view.stored.fit(self.view.form.layers) if from_disk is None else from_disk
        return Batches(
            view=self.view,
            labels=self.labels,
            weights=self.weights if weights else None,
            features=columns,
            size=size,
            shuffle=shuffle,
            seed=seed,
            mirror=mirror,
            drop_last=drop_last,
            from_disk=disk,
        )

    def torch_iterable(self, size: int, **rules: Any) -> TorchBatches:
        """Return `batches` as an iterable torch dataset for ``DataLoader(…, batch_size=None, num_workers=n)``."""
        from tcpipe.dataset.torch_data import TorchBatches  # noqa: PLC0415  torch only when it is asked for

        return TorchBatches(self.batches(size, **rules))

    def _require_patches(self) -> None:
        if not self.channels:
            raise DatasetError(
                f"{self._columns.directory}: has no patches; "
                "take its samples and labels, or add a map (tcpipe add-map) and build it again"
            )

    def _form_tensor(self, indices: Ints) -> Floats32:
        self._require_patches()
        layers = self.view.form.layers
        if self.view.stored.fit(layers):
            return self.view.form.form(self.view.stored.in_memory(layers), self.view.at[indices])
        return self.view.form.form(self.layers(indices), np.arange(len(indices)))


def _compute_inverse_variance_weights(std: Floats) -> Floats:
    """Return weights with a mean of 1 from standard deviations, shape (N,); 0 if one is not finite."""
    known = np.isfinite(std)
    if not known.any():
        return np.zeros(std.shape)
    least = max(_MIN_STD * float(np.median(std[known])), float(np.finfo(np.float32).tiny))
    weights: Floats = np.where(known, np.maximum(np.where(known, std, 1.0), least) ** -2, 0.0)
    return np.asarray(weights / weights.mean())


@dataclass(eq=False, repr=False)
class Dataset(Mapping[str, Split]):
    """The splits ``train``, ``test``, ``unseen`` and ``buffer`` by name (a split may be empty), and the card."""

    path: Path
    card: DatasetCard
    _splits: Mapping[str, Split]
    _every: Split

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

    @property
    def labels(self) -> tuple[str, ...]:
        """Labels that its samples have: some of energy, time, slip, vibration."""
        return tuple(name for name in LABELS if name not in self.card.absent_labels)

    def select(self, ids: Location | Iterable[str]) -> Split:
        """Return samples of any split, in the order given, as `Split.select` does."""
        return self._every.select(ids)

    def __repr__(self) -> str:
        """Name the dataset and its splits."""
        counts = ", ".join(f"{name} {len(split)}" for name, split in self._splits.items())
        return f"Dataset({str(self.path)!r}: {counts})"

    def _repr_html_(self) -> str:
        """Return the samples of each split by terrain, and the small picture of the map, for notebooks."""
        names = sorted({name for counts in self.card.terrain.values() for name in counts})
        rows = [
            [name, str(len(split)), *(str(self.card.terrain[name].get(ground, 0)) for ground in names)]
            for name, split in self._splits.items()
        ]
        table = format_html_table(f"Dataset {self.path}", rows, ("split", "samples", *names))
        with suppress(OSError):
            picture = base64.b64encode((self.path / OVERVIEW).read_bytes()).decode()
            return f'{table}<img src="data:image/png;base64,{picture}" style="max-height:20em" alt="map">'
        return table


def open_dataset(path: Location, *, layers: Sequence[str] | None = None, label: str = "total") -> Dataset:
    """Open a dataset that ``tcpipe build-dataset`` wrote.

    Parameters
    ----------
    path : its directory, of either format, or the URL of one in a bucket (``s3://…``): patches are fetched when they
        are read, and cached.
    layers : the tensor's channels, in this order; None: the paper's ``ortho``, ``terrain``, ``height``, as far as the
        dataset has them.
    label : which energy the labels are of: ``total``, as measured by the power source, or ``net``, without the idle
        power. T = d / v and E = w d / v are valid for both.

    Raises
    ------
    DatasetError : no dataset, another data model, samples that do not fit the card, or no such layer or label.
    """
    energy = find_energy(label)
    directory, fetched = fetch_directory_by_range(path, by_range=is_shard)
    card = read_intact_card(directory)
    split = read_samples(directory, ["split"]).column("split").to_numpy()
    if len(split) != card.samples:
        raise DatasetError(
            f"{directory}: samples.parquet has {len(split)} rows, its card says {card.samples}; build it again"
        )
    column = read_samples(directory, [energy.power]).column(energy.power)
    has_energy = not card.samples or column.null_count < len(column)
    if not has_energy and label != "total":
        cause = "the robot was never stationary for long; take the label total"
        raise DatasetError(
            f"{directory}: no sample has {energy.power}: "
            f"{cause if card.labels.get('energy') else 'the runs have no power'}"
        )
    files = open_patches(directory, card, fetched)
    requested = [name for name in LAYERS if name in files.layers] if layers is None else layers
    form = make_tensor_layout(requested, files.layers, files.patch_px) if files.layers else TensorLayout((), {}, 0)
    places = find_places_in_files(card, split)

    def make_split(name: str, rows: Ints) -> Split:
        view = SampleView(StoredPixels(files, places[rows]), np.arange(len(rows)), form)
        return Split(name, card, SampleColumns(directory, rows), view, energy, has_energy)

    parts = {name: make_split(name, np.flatnonzero(split == name)) for name in SPLITS}
    return Dataset(directory, card, parts, make_split("selection", np.arange(len(split))))
