import pickle
import shutil

import numpy as np
import pytest
from synthetic_store import STANDING_WATT, box, region_file, small_store

from tcpipe.dataset import batches as batches_module
from tcpipe.dataset import open_dataset
from tcpipe.dataset.tensor import make_tensor_layout
from tcpipe.errors import DatasetError, UsageError
from tcpipe.pipeline.dataset.build import build_dataset
from tcpipe.recipe import Recipe
from tcpipe.terrain.layers import LAYERS, ClassTable, TerrainClass, make_paper_layers


@pytest.fixture(scope="module")
def directory(tmp_path_factory):
    directory = tmp_path_factory.mktemp("loader")
    store = small_store(directory)
    region = region_file(directory / "region.geojson", box(-20, -20, 5, 20))
    for name in ("zarr", "parquet"):
        build_dataset(directory / name, store=store.root, split=region, recipe=Recipe(), format=name)
    return directory


@pytest.fixture(params=["zarr", "parquet"])
def path(directory, request):
    return directory / request.param


@pytest.fixture
def train(directory):
    return open_dataset(directory / "zarr")["train"]


def test_patches_are_the_papers_tensor(path):
    train = open_dataset(path)["train"]
    assert train.patches.shape == (len(train), 40, 40, 3)
    assert train.patches.dtype == np.float32
    assert train.patches.min() >= 0.0
    assert train.patches.max() <= 1.0
    stored = train.layers(np.arange(5))
    ortho, terrain, height = (train.patches[:5, ..., channel] for channel in range(3))
    np.testing.assert_allclose(ortho, stored["ortho"] / 255, rtol=1e-6)
    np.testing.assert_allclose(terrain, (stored["terrain"] - 1) / 6, rtol=1e-6)
    np.testing.assert_allclose(height, np.minimum(stored["height"] * 0.0005, 1), rtol=1e-6)
    assert (height.min(axis=(1, 2)) == 0).all()


def test_labels_are_power_and_velocity(directory):
    test = open_dataset(directory / "zarr")["test"]
    assert test.labels.dtype == np.float32
    np.testing.assert_array_equal(test.labels[:, 0], test.samples["power_watt"].to_numpy().astype(np.float32))
    np.testing.assert_array_equal(test.labels[:, 1], test.samples["velocity_mps"].to_numpy().astype(np.float32))


def test_net_labels_are_those_of_the_same_samples_less_idle_power(directory):
    path = directory / "zarr"
    total, above = (open_dataset(path, label=name)["test"] for name in ("total", "net"))
    assert above.label_columns == ("net_power_watt", "velocity_mps")
    np.testing.assert_allclose(above.labels[:, 0], total.labels[:, 0] - STANDING_WATT, rtol=1e-6)
    np.testing.assert_array_equal(above.labels[:, 1], total.labels[:, 1])
    np.testing.assert_array_equal(above.patches, total.patches)
    half = above.take(np.arange(len(above)) % 2 == 0)
    np.testing.assert_array_equal(half.labels, above.labels[::2])
    variance = half.column("net_power_std_watt") ** 2
    np.testing.assert_allclose(half.weights[:, 0] * variance, (half.weights[:, 0] * variance)[0], rtol=1e-5)
    assert set(above.clean(max_power_std_watt=1.25).column("net_power_std_watt")) <= {1.0, 1.1, 1.2}
    with pytest.raises(DatasetError, match="label 'sum': expected one of total, net"):
        open_dataset(path, label="sum")


def test_it_is_a_mapping_of_splits(path):
    dataset = open_dataset(path)
    assert list(dataset) == ["train", "test", "unseen", "buffer"]
    assert sum(len(part) for part in dataset.values()) == dataset.card.samples == 448
    with pytest.raises(KeyError, match="no split 'validation'"):
        dataset["validation"]


