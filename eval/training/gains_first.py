#!/usr/bin/env python3
"""Makes weights of commit fe8fdff and before what the program now reads, the same network: gains_first.py IN OUT

In the head of full resolution the gains stand before the albedo's kernels; where there are none, gains that do nothing.
Needs numpy.
"""

import numpy as np

import weights

# Channels for four pixels: kernels, confidence, mask and corners; the albedo's kernels; gains.
FRONT, ALBEDO, GAINS = 15 * 4, 9 * 4, 3 * 4


def reorder(layer, tensor):
    if not layer.endswith("head.full"):
        return tensor
    albedo = 0 if layer.startswith("prefilter.") else ALBEDO
    front, albedo, gains = np.split(tensor, [FRONT, FRONT + albedo])
    if not len(gains):
        gains = np.zeros((GAINS, *tensor.shape[1:]), tensor.dtype)
    return np.concatenate([front, gains, albedo])


weights.edit(reorder)
