#!/usr/bin/env python3
"""Makes a prefilter with 3x3 kernels at full resolution one with 5x5: wider_kernels.py IN.safetensors OUT.safetensors

IN is a file of `demc train --model prefilter` of commit c9eb157 and before. Pixels that are new to a kernel begin with next to no
share of it. Needs numpy.
"""

import sys

import numpy as np

import weights

OLD, NEW = 3, 5
LEAST = -4.0  # logit of a new pixel, beside the mean of the others' biases
SQUARE = 4  # the head has a channel for each pixel of a 2x2 square


def main():
    """Entry point of the script."""
    source, target = sys.argv[1:]
    facts, tensors = weights.read(source)
    facts.pop("ranges", None)
    edge = (NEW - OLD) // 2
    inner = np.pad(np.ones((OLD, OLD), bool), edge).ravel()
    for name in "head.full.weight", "head.full.bias":
        old = tensors[name].astype("<f4")
        planes = old.reshape(-1, SQUARE, *old.shape[1:])
        kernel = np.zeros((NEW * NEW, *planes.shape[1:]), "<f4")
        kernel[inner] = planes[: OLD * OLD]
        if name.endswith("bias"):
            kernel[~inner] = LEAST + planes[: OLD * OLD].mean(0)
        new = np.concatenate([kernel, planes[OLD * OLD :]])
        tensors[name] = new.reshape(-1, *old.shape[1:])
    weights.write(target, facts, tensors)


if __name__ == "__main__":
    main()
