#!/usr/bin/env python3
"""Narrows a pyramid network: at every level the channels that count least are cut away.

    narrow.py IN.safetensors OUT.safetensors --widths 64,80,80,80

A channel counts as much as the norm of the weights that make it times the norm of those that read it, the latter
relative to their mean over the channels of each layer that reads. Channels that were added to a trained network and
hardly learned go without loss (`demc train --init` then widens the network again, by channels that count). The
prefilter stays as it is, or goes too with --drop-prefilter. Needs numpy.
"""

import argparse

import numpy as np

import weights

# A decoder level is this much wider than the encoders beside it, as in src/models/pyramid.rs.
DECODER_EXTRA = 16
PREFILTER = "prefilter."  # the same
ENCODERS = ["encoder.radiance", "encoder.guide"]


def norms(tensor, axis):
    return np.sqrt((tensor.astype(np.float64) ** 2).sum(axis=tuple(i for i in range(tensor.ndim) if i != axis)))


class Network:
    """The tensors of a network; layers by their names."""

    def __init__(self, tensors, widths):
        self.tensors, self.widths = tensors, widths

    def axes(self, layer):
        """The axes of a weight's outputs and inputs."""
        return (1, 0) if layer.endswith(".up") else (0, 1)

    def cut(self, maker, readers, width):
        """Keeps `width` of the channels of layer `maker`, which each of `readers`, a layer and the first of its inputs
        that comes from there, reads."""
        weight = self.tensors[f"{maker}.weight"]
        axis, total = self.axes(maker)[0], len(self.tensors[f"{maker}.bias"])
        count = sum(self.read(layer, first, total) for layer, first in readers) * norms(weight, axis)
        keep = np.sort(np.argsort(-count, kind="stable")[:width])
        self.take(f"{maker}.weight", axis, keep)
        self.take(f"{maker}.bias", 0, keep)
        for layer, first in readers:
            inputs = self.tensors[f"{layer}.weight"].shape[self.axes(layer)[1]]
            rest = np.r_[0:first, first + keep, first + total : inputs]
            self.take(f"{layer}.weight", self.axes(layer)[1], rest)

    def read(self, layer, first, total):
        each = norms(self.tensors[f"{layer}.weight"], self.axes(layer)[1])
        return each[first : first + total] / each.mean()

    def take(self, name, axis, keep):
        self.tensors[name] = np.take(self.tensors[name], keep, axis)

    def narrow(self, level, width):
        """Cuts all channels of one level; `width` is that of its encoders."""
        coarsest, skips = level + 1 == len(self.widths), self.widths[level]
        fuse, refine = f"decoder.{level}.fuse", f"decoder.{level}.refine"
        # From the last source of the decoder's first layer to the first: those before keep their places.
        if not coarsest:
            self.cut(f"decoder.{level}.up", [(fuse, 2 * skips)], width + DECODER_EXTRA)
        for source, encoder in reversed(list(enumerate(ENCODERS))):
            first, second = f"{encoder}.{level}.0", f"{encoder}.{level}.1"
            below = [] if coarsest else [(f"{encoder}.{level + 1}.0", 0)]
            self.cut(first, [(second, 0)], width)
            self.cut(second, [(fuse, source * skips), *below], width)
        self.cut(fuse, [(refine, 0)], width + DECODER_EXTRA)
        above = "head.full" if level == 0 else f"decoder.{level - 1}.up"
        self.cut(refine, [(f"head.{level}", 0), (above, 0)], width + DECODER_EXTRA)
        self.widths[level] = width


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("input")
    parser.add_argument("output")
    parser.add_argument("--widths", required=True, help="channels at each level, finest first")
    parser.add_argument("--drop-prefilter", action="store_true")
    args = parser.parse_args()

    facts, tensors = weights.read(args.input)
    network = Network(tensors, facts["network"]["widths"])
    widths = [int(width) for width in args.widths.split(",")]
    if len(widths) != len(network.widths) or any(w > held for w, held in zip(widths, network.widths)):
        parser.error(f"{args.input} has widths {network.widths}, and no level of it can have more")
    for level, width in enumerate(widths):
        network.narrow(level, width)
    if args.drop_prefilter:
        facts["network"].pop("prefilter", None)
        for part in facts.get("ranges", {}), tensors:
            for name in [name for name in part if name.startswith(PREFILTER)]:
                del part[name]
    weights.write(args.output, facts, tensors)


if __name__ == "__main__":
    main()
