"""Trains how far a frame is averaged with its neighbours: their renders (src/filters/agreement.rs), and then the
results (src/filters/temporal/likeness.rs).

    python blender_scripts/generate_scenes.py --out SEQUENCES --seeds 520000:521000 --assets ASSETS --sequence 5 \\
        --size 160 --spp 1,4,16 --draw-spp 1 --ref-spp 192 --denoise-references
    cargo run --release --example neighbour_features -- demc-m SEQUENCES/manifest.csv FEATURES
    python eval/training/neighbours.py render FEATURES --out src/filters/agreement.safetensors
    cargo run --release --example neighbour_features -- demc-m SEQUENCES/manifest.csv FEATURES
    python eval/training/neighbours.py result FEATURES --out src/filters/temporal/likeness.safetensors

Results depend on the averaged renders, so that their weights come second. What is made least is the error of the
average beside that of the frame's own, by its logarithm, so that all sequences count alike; where the average is
worse than the frame's own it counts more. For renders it is the relative squared error of means over 3x3 and 7x7
pixels, which is about what a denoiser makes of them; for results it is RelMSE. With --hold-out it reports what it
reaches on sequences that it did not see. Needs torch and safetensors.
"""

import argparse
import glob
import os
import zlib

import torch
from safetensors.torch import load_file
from torch.nn import functional as F

import perceptron
from perceptron import Perceptron, Standard

# Logarithms of the least and the largest weight, as in agreement.rs and likeness.rs.
LEAST = {"render": -8.0, "result": -10.0}
MOST = 0.0

# Features of renders: the relative variance of light, the logarithm of the largest weight by squares of pixels,
# and how far normals of single pixels differ, followed by albedos; and what is added to these two.
VARIANCE, GATE, NORMAL, TINY = 2, 8, 9, 1e-4

# The share of steps' frames that see a neighbour on one side alone, as the first and the last frame of a shot do.
# What moves is then off to one side; between two neighbours, errors of that kind cancel.
ONE_SIDED = 0.5

# Neighbours that take part, of which there is one before and one after.
SIDES = {"both sides": slice(None), "before": slice(0, 1), "after": slice(1, 2)}

# Rows of a frame that are drawn at a time, frames of a step, and that one sequence in so many is held out.
BAND, BATCH, HELD_OUT = 80, 5, 4

# How much more a loss counts than a gain, besides what it counts itself.
HARM = {"render": 4.0, "result": 1.5}

# Of renders: pixels on each side over which errors are averaged, and the most that one such mean counts.
REACHES, LARGEST = (1, 3, 6), 4.0

# Pixels on each side of a square.
SQUARE = 16


class Sequence:
    """A frame, its neighbours and the reference."""

    def __init__(self, tensors, stage, kernel=1):
        count = sum(name.startswith("inside_") for name in tensors)
        stack = lambda name: torch.stack([tensors[f"{name}_{n}"] for n in range(count)])
        self.stage, self.own, self.truth = stage, tensors[stage], tensors["truth"]
        self.there, self.inside = shifted(stack(f"{stage}_there"), kernel), stack("inside")
        self.features = stack(f"{stage}_features").transpose(1, 2)
        self.gate = bound(self.features) if stage == "render" else torch.zeros_like(self.inside)
        self.floor = 0.25 * ((tensors["result"] - self.truth) ** 2 / (self.truth**2 + 0.001)).mean()

    def error(self, image, rows=slice(None)):
        """How far rows of an image are from the reference."""
        truth = self.truth[:, rows]
        relative = lambda image, truth: ((image - truth) ** 2 / (truth**2 + 0.001)).mean(0, keepdim=True)
        if self.stage == "result":
            return [relative(image, truth)]
        means = lambda image, reach: F.avg_pool2d(image, 2 * reach + 1, 1, reach, count_include_pad=False)
        return [relative(means(image, n), means(truth, n)).clamp(max=LARGEST) for n in REACHES]

    def gain(self, model, standard, rows=slice(None), only=slice(None)):
        """The logarithm of the error of the average beside that of the frame's own, square by square."""
        losses = []
        for average, own in zip(*self.errors(model, standard, rows, only)):
            average, own = [F.avg_pool2d(error, SQUARE, ceil_mode=True) for error in (average, own)]
            floor = self.floor
            gain = torch.log((average + floor) / (own + floor))
            losses.append((gain + HARM[self.stage] * gain.clamp_min(0)).mean())
        return sum(losses) / len(losses)

    def ratio(self, model, standard, only=slice(None)):
        """The error of the average beside that of the frame's own."""
        average, own = self.errors(model, standard, only=only)
        return sum(e.mean() for e in average) / sum(e.mean() for e in own).clamp_min(1e-6)

    def errors(self, model, standard, rows=slice(None), only=slice(None)):
        """Errors of the average with some of the neighbours and of the frame's own, in maps."""
        outputs = model.outputs(standard(self.features[only, :, rows]))
        weights = (outputs.clamp(LEAST[self.stage], MOST) + self.gate[only, :, rows]).exp() * self.inside[only, :, rows]
        own = self.own[:, rows]
        of_colours = (weights.unsqueeze(2) * self.there[only, :, :, rows]).sum((0, 1))
        average = (own + of_colours) / (1 + weights.sum((0, 1)))
        return self.error(average, rows), self.error(own, rows)


