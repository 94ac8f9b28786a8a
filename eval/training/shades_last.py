#!/usr/bin/env python3
"""Makes weights of commit 7f77c17 and before, with a prefilter, what the program now reads: shades_last.py IN OUT

No gain follows the shading yet. Needs numpy.
"""

import numpy as np

import weights

CHANNELS = 4  # one, for four pixels


def change(layer, tensor):
    if layer == "head.full":
        return np.concatenate([tensor, np.zeros_like(tensor[:CHANNELS])])
    return tensor


weights.edit(change)
