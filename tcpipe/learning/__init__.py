"""A reference trainer for datasets: models, their training and their evaluation (extras ``train`` and ``tables``).

`training.train` writes a model folder, `models.load_model` reads it, `evaluation.evaluate` measures it. Torch is
imported only where a network is created or used.
"""
