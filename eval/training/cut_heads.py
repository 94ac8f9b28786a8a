#!/usr/bin/env python3
"""Cuts the channels of the albedo's pyramid off a weights file of commit b2860ac: cut_heads.py IN OUT

What is left is the network as it was before and is again. Needs numpy.
"""

import weights

CHANNELS = {"head.full": 160}  # 40 for each of four pixels
TRUNK_HEAD_CHANNELS = 31


def cut(layer, tensor):
    return tensor[: CHANNELS.get(layer, TRUNK_HEAD_CHANNELS)] if layer.startswith("head.") else tensor


weights.edit(cut)
