"""Trains the perceptron that decides how much of the render a denoised frame keeps:
src/filters/perceptron.rs.

    cargo run --release --example restraint_features -- demc-m PAIRS.csv FEATURES/m      (demc-s likewise)
    python restraint.py FEATURES/m FEATURES/s --hold-out --steps 6000 \\
        --out ../../src/filters/shrinkage/restraint.safetensors

With --hold-out it reports what it reaches on views that it did not see.

The loss is the squared error of the mixture, relative to the brightness of the place. References need not be
clean, since their noise adds the same to every mixture. The loss of each frame is divided by the error that a
mixture can be expected to reach there. Frames with only a part of their noise (restraint_features.rs) teach
that a render without noise is kept. The number of samples is left out or blurred at random, so that mostly
the measured features decide. Needs torch and safetensors.
"""

import argparse
import glob
import os
import re
import zlib

import numpy as np
import torch
from safetensors.numpy import load_file
from torch.nn import functional as F

import perceptron
from perceptron import KNOWN, SAMPLES, Perceptron, Standard

# The same constants as in restraint.rs and mod.rs of src/filters/shrinkage.
SQUARE = 4
FLOOR, OWN_FLOOR, OWN_RANGE, SNAP, LARGEST_CHANGE = 0.02, 1e-6, 3.0, 1 / 64, 1.5

CROP, BATCH, HELD_OUT = 64, 24, 5


class Frames:
    """All frames of some folders, (N, channels, 128, 128). Differences are relative to the brightness of the
    place."""

    def __init__(self, folders):
        paths = sorted(path for folder in folders for path in glob.glob(os.path.join(folder, "*.safetensors")))
        self.scenes = [re.match(r"\d+_(.+)_\d+spp", os.path.basename(path))[1] for path in paths]
        loaded = [load_file(path) for path in paths]
        of = lambda name: torch.from_numpy(np.stack([tensors[name] for tensors in loaded]))
        self.features, facts = of("features"), of("facts").flatten(1)
        render, denoised, truth = of("render").clamp_min(0), of("denoised").clamp_min(0), of("truth")
        exposure, self.samples, self.noise = facts.unbind(1)
        floor = FLOOR / exposure.view(-1, 1, 1, 1)
        light = denoised.mean(1, keepdim=True)
        self.change = (render.mean(1, keepdim=True) - light) / (light + floor)
        around = F.avg_pool2d(truth.mean(1, keepdim=True), 5, 1, 2, count_include_pad=False)
        place = 0.5 * (light + around.clamp_min(0)) + floor
        self.render = ((render - denoised) / place).clamp(-4, 4)
        self.truth = ((truth - denoised) / place).clamp(-4, 4)
        # The error that a mixture can be expected to reach: that of the better of result and render, less the
        # noise of the truth, which is in both and is taken for half of it.
        error = lambda image: ((image - self.truth) ** 2).mean((1, 2, 3))
        self.errors = torch.stack([error(0 * self.render), error(self.render)])
        noise_of_truth = self.errors.min(0).values * 0.5
        self.scale = torch.maximum(self.errors.min(0).values - noise_of_truth, 0.1 * self.errors[0]).clamp_min(2e-4)


class Sharing(Perceptron):
    """How much of the render is kept."""

    def forward(self, standard, usual, change):
        """The share of the render in every pixel: `share_of_render` of mod.rs."""
        judged = torch.cat([self.outputs(standard), usual], 1)
        logit, slope, usual = F.interpolate(judged, scale_factor=SQUARE, mode="bilinear").split(1, 1)
        own = change.clamp(-1, 1)
        unusual = ((own**2 + OWN_FLOOR).log() - usual).clamp(-OWN_RANGE, OWN_RANGE) / OWN_RANGE
        share = (torch.sigmoid(logit + slope * unusual) - SNAP) / (1 - 2 * SNAP)
        share = share.clamp(0, 1)
        return share * (LARGEST_CHANGE / ((1 - share) * change.abs()).clamp_min(1e-9)).clamp_max(1)


def weights_of(frames):
    """How often each frame is drawn: half of the draws are renders with all their noise of 8 samples or more,
    15 % such of fewer samples, and the rest frames with a part of their noise."""
    kind = torch.where(frames.noise < 1, 0, torch.where(frames.samples >= 8, 1, 2))
    share = torch.tensor([0.35, 0.5, 0.15]) / torch.bincount(kind, minlength=3).clamp_min(1)
    return share[kind]


