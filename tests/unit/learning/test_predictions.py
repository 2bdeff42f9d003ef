"""Predictions sample by sample: which are worst, and how far what is stated of them is true."""

import pyarrow as pa

from tcpipe.learning.predictions import find_worst_rows, make_column_name


def table(label, said, std=None, split=None):
    count = len(label)
    return pa.table(
        {
            "split": split or ["unseen"] * count,
            make_column_name("E"): label,
            make_column_name("E", "predicted"): said,
            make_column_name("E", "predicted_std"): [None] * count if std is None else std,
        },
    ).cast(
        pa.schema(
            [
                ("split", pa.string()),
                *((make_column_name("E", of), pa.float64()) for of in ("", "predicted", "predicted_std")),
            ]
        )
    )


def test_the_worst_of_each_split_come_first():
    label, said = [10.0, 10.0, 10.0, 10.0, 10.0], [10.0, 4.0, 13.0, None, 11.0]
    split = ["test", "test", "test", "unseen", "unseen"]
    assert find_worst_rows(table(label, said, split=split), 2).tolist() == [1, 2, 4]
