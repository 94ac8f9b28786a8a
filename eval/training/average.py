#!/usr/bin/env python3
"""Averages the weights of runs that share a beginning: average.py A.safetensors B.safetensors ... --out FILE

All files hold the same tensors in half precision (what `demc train` writes); the metadata is that of the last.
Needs numpy.
"""

import argparse
import struct

import numpy as np


def read(path):
    """The header and the values of a weights file."""
    data = open(path, "rb").read()
    end = 8 + struct.unpack("<Q", data[:8])[0]
    return data[:end], np.frombuffer(data[end:], "<f2").astype(np.float32)


parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("files", nargs="+")
parser.add_argument("--out", required=True)
args = parser.parse_args()
headers, values = zip(*map(read, args.files))
if len({len(v) for v in values}) != 1:
    raise SystemExit("these are not weights of one network")
open(args.out, "wb").write(headers[-1] + np.mean(values, axis=0).astype("<f2").tobytes())
