"""Reading a finished dataset: arrays for any trainer, without importing one.

>>> import tcpipe
>>> train = tcpipe.open_dataset("dataset")["train"]  # doctest: +SKIP
>>> train.patches.shape, train.labels.shape  # doctest: +SKIP
((5142, 40, 40, 3), (5142, 2))

A split is a map-style torch dataset as it is: ``torch.utils.data.DataLoader(train, batch_size=64, shuffle=True)``.
"""

from tcpipe.dataset.split import Dataset, Split, open_dataset

__all__ = ["Dataset", "Split", "open_dataset"]
