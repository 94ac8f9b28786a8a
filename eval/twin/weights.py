"""Reads and writes the crate's safetensors files; numpy alone."""

import json
import os
import struct

import numpy as np

_KEY = "demc"
_TYPES = {"F16": "<f2", "F32": "<f4"}


def read_tensors(path):
    """Name -> float32 array, and the metadata."""
    with open(path, "rb") as file:
        data = file.read()
    (length,) = struct.unpack_from("<Q", data)
    header, data = json.loads(data[8 : 8 + length]), data[8 + length :]
    metadata, tensors = json.loads(header.pop("__metadata__")[_KEY]), {}
    for name, entry in header.items():
        first, end = entry["data_offsets"]
        values = np.frombuffer(data[first:end], _TYPES[entry["dtype"]])
        tensors[name] = values.astype("f4").reshape(entry["shape"])
    return tensors, metadata


def write_tensors(path, tensors, metadata):
    """Writes arrays as half floats, whole or not at all."""
    header, parts, at = {"__metadata__": {_KEY: json.dumps(metadata)}}, [], 0
    for name, values in tensors.items():
        values = np.asarray(values, "<f2")
        header[name] = {"dtype": "F16", "shape": list(values.shape), "data_offsets": [at, at + values.nbytes]}
        parts.append(values.tobytes())
        at += values.nbytes
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 8)
    partial = f"{path}.tmp"
    with open(partial, "wb") as file:
        file.write(struct.pack("<Q", len(text)) + text + b"".join(parts))
    os.replace(partial, path)
