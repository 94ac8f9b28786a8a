#!/usr/bin/env python3
"""Makes weights of commit 599985f and before what the program now reads, the same network: albedo_last.py IN OUT

The albedo's kernels come last of the channels of full resolution, and a prefilter has none. Needs numpy.
"""

import numpy as np

import weights

FRONT, ALBEDO = 27 * 4, 9 * 4  # taps, confidence and mask of four pixels; their albedo's taps


def reorder(layer, tensor):
    if not layer.endswith("head.full"):
        return tensor
    front, albedo, corners = np.split(tensor, [FRONT, FRONT + ALBEDO])
    return np.concatenate([front, corners] + ([] if layer.startswith("prefilter.") else [albedo]))


weights.edit(reorder)
