"""Reads and writes weights files as `demc train` does: safetensors in half precision."""

import json
import struct

import numpy as np

_KEY = "demc"  # src/nn/weights.rs

# Prefix of the names of a prefilter's layers in the network that holds it: src/models/pyramid.rs.
PREFILTER = "prefilter."


def read(path):
    """Returns the facts (network, training, ranges), and the tensors by name in the file's order."""
    data = open(path, "rb").read()
    end = 8 + struct.unpack("<Q", data[:8])[0]
    header = json.loads(data[8:end])
    facts, tensors = json.loads(header.pop("__metadata__")[_KEY]), {}
    for name, tensor in sorted(header.items(), key=lambda item: item[1]["data_offsets"]):
        first, last = (end + offset for offset in tensor["data_offsets"])
        tensors[name] = np.frombuffer(data[first:last], "<f2").reshape(tensor["shape"])
    return facts, tensors


def write(path, facts, tensors):
    """Writes what `read` returns; the tensors may have any precision."""
    header, values = {"__metadata__": {_KEY: json.dumps(facts, separators=(",", ":"))}}, b""
    for name, tensor in tensors.items():
        offsets = [len(values), len(values) + 2 * tensor.size]
        header[name] = {"dtype": "F16", "shape": list(tensor.shape), "data_offsets": offsets}
        values += tensor.astype("<f2").tobytes()
    text = json.dumps(header, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 8)
    with open(path, "wb") as file:
        file.write(struct.pack("<Q", len(text)) + text + values)
