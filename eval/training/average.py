#!/usr/bin/env python3
"""Averages the weights of runs that share a beginning: average.py A.safetensors B.safetensors ... --out FILE

All files hold the same tensors in half precision (what `demc train` writes); the metadata is that of the last, with
the largest range that any of them knows for a layer. Needs numpy.
"""

import argparse
import json
import struct

import numpy as np

KEY = "demc"  # src/nn/weights.rs


def read(path):
    """The header and the values of a weights file."""
    data = open(path, "rb").read()
    end = 8 + struct.unpack("<Q", data[:8])[0]
    return json.loads(data[8:end]), np.frombuffer(data[end:], "<f2").astype(np.float32)


parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("files", nargs="+")
parser.add_argument("--out", required=True)
args = parser.parse_args()
headers, values = zip(*map(read, args.files))
if len({len(v) for v in values}) != 1:
    raise SystemExit("these are not weights of one network")
ranges = {}
for header in headers:
    for layer, value in json.loads(header["__metadata__"][KEY]).get("ranges", {}).items():
        ranges[layer] = max(value, ranges.get(layer, 0.0))
header = headers[-1]
metadata = json.loads(header["__metadata__"][KEY]) | ({"ranges": ranges} if ranges else {})
header["__metadata__"][KEY] = json.dumps(metadata)
header = json.dumps(header).encode()
header += b" " * (-len(header) % 8)
with open(args.out, "wb") as file:
    file.write(struct.pack("<Q", len(header)) + header + np.mean(values, axis=0).astype("<f2").tobytes())
