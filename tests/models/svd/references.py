"""Small networks of Stable Video Diffusion with random weights, made by the references."""

import numpy as np
import torch

torch.set_num_threads(2)


def randomise(network, seed=0):
    """Draw every tensor, norms, biases and mixtures too: ones and zeros hide faults."""
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for name, tensor in network.named_parameters():
            noise = torch.randn(tensor.shape, generator=generator)
            if tensor.ndim > 1:
                spread = tensor[0].numel() ** -0.5
            else:
                spread = 1.0 if name.endswith("mix_factor") else 0.3
            one = "norm" in name and name.endswith("weight")
            tensor.copy_(one + spread * noise)
    return network.eval().requires_grad_(requires_grad=False)


def draw(*shape, seed=0):
    return np.random.default_rng(seed).normal(size=shape).astype(np.float32)


def first(x):
    """Channels behind frames, as in torch."""
    return torch.tensor(np.moveaxis(np.asarray(x), -1, 2))


def distance(ours, theirs):
    """Return the largest difference over the largest value."""
    ours, theirs = np.asarray(ours, np.float32), np.asarray(theirs, np.float32)
    assert ours.shape == theirs.shape
    return np.abs(ours - theirs).max() / np.abs(theirs).max()
