"""Trains how far a neighbour's result is averaged with a frame's own: src/filters/temporal/likeness.rs.

    python blender_scripts/generate_scenes.py --out SEQUENCES --seeds 500000:500100 --assets ASSETS --sequence 5 \\
        --size 160 --spp 4,16 --draw-spp 1 --ref-spp 192 --denoise-references
    cargo run --release --example neighbour_features -- demc-m SEQUENCES/manifest.csv FEATURES
    python eval/training/neighbours.py FEATURES --hold-out --out src/filters/temporal/neighbours.safetensors

What is made least is the RelMSE of the average beside that of the frame's own result, by its logarithm, so
that all sequences count alike; where the average is worse than the frame's own it counts more. With --hold-out
it reports what it reaches on sequences that it did not see. Needs torch and safetensors.
"""

import argparse
import glob
import os
import zlib

import torch
from safetensors.torch import load_file

import perceptron
from perceptron import Perceptron, Standard

# As in likeness.rs.
LEAST, MOST, AGREEMENT, LEAST_AGREEMENT = -10.0, 0.0, 6, 1e-3

# Rows of a frame that are drawn at a time, frames of a step, and that one sequence in so many is held out.
BAND, BATCH, HELD_OUT = 64, 8, 4

# Gains below this share of the frame's own error do not count, so that a few sequences that gain much do not
# rule; and how much more a loss counts than a gain.
FLOOR, HARM = 0.02, 2.0


class Sequence:
    """A frame, its neighbours and the reference."""

    def __init__(self, tensors):
        count = _neighbours(tensors)
        self.image, self.truth = tensors["image"], tensors["truth"]
        self.there = torch.stack([tensors[f"there_{n}"] for n in range(count)])
        self.features = torch.stack([tensors[f"features_{n}"].transpose(0, 1) for n in range(count)])
        # What lies outside of a neighbour is the frame's own, and so agrees to the bit.
        self.inside = (self.there != self.image).any(1, keepdim=True).float()
        agreement = self.features[:, AGREEMENT:AGREEMENT + 1].exp()
        self.inside = self.inside * torch.where(agreement > 1.01 * LEAST_AGREEMENT, agreement, 0)
        self.own_error = self.error(self.image)

    def error(self, image, rows=slice(None)):
        """RelMSE of rows of an image."""
        truth = self.truth[:, rows]
        return ((image - truth) ** 2 / (truth**2 + 0.001)).mean()

    def average(self, model, standard, rows=slice(None)):
        """What temporal::blend makes of it."""
        weights = model.outputs(standard(self.features[:, :, rows])).clamp(LEAST, MOST).exp() * self.inside[:, :, rows]
        return (self.image[:, rows] + (weights * self.there[:, :, rows]).sum(0)) / (1 + weights.sum(0))


def _neighbours(tensors):
    return sum(name.startswith("there_") for name in tensors)


def train(sequences, steps, seed):
    """The perceptron, and what standardises its features."""
    torch.manual_seed(seed)
    generator = torch.Generator().manual_seed(seed)
    standard = Standard(torch.cat([sequence.features for sequence in sequences]))
    model = Perceptron(sequences[0].features.shape[1], [-0.5])
    optimizer = torch.optim.AdamW(model.parameters(), 3e-3, weight_decay=1e-2)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, 4e-3, steps)
    for step in range(steps):
        loss = 0.0
        for at in torch.randint(0, len(sequences), (BATCH,), generator=generator).tolist():
            sequence = sequences[at]
            height = sequence.image.shape[1]
            first = int(torch.randint(0, max(height - BAND, 0) + 1, (), generator=generator))
            rows = slice(first, first + BAND)
            own = sequence.error(sequence.image[:, rows], rows)
            gain = torch.log(sequence.error(sequence.average(model, standard, rows), rows) / own.clamp_min(1e-6) + FLOOR)
            loss = loss + (gain + HARM * gain.clamp_min(0)) / BATCH
        perceptron.step(loss, model, optimizer, schedule)
        if (step + 1) % 250 == 0:
            print(f"step {step + 1}: {loss.item():.3f}", flush=True)
    return model, standard


def report(sequences, model, standard):
    """The geometric mean of the average's RelMSE beside the frame's own, and the worst."""
    with torch.no_grad():
        ratios = torch.stack([s.error(s.average(model, standard)) / s.own_error.clamp_min(1e-6) for s in sequences])
    print(f"{len(ratios)} sequences: RelMSE {ratios.log().mean().exp():.3f} of the frame's own, worst {ratios.max():.3f}")


def main():
    """Entry point of the script."""
    parser = argparse.ArgumentParser(prog="neighbours.py", description="Trains how far neighbours' results are averaged.")
    parser.add_argument("folder", help="what neighbour_features.rs wrote")
    parser.add_argument("--out", help="safetensors file to write")
    parser.add_argument("--hold-out", action="store_true", help=f"leave one sequence in {HELD_OUT} out, and report on those")
    parser.add_argument("--steps", type=int, default=1500)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    paths = sorted(glob.glob(os.path.join(options.folder, "*.safetensors")))
    held_out = lambda path: zlib.crc32(os.path.basename(path).split(".")[0].encode()) % HELD_OUT == 0
    load = lambda paths: [Sequence(tensors) for tensors in map(load_file, paths) if _neighbours(tensors)]
    seen = load([path for path in paths if not (options.hold_out and held_out(path))])
    model, standard = train(seen, options.steps, options.seed)
    report(seen, model, standard)
    if options.hold_out:
        report(load([path for path in paths if held_out(path)]), model, standard)
    if options.out:
        perceptron.save(model, standard, options.out)


if __name__ == "__main__":
    main()