def test_samples_are_selected_by_id_in_the_order_given(path, tmp_path):
    dataset = open_dataset(path)
    train, unseen = dataset["train"], dataset["unseen"]
    ids = train.column("sample_id")[[9, 2, 5]].tolist()
    chosen = train.select(ids)
    assert chosen.samples["sample_id"].to_pylist() == ids
    np.testing.assert_array_equal(chosen.patches, train.patches[[9, 2, 5]])
    np.testing.assert_array_equal(chosen.labels, train.labels[[9, 2, 5]])
    (tmp_path / "ids.csv").write_text("split;sample_id\n" + "".join(f"train;{name}\n" for name in ids))
    assert train.select(tmp_path / "ids.csv").column("sample_id").tolist() == ids
    assert len(train.select([])) == 0
    others = unseen.column("sample_id")[:2].tolist()
    both = dataset.select([others[1], ids[0]])
    np.testing.assert_array_equal(both.patches, np.stack([unseen.patches[1], train.patches[9]]))
    with pytest.raises(DatasetError) as caught:
        train.select([ids[0], "x", *others, "y"])
    assert len(caught.value.problems) == 1
    assert f"no sample x, {others[0]}, {others[1]}, y in train; 2 of them in unseen" in caught.value.problems[0]


def test_one_sample_and_a_batch_are_rows_of_the_whole(path):
    train = open_dataset(path)["train"]
    patch, label = train[7]
    patches, labels = train.batch([7, -1, 3])
    whole = open_dataset(path)["train"].patches
    np.testing.assert_array_equal(patch, whole[7])
    np.testing.assert_array_equal(label, train.labels[7])
    np.testing.assert_array_equal(patches, whole[[7, -1, 3]])
    np.testing.assert_array_equal(labels, train.labels[[7, -1, 3]])
    for found, row in zip(train.__getitems__([7, 3]), (7, 3), strict=True):  # as a loader of torch asks
        np.testing.assert_array_equal(found[0], whole[row])
        np.testing.assert_array_equal(found[1], train.labels[row])
    with pytest.raises(IndexError):
        train[len(train)]


def test_pieces_read_on_demand_are_the_same_as_all_in_memory(path, monkeypatch):
    whole = open_dataset(path)["unseen"].patches
    monkeypatch.setattr(batches_module, "IN_MEMORY_BYTES", 0)
    monkeypatch.setattr(batches_module, "CACHED_PIECES", 1)
    lazy = open_dataset(path)["unseen"]
    order = np.random.default_rng(0).permutation(len(lazy))
    np.testing.assert_array_equal(lazy.batch(order)[0], whole[order])
    assert not lazy.view.stored._memory
    assert len(lazy.view.stored._pieces) == 1


def test_a_split_travels_to_a_worker_without_its_pixels(path):
    train = open_dataset(path)["train"]
    whole = train.patches
    blob = pickle.dumps(train)
    assert len(blob) < whole.nbytes / 20
    np.testing.assert_array_equal(pickle.loads(blob)[3][0], whole[3])  # noqa: S301


def test_opening_imports_no_trainer(directory):
    import subprocess
    import sys

    opening = "; ".join(f"d.open_dataset({str(directory / name)!r})['train'][0]" for name in ("zarr", "parquet"))
    code = f"import sys, tcpipe.dataset as d; {opening}; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


@pytest.mark.parametrize(("name", "error"), [("none", UsageError), ("dataset", UsageError), ("cut", DatasetError)])
def test_what_cannot_be_read_is_said_in_one_line(path, tmp_path, name, error):
    shutil.copytree(path, tmp_path / "dataset")
    shutil.copytree(path, tmp_path / "cut")
    (tmp_path / "dataset" / "dataset.json").unlink()
    (tmp_path / "cut" / "samples.parquet").write_bytes(b"PAR1 not really")
    with pytest.raises(error) as caught:
        open_dataset(tmp_path / name)["train"].batch([0])
    assert len(caught.value.problems) == 1
    assert str(tmp_path / name) in caught.value.problems[0]


def numbered(split):
    """The split with the samples' numbers for labels."""
    split.labels = np.column_stack([np.arange(len(split))] * 2).astype(np.float32)
    return split