def bound(features):
    """Logarithms of the largest weights of renders, as in agreement.rs."""
    variance, normal, albedo = features[:, [VARIANCE, NORMAL, NORMAL + 1]].exp().unbind(1)
    bias = 2 * ((albedo - TINY).clamp_min(0) + 0.3 * (normal - TINY).clamp_min(0))
    of_pixels = (16 * variance / (16 * variance + bias)).log().clamp_min(-16)
    return features[:, GATE:GATE + 1] + of_pixels.unsqueeze(1)


def shifted(images, kernel):
    """For each image, the images whose pixels are those of the kernel around each pixel, row by row."""
    height, width = images.shape[-2:]
    padded = F.pad(images, (kernel // 2,) * 4, mode="replicate")
    corners = [(y, x) for y in range(kernel) for x in range(kernel)]
    return torch.stack([padded[..., y:y + height, x:x + width] for y, x in corners], 1)


def train(sequences, steps, seed, kernel=1):
    """The perceptron, and what standardises its features."""
    torch.manual_seed(seed)
    generator = torch.Generator().manual_seed(seed)
    standard = Standard(torch.cat([sequence.features for sequence in sequences]))
    biases = [-4.0] * kernel**2
    biases[kernel**2 // 2] = -0.5
    model = Perceptron(sequences[0].features.shape[1], biases)
    optimizer = torch.optim.AdamW(model.parameters(), 3e-3, weight_decay=1e-2)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, 4e-3, steps)
    for step in range(steps):
        loss = 0.0
        for at in torch.randint(0, len(sequences), (BATCH,), generator=generator).tolist():
            height = sequences[at].own.shape[1]
            first = int(torch.randint(0, max(height - BAND, 0) + 1, (), generator=generator))
            both, *one = SIDES.values()
            side = int(torch.rand((), generator=generator) / ONE_SIDED * len(one))
            rows = slice(first, first + BAND)
            loss = loss + sequences[at].gain(model, standard, rows, one[side] if side < len(one) else both) / BATCH
        perceptron.step(loss, model, optimizer, schedule)
        if (step + 1) % 250 == 0:
            print(f"step {step + 1}: {loss.item():.3f}", flush=True)
    return model, standard


def report(sequences, model, standard):
    """The geometric mean of the average's error beside the frame's own, and the worst, by the sides of its neighbours."""
    for name, only in SIDES.items():
        with torch.no_grad():
            ratios = torch.stack([sequence.ratio(model, standard, only) for sequence in sequences])
        error, worst = ratios.log().mean().exp(), ratios.max()
        print(f"{len(ratios)} sequences, {name}: {error:.3f} of the frame's own error, worst {worst:.3f}")


def main():
    """Entry point of the script."""
    parser = argparse.ArgumentParser(prog="neighbours.py", description="Trains how far a frame is averaged with its neighbours.")
    parser.add_argument("stage", choices=LEAST, help="what is averaged")
    parser.add_argument("folder", help="what neighbour_features.rs wrote")
    parser.add_argument("--out", help="safetensors file to write")
    parser.add_argument("--hold-out", action="store_true", help=f"leave one sequence in {HELD_OUT} out, and report on those")
    parser.add_argument("--kernel", type=int, default=1, help="weights of so many rows and columns around a neighbour's pixel; "
                        "the program knows 1")
    parser.add_argument("--steps", type=int, default=1500)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    if options.out and options.kernel != 1:
        parser.error("the program knows no weights of several pixels")
    paths = sorted(glob.glob(os.path.join(options.folder, "*.safetensors")))
    held_out = lambda path: zlib.crc32(os.path.basename(path).split(".")[0].encode()) % HELD_OUT == 0
    load = lambda paths: [Sequence(file, options.stage, options.kernel) for file in map(load_file, paths) if "inside_0" in file]
    seen = load([path for path in paths if not (options.hold_out and held_out(path))])
    model, standard = train(seen, options.steps, options.seed, options.kernel)
    report(seen, model, standard)
    if options.out:
        perceptron.save(model, standard, options.out)
    kept = [path for path in paths if held_out(path)] if options.hold_out else []
    if kept:
        report(load(kept), model, standard)
    elif options.hold_out:
        print(f"no sequence of {len(paths)} is held out: nothing to report on")


if __name__ == "__main__":
    main()
