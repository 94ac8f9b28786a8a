#!/usr/bin/env python3
"""Makes weights of commit 599985f and before what the program now reads, the same network: albedo_last.py IN OUT

The albedo's kernels come last of the channels of full resolution, and a prefilter has none. Needs numpy.
"""

import sys

import numpy as np

import weights

FRONT, ALBEDO = 27 * 4, 9 * 4  # taps, confidence and mask of four pixels; their albedo's taps

source, target = sys.argv[1:]
facts, tensors = weights.read(source)
for name, tensor in tensors.items():
    layer = name.rsplit(".", 1)[0]
    if layer.endswith("head.full"):
        front, albedo, corners = np.split(tensor, [FRONT, FRONT + ALBEDO])
        tensors[name] = np.concatenate([front, corners] + ([] if layer.startswith("prefilter.") else [albedo]))
weights.write(target, facts, tensors)