def known_samples(samples, noise, generator):
    """What the perceptron is told of the number of samples: (logarithm to base 2, whether it is known)."""
    draw = torch.rand(len(samples), generator=generator)
    fewer_noise = samples / noise.clamp_min(1 / 64) ** 2
    other = 2 ** (12 * torch.rand(len(samples), generator=generator))
    told = torch.where((noise < 1) & (draw < 0.25), other, fewer_noise)
    known = torch.where(noise < 1, draw < 0.5, draw < 0.75).float()
    blurred = torch.log2(told) + 0.4 * torch.randn(len(samples), generator=generator)
    return blurred.clamp_min(0) * known, known


def train(frames, chosen, steps, seed):
    """Returns the trained perceptron and what standardises its features."""
    generator = torch.Generator().manual_seed(seed)
    torch.manual_seed(seed)
    standardise = Standard(frames.features[chosen])
    model = Sharing(frames.features.shape[1], [-2.0, 0.0])
    optimizer = torch.optim.AdamW(model.parameters(), 3e-3, weight_decay=1e-3)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, 3e-3, steps)
    weights = weights_of(frames)[chosen]
    squares = CROP // SQUARE
    for step in range(steps):
        at = chosen[torch.multinomial(weights, BATCH, True, generator=generator)]
        y, x = (int(torch.randint(0, frames.features.shape[2] - squares + 1, (), generator=generator)) for _ in "yx")
        cut = lambda planes, of: planes[at, :, y * of:(y + squares) * of, x * of:(x + squares) * of]
        features = cut(frames.features, 1).clone()
        log, known = known_samples(frames.samples[at], frames.noise[at], generator)
        features[:, SAMPLES], features[:, KNOWN] = log.view(-1, 1, 1), known.view(-1, 1, 1)
        standard = standardise(features)
        change, render, truth = (cut(planes, SQUARE) for planes in (frames.change, frames.render, frames.truth))
        share = model(standard, features[:, :1], change)
        gain = ((share * render - truth) ** 2 - truth**2).mean((1, 2, 3)) / frames.scale[at]
        loss = gain.clamp(-20, 20).mean()
        perceptron.step(loss, model, optimizer, schedule)
        if (step + 1) % 500 == 0:
            print(f"step {step + 1}: {loss.item():.3f}", flush=True)
    return model, standardise


def report(frames, chosen, model, standardise):
    """Prints mean squared errors on frames that were not trained on, less that of the render, in which the
    noise of the reference is the same."""
    kinds = sorted({(float(frames.noise[at]), float(frames.samples[at])) for at in chosen})
    print("noise, samples: frames; error less that of the render, in 1e-4: denoised, mixed, mixed without samples; worse than the render")
    for noise, samples in kinds:
        at = torch.tensor([i for i in chosen if (frames.noise[i], frames.samples[i]) == (noise, samples)])
        changes = []
        for known in (1.0, 0.0):
            features = frames.features[at].clone()
            features[:, SAMPLES] = known * float(np.log2(samples / max(noise, 1 / 64) ** 2))
            features[:, KNOWN] = known
            with torch.no_grad():
                share = model(standardise(features), features[:, :1], frames.change[at])
            changes.append(((share * frames.render[at] - frames.truth[at]) ** 2).mean((1, 2, 3)) - frames.errors[1, at])
        denoised = frames.errors[0, at] - frames.errors[1, at]
        figures = [1e4 * float(v.mean()) for v in (denoised, *changes)]
        worse = [int((v > 1e-6).sum()) for v in (denoised, *changes)]
        print(f"{noise:.1f}, {samples:.0f}: {len(at)}; " + ", ".join(f"{v:.2f}" for v in figures) + f"; {worse}")


def main():
    """Entry point of the script."""
    parser = argparse.ArgumentParser(prog="restraint.py", description="Trains how much of the render a result keeps.")
    parser.add_argument("folders", nargs="+", help="what restraint_features.rs wrote, pairs of 128x128")
    parser.add_argument("--out", help="safetensors file to write")
    parser.add_argument("--hold-out", action="store_true", help=f"leave one scene in {HELD_OUT} out, and report on those")
    parser.add_argument("--steps", type=int, default=4000)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    frames = Frames(options.folders)
    held_out = torch.tensor([zlib.crc32(scene.encode()) % HELD_OUT == 0 for scene in frames.scenes])
    every = torch.arange(len(frames.scenes))
    chosen = every[~held_out] if options.hold_out else every
    model, standardise = train(frames, chosen, options.steps, options.seed)
    if options.hold_out:
        report(frames, every[held_out].tolist(), model, standardise)
    if options.out:
        perceptron.save(model, standardise, options.out)


if __name__ == "__main__":
    main()