def rebuilt(batches):
    """Patches and labels of an epoch, in the order of the samples."""
    patches, labels = (np.concatenate(parts) for parts in zip(*batches, strict=True))
    order = np.argsort(labels[:, 0])
    return patches[order], labels[order]


@pytest.mark.parametrize("from_disk", [False, True])
@pytest.mark.parametrize("shuffle", [False, True])
def test_an_epoch_has_every_sample_once_in_full_batches(path, from_disk, shuffle, monkeypatch):
    monkeypatch.setattr(batches_module, "_POOL_PIECES", 1)
    train = numbered(open_dataset(path)["train"])
    batches = train.batches(50, shuffle=shuffle, seed=3, from_disk=from_disk)
    found = list(batches)
    assert len(found) == len(batches) == 5
    assert [len(labels) for _, labels in found] == [50, 50, 50, 50, 21]
    patches, labels = rebuilt(found)
    np.testing.assert_array_equal(labels, train.labels)
    np.testing.assert_array_equal(patches, train.patches)
    if not shuffle:
        np.testing.assert_array_equal(np.concatenate([labels for _, labels in found]), train.labels)


@pytest.mark.parametrize("from_disk", [False, True])
def test_every_epoch_has_its_own_order_and_the_same_seed_the_same(path, from_disk):
    def orders(seed):
        batches = open_dataset(path)["train"].batches(64, shuffle=True, seed=seed, from_disk=from_disk, drop_last=True)
        return [np.concatenate([labels for _, labels in batches]) for _ in range(2)]

    first, second = orders(0)
    assert len(first) == 192
    assert not np.array_equal(first, second)
    for mine, again in zip((first, second), orders(0), strict=True):
        np.testing.assert_array_equal(mine, again)
    assert not np.array_equal(first, orders(1)[0])


def test_a_label_whose_error_is_not_known_weighs_nothing(train):
    std = train._columns["power_std_watt"].copy()
    train._columns._read["power_std_watt"] = np.where(np.arange(len(std)) == 3, np.nan, std)
    assert np.isfinite(train.weights).all()
    assert np.flatnonzero(train.weights[:, 0] == 0).tolist() == [3]
    assert train.take([3]).weights[0, 0] == 0


def test_batches_that_cannot_be_are_refused_in_a_line(train):
    with pytest.raises(DatasetError, match="batches of 0 samples: expected 1 or more"):
        train.batches(0)
    with pytest.raises(DatasetError, match="features terrain_name: expected columns of numbers"):
        train.batches(8, features=["slope_rad", "terrain_name"])
    with pytest.raises(DatasetError, match="no column 'slope'"):
        train.batches(8, features=["slope"])


@pytest.mark.parametrize("count", [1, 2, 7, 255])
def test_every_stored_value_becomes_what_the_layers_say(count):
    """All bytes of ortho and terrain, all heights, mirrored or not, bit for bit."""
    rng = np.random.default_rng(0)
    pixels = {
        "ortho": np.tile(np.arange(256, dtype=np.uint8), 256).reshape(-1, 16, 16),
        "terrain": rng.integers(0, count + 1, 65536).astype(np.uint8).reshape(-1, 16, 16),
        "height": np.arange(65536, dtype=np.uint16).reshape(-1, 16, 16),
    }
    rows, mirrored = rng.permutation(256), rng.random(256) < 0.5
    one = np.float32
    grey = pixels["ortho"].astype(one) / one(255)
    classes = np.maximum(pixels["terrain"].astype(one) - one(1), one(0)) / one(max(count - 1, 1))
    heights = np.minimum(pixels["height"].astype(one) * one(0.0005), one(1))
    heights[pixels["height"] == 65535] = 0
    wanted = np.stack([grey, classes, heights], axis=-1)[rows]
    wanted[mirrored] = wanted[mirrored, ::-1]
    known = make_paper_layers(LAYERS, ClassTable((TerrainClass(count, "last", traversable=True),)))
    np.testing.assert_array_equal(
        make_tensor_layout(LAYERS, known, heights.shape[1]).form(pixels, rows, mirrored), wanted
    )
    apart = make_tensor_layout(("height", "ortho", "terrain"), known, heights.shape[1]).form(pixels, rows, mirrored)
    np.testing.assert_array_equal(apart, wanted[..., [2, 0, 1]])


