#!/usr/bin/env python3
"""Cuts the channels of the albedo's pyramid off a weights file of commit b2860ac: cut_heads.py IN OUT

What is left is the network as it was before and is again. Needs numpy.
"""

import json
import struct
import sys

import numpy as np

CHANNELS = {"head.full": 160}  # 40 for each of four pixels
TRUNK_HEAD_CHANNELS = 31

source, target = sys.argv[1:]
data = open(source, "rb").read()
end = 8 + struct.unpack("<Q", data[:8])[0]
header = json.loads(data[8:end])
cut, values = {"__metadata__": header.pop("__metadata__")}, b""
for name, tensor in sorted(header.items(), key=lambda item: item[1]["data_offsets"]):
    first, last = (end + offset for offset in tensor["data_offsets"])
    array = np.frombuffer(data[first:last], "<f2").reshape(tensor["shape"])
    layer = name.rsplit(".", 1)[0]
    if layer.startswith("head."):
        array = array[: CHANNELS.get(layer, TRUNK_HEAD_CHANNELS)]
    offsets = [len(values), len(values) + array.nbytes]
    cut[name] = {"dtype": "F16", "shape": list(array.shape), "data_offsets": offsets}
    values += array.tobytes()
text = json.dumps(cut, separators=(",", ":")).encode()
text += b" " * (-len(text) % 8)
open(target, "wb").write(struct.pack("<Q", len(text)) + text + values)
