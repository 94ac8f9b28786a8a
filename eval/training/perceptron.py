"""The perceptrons of src/filters/perceptron.rs, as restraint.py, expected_error.py and neighbours.py train them."""

import torch
from safetensors.numpy import save_file
from torch import nn
from torch.nn import functional as F

# The same constants as in perceptron.rs.
HIDDEN, LEAK = 24, 0.1

# Indices of two features: the logarithm to base 2 of the number of samples, and whether that is known.
SAMPLES, KNOWN = 34, 35


class Perceptron(nn.Module):
    """Two hidden layers over standardised features, for each square: (N, features, h, w) to (N, outputs, h, w)."""

    def __init__(self, features, biases):
        super().__init__()
        self.first, self.second = nn.Conv2d(features, HIDDEN, 1), nn.Conv2d(HIDDEN, HIDDEN, 1)
        self.last = nn.Conv2d(HIDDEN, len(biases), 1)
        nn.init.zeros_(self.last.weight)
        self.last.bias.data = torch.tensor(biases)

    def outputs(self, standard):
        """The outputs of the last layer."""
        hidden = F.leaky_relu(self.second(F.leaky_relu(self.first(standard), LEAK)), LEAK)
        return self.last(hidden)


class Standard:
    """Subtracts the mean from features and divides them by their standard deviation."""

    def __init__(self, features):
        """Takes mean and deviation from features (N, features, h, w)."""
        self.mean, self.deviation = features.mean((0, 2, 3)), features.std((0, 2, 3)) + 1e-3
        if features.shape[1] > KNOWN:
            for column, (mean, deviation) in {SAMPLES: (4.0, 4.0), KNOWN: (0.5, 0.5)}.items():
                self.mean[column], self.deviation[column] = mean, deviation

    def __call__(self, features):
        return (features - self.mean.view(-1, 1, 1)) / self.deviation.view(-1, 1, 1)


def step(loss, model, optimizer, schedule):
    """One step of training."""
    optimizer.zero_grad()
    loss.backward()
    nn.utils.clip_grad_norm_(model.parameters(), 1.0)
    optimizer.step()
    schedule.step()


def save(model, standard, path):
    """Writes the weights, with the standardisation in the first layer."""
    flat = {name: value.detach().flatten(1) if value.dim() > 1 else value.detach() for name, value in model.state_dict().items()}
    flat["first.weight"] = flat["first.weight"] / standard.deviation
    flat["first.bias"] = flat["first.bias"] - flat["first.weight"] @ standard.mean
    save_file({name: value.numpy().copy() for name, value in flat.items()}, path)