def test_a_mirrored_patch_is_reversed_across_and_its_cross_slope_changes_sign(train):
    train = numbered(train)
    mirrored = 0
    names = ("power_watt", "slope_rad", "cross_slope_rad")
    for (patches, features), labels in train.batches(64, mirror=True, seed=1, features=names):
        for patch, values, row in zip(patches, features, labels[:, 0].astype(int), strict=True):
            expected = np.array([train.column(name)[row] for name in names], np.float32)
            turned = values[2] == -expected[2]
            mirrored += int(turned)
            np.testing.assert_array_equal(patch, train.patches[row][::-1] if turned else train.patches[row])
            np.testing.assert_array_equal(values, expected * np.where(turned, (1, 1, -1), 1))
    assert 80 < mirrored < 141  # 110.5 ± 4 sigma


def test_channels_are_chosen_and_classes_become_planes(train):
    chosen = train.with_channels("height", "terrain_one_hot")
    assert chosen.patches.shape == (len(train), 40, 40, 8)
    np.testing.assert_array_equal(chosen.patches[..., 0], train.patches[..., 2])
    np.testing.assert_array_equal(chosen.patches[..., 1:].sum(axis=-1), 1)
    np.testing.assert_array_equal(
        chosen.patches[..., 1:].argmax(axis=-1) + 1, train.layers(np.arange(len(train)))["terrain"]
    )
    assert chosen.layers(np.arange(1)).keys() == {"height", "terrain"}
    np.testing.assert_array_equal(train.with_channels("ortho").patches[..., 0], train.patches[..., 0])
    np.testing.assert_array_equal(train.with_channels("terrain").patches[..., 0], train.patches[..., 1])
    with pytest.raises(DatasetError, match="this dataset has ortho, terrain, height, terrain_one_hot"):
        train.with_channels("colour")


def test_samples_are_left_out_by_quality_and_error(train):
    train._columns._read["quality"] = np.where(np.arange(len(train)) % 3 == 0, 2, 64)
    train._columns._read["power_std_watt"] = np.arange(len(train)) / 10
    assert len(train.clean(("near_gap",))) == 147
    assert len(train.clean(("near_gap", "no_command"))) == 0
    kept = train.clean(max_power_std_watt=5.0)
    assert len(kept) == 51
    np.testing.assert_array_equal(kept.labels, train.labels[:51])
    np.testing.assert_array_equal(kept.patches, train.patches[:51])
    assert kept.samples["sample_id"].to_pylist() == train.samples["sample_id"].to_pylist()[:51]
    with pytest.raises(DatasetError, match="quality fast: expected some of low_power_rate"):
        train.clean(("fast",))


def test_a_fold_and_the_rest_make_the_whole(train):
    held = [train.fold(number)[1] for number in range(5)]
    assert sum(len(part) for part in held) == len(train)
    for number in range(5):
        rest, mine = train.fold(number)
        assert len(rest) + len(mine) == len(train)
        assert set(mine.samples["fold"].to_pylist()) <= {number}


@pytest.mark.parametrize(("workers", "from_disk"), [(0, False), (2, True)])
def test_torch_iterates_over_every_sample_once(path, workers, from_disk):
    data = pytest.importorskip("torch.utils.data")
    torch = pytest.importorskip("torch")
    train = open_dataset(path)["train"]
    iterable = train.torch_iterable(32, shuffle=True, from_disk=from_disk)
    loader = data.DataLoader(iterable, batch_size=None, num_workers=workers, generator=torch.Generator().manual_seed(0))
    epochs = [torch.cat([labels for _, labels in loader]).numpy() for _ in range(2)]
    for seen in epochs:
        np.testing.assert_array_equal(seen[np.lexsort(seen.T)], train.labels[np.lexsort(train.labels.T)])
    assert not np.array_equal(*epochs)
