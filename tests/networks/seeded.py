"""Reproducible weights, so that golden numbers do not need weight files."""

import numpy as np
import torch
from torch import nn


def fill(module: nn.Module, seed: int) -> None:
    """Give a network weights that depend on its keys and their shapes alone.

    Every floating-point value of the state dict, by sorted key, is drawn from one
    `numpy.random.default_rng(seed)`: weights of two and more dimensions normal, over the square root of their
    inputs; weights of one dimension and running variances uniform from 0.5 to 1.5; all else normal, over 10.
    """
    generator = np.random.default_rng(seed)
    with torch.no_grad():
        for key, value in sorted(module.state_dict().items()):
            if value.is_floating_point():
                drawn = _draw(key, tuple(value.shape), generator)
                value.copy_(torch.from_numpy(np.asarray(drawn, np.float32)))


def _draw(key: str, shape: tuple[int, ...], generator: np.random.Generator) -> np.ndarray:
    if len(shape) >= 2:
        return generator.standard_normal(shape) / np.sqrt(np.prod(shape[1:]))
    if key.endswith((".weight", "running_var")):
        return generator.uniform(0.5, 1.5, shape)
    return generator.standard_normal(shape) / 10
