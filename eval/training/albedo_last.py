#!/usr/bin/env python3
"""Makes weights of commit 599985f and before what the program now reads, the same network: albedo_last.py IN OUT

The albedo's kernels come last of the channels of full resolution, and a prefilter has none. Needs numpy.
"""

import json
import struct
import sys

import numpy as np

FRONT, ALBEDO = 27 * 4, 9 * 4  # taps, confidence and mask of four pixels; their albedo's taps

source, target = sys.argv[1:]
data = open(source, "rb").read()
end = 8 + struct.unpack("<Q", data[:8])[0]
header = json.loads(data[8:end])
kept, values = {"__metadata__": header.pop("__metadata__")}, b""
for name, tensor in sorted(header.items(), key=lambda item: item[1]["data_offsets"]):
    first, last = (end + offset for offset in tensor["data_offsets"])
    array = np.frombuffer(data[first:last], "<f2").reshape(tensor["shape"])
    layer = name.rsplit(".", 1)[0]
    if layer.endswith("head.full"):
        front, albedo, corners = np.split(array, [FRONT, FRONT + ALBEDO])
        array = np.concatenate([front, corners] + ([] if layer.startswith("prefilter.") else [albedo]))
    offsets = [len(values), len(values) + array.nbytes]
    kept[name] = {"dtype": "F16", "shape": list(array.shape), "data_offsets": offsets}
    values += array.tobytes()
text = json.dumps(kept, separators=(",", ":")).encode()
text += b" " * (-len(text) % 8)
open(target, "wb").write(struct.pack("<Q", len(text)) + text + values)
