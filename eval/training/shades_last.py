#!/usr/bin/env python3
"""Makes weights of commit 7f77c17 and before, with a prefilter, what the program now reads: shades_last.py IN OUT

The guide encoder reads the shading too, and makes nothing of it yet; no gain follows it yet either. Needs numpy.
"""

import numpy as np

import weights

CHANNELS = 4  # one, for four pixels


def change(layer, tensor):
    if layer == "encoder.guide.0.0" and tensor.ndim == 4:
        return np.concatenate([tensor, np.zeros_like(tensor[:, :CHANNELS])], axis=1)
    if layer == "head.full":
        return np.concatenate([tensor, np.zeros_like(tensor[:CHANNELS])])
    return tensor


weights.edit(change)
