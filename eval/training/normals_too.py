#!/usr/bin/env python3
"""Makes a prefilter of the albedo alone one of albedo and normal, as `demc train --model prefilter` made them up to commit c9eb157:
normals_too.py IN OUT

IN is what prefilter.py takes out of weights of commit 42b799c and before. Its guide encoder also read an albedo of 1, which now goes
into the biases. For what is trained since, wider_kernels.py comes next. Needs numpy.
"""

import sys

import weights

WHITE = 12  # channels of the albedo, three for each of four pixels


def main():
    """Entry point of the script."""
    source, target = sys.argv[1:]
    facts, tensors = weights.read(source)
    facts["network"]["architecture"] = "prefilter"
    facts.pop("ranges", None)
    first = tensors["encoder.guide.0.0.weight"].astype("<f4")
    tensors["encoder.guide.0.0.weight"] = first[:, WHITE:]
    tensors["encoder.guide.0.0.bias"] = tensors["encoder.guide.0.0.bias"] + first[:, :WHITE].sum((1, 2, 3))
    weights.write(target, facts, tensors)


if __name__ == "__main__":
    main()
