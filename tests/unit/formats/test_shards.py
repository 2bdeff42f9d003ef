"""Shards against zarr itself: what one writes, the other reads."""

import numpy as np
import pytest
import zarr

from tcpipe.errors import StoreError
from tcpipe.formats.shards import open_sharded
from tcpipe.formats.zarr_arrays import add_array, create_group

RNG = np.random.default_rng(0)


def array(directory, dtype, *, compression="zstd", shape=(70, 9, 8), fill_value=0):
    """An empty array of chunks of 8 rows, shards of 32."""
    group = create_group(directory / "a.zarr")
    return add_array(
        group,
        "x",
        shape=shape,
        dtype=dtype,
        chunks=(8, 9, 8),
        shards=(32, 9, 8),
        dimensions=("a", "b", "c"),
        fill_value=fill_value,
        compression=compression,
    )


def values(dtype, shape=(70, 9, 8)):
    return RNG.integers(0, 200, shape).cumsum(axis=0).astype(dtype)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
@pytest.mark.parametrize("compression", ["zstd", "lz4"])
def test_zarr_reads_what_is_written_and_the_other_way_round(tmp_path, dtype, compression):
    theirs, data = array(tmp_path, dtype, compression=compression), values(dtype)
    ours = open_sharded(tmp_path / "a.zarr" / "x")
    for number in range(3):
        shard = ours.path / ours.shard_name((number, 0, 0))
        shard.parent.mkdir(parents=True)
        shard.write_bytes(ours.encoded_shard(data[32 * number : 32 * number + 32], threads=2))
    np.testing.assert_array_equal(theirs[:], data)
    theirs[:] = data[::-1]
    again = open_sharded(tmp_path / "a.zarr" / "x")
    read = np.concatenate([again.chunk((number, 0, 0)) for number in range(9)])
    np.testing.assert_array_equal(read[:70], data[::-1])
    assert (read[70:] == 0).all()


def test_threads_do_not_change_a_byte(tmp_path):
    array(tmp_path, np.uint16)
    ours, data = open_sharded(tmp_path / "a.zarr" / "x"), np.arange(32 * 72, dtype=np.uint16).reshape(32, 9, 8)
    assert ours.encoded_shard(data, threads=1) == ours.encoded_shard(data, threads=3)


def test_what_zarr_leaves_out_is_fill_value(tmp_path):
    theirs = array(tmp_path, np.float32, fill_value=float("nan"))
    theirs[8:16] = 1.0
    ours = open_sharded(tmp_path / "a.zarr" / "x", sparse=True)
    assert np.isnan(ours.chunk((0, 0, 0))).all()  # a chunk that is not in its shard
    assert (ours.chunk((1, 0, 0)) == 1.0).all()
    assert np.isnan(ours.chunk((5, 0, 0))).all()  # a shard without a file
    with pytest.raises(StoreError, match="is gone"):
        open_sharded(tmp_path / "a.zarr" / "x").chunk((5, 0, 0))


def test_windows_of_a_plane(tmp_path):
    data = RNG.integers(0, 255, (100, 77), dtype=np.uint8)
    group = create_group(tmp_path / "m.zarr")
    plane = add_array(
        group, "x", shape=data.shape, dtype=np.uint8, chunks=(16, 16), shards=(48, 48), dimensions=("y", "x")
    )
    plane[:] = data
    ours = open_sharded(tmp_path / "m.zarr" / "x")
    for rows, cols in [((0, 16), (0, 16)), ((3, 60), (20, 77)), ((90, 120), (70, 90)), ((5, 6), (5, 6))]:
        np.testing.assert_array_equal(ours.window(*rows, *cols), data[slice(*rows), slice(*cols)])


@pytest.mark.parametrize("where", ["chunk", "index", "end"])
def test_a_changed_byte_is_an_error_never_a_number(tmp_path, where):
    theirs = array(tmp_path, np.uint16)
    theirs[:] = values(np.uint16)
    file = tmp_path / "a.zarr" / "x" / "c" / "0" / "0" / "0"
    data = bytearray(file.read_bytes())
    if where == "end":
        data = data[: len(data) // 2]
    else:
        data[20 if where == "chunk" else -30] ^= 1
    file.write_bytes(data)
    with pytest.raises(StoreError, match=r"chunk \(0, 0, 0\) is damaged"):
        open_sharded(tmp_path / "a.zarr" / "x").chunk((0, 0, 0))


def test_arrays_of_others_are_refused_in_a_line(tmp_path):
    zarr.create_array(tmp_path / "plain.zarr", shape=(4, 4), chunks=(2, 2), dtype="u1")
    with pytest.raises(StoreError, match="not an array that can be read"):
        open_sharded(tmp_path / "plain.zarr")
    with pytest.raises(StoreError, match="is gone"):
        open_sharded(tmp_path / "nothing")
