"""A small network of torch."""

import numpy as np
import torch
from torch import nn


class SmallNetwork:
    def __init__(self, inputs):
        self.scale = np.array(inputs.scale, np.float32)  # largest labels
        layers = (
            nn.Conv2d(len(inputs.planes), 16, 5, 3),
            nn.ReLU(),
            nn.AdaptiveAvgPool2d(1),
            nn.Flatten(),
            nn.Linear(16, 2),
        )
        self.network = nn.Sequential(*layers)

    def run(self, patches):
        return self.network(torch.from_numpy(patches).permute(0, 3, 1, 2))

    @classmethod
    def fit(cls, samples):
        model = cls(samples.inputs)
        optimizer = torch.optim.Adam(model.network.parameters(), 1e-2)
        for epoch in range(5):
            for patches, labels in samples.split.batches(64, shuffle=True, seed=epoch, mirror=True):
                loss = (model.run(patches) - torch.from_numpy(labels / model.scale)).square().mean()
                optimizer.zero_grad()
                loss.backward()
                optimizer.step()
        return model

    def predict(self, patches, features):
        with torch.inference_mode():
            return self.run(patches).numpy() * self.scale

    def to_arrays(self):
        return {name: value.numpy() for name, value in self.network.state_dict().items()}

    @classmethod
    def from_arrays(cls, arrays, inputs):
        model = cls(inputs)
        model.network.load_state_dict({name: torch.from_numpy(value) for name, value in arrays.items()})
        return model
