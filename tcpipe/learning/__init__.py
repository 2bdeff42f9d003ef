"""What a dataset is for: the paper's network, its training, its evaluation, and the paper's whole experiment (extra ``train``).

`training.train` makes a model folder, `models.load_model` reads it, `evaluation.evaluate` measures it, `reproduction.reproduce` does all
from a simulated site on. Torch is imported when a network is made or asked, never before.
"""
