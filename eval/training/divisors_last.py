#!/usr/bin/env python3
"""Makes weights of commit 8695dd6 and before, with a prefilter, what the program now reads: divisors_last.py IN OUT

The guide encoder reads the ratio of the albedos too, and makes nothing of it yet; the head of full resolution has no kernels
for the albedo any more, and has each pixel divide by the noisy albedo as to a quarter. Needs numpy.
"""

import numpy as np

import weights

# Channels for four pixels: the albedo's kernels; the logarithm of the ratio; the divisor, and its logit.
ALBEDO, RATIOS, DIVISORS, LOGIT = 9 * 4, 4, 4, -1.0


def change(layer, tensor):
    if layer == "encoder.guide.0.0" and tensor.ndim == 4:
        return np.concatenate([tensor, np.zeros_like(tensor[:, :RATIOS])], axis=1)
    if layer == "head.full":
        divisors = np.full_like(tensor[:DIVISORS], LOGIT if tensor.ndim == 1 else 0.0)
        return np.concatenate([tensor[:-ALBEDO], divisors])
    return tensor


weights.edit(change)
