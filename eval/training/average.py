#!/usr/bin/env python3
"""Averages the weights of runs that share a beginning.

    average.py A.safetensors B.safetensors ... --out FILE

All files hold the same tensors in half precision, as `demc train` writes them. The metadata is that of the
last file, with the largest range that any of the files holds for a layer. Needs numpy.
"""

import argparse

import numpy as np

import weights

parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("files", nargs="+")
parser.add_argument("--out", required=True)
args = parser.parse_args()
facts, tensors = zip(*map(weights.read, args.files))
shapes = [[(name, tensor.shape) for name, tensor in held.items()] for held in tensors]
if any(other != shapes[0] for other in shapes):
    raise SystemExit("these are not weights of one network")
ranges = {}
for held in facts:
    for layer, value in held.get("ranges", {}).items():
        ranges[layer] = max(value, ranges.get(layer, 0.0))
last = facts[-1] | ({"ranges": ranges} if ranges else {})
mean = {name: np.mean([held[name].astype(np.float32) for held in tensors], axis=0) for name in tensors[0]}
weights.write(args.out, last, mean)
