#!/usr/bin/env python3
"""Cuts the channels of the albedo's pyramid off a weights file of commit b2860ac: cut_heads.py IN OUT

What is left is the network as it was before and is again. Needs numpy.
"""

import sys

import weights

CHANNELS = {"head.full": 160}  # 40 for each of four pixels
TRUNK_HEAD_CHANNELS = 31

source, target = sys.argv[1:]
facts, tensors = weights.read(source)
for name, tensor in tensors.items():
    layer = name.rsplit(".", 1)[0]
    if layer.startswith("head."):
        tensors[name] = tensor[: CHANNELS.get(layer, TRUNK_HEAD_CHANNELS)]
weights.write(target, facts, tensors)
