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


class Frame:
    """A frame, (channels, H, W), and what is known of it. Differences are relative to the brightness of the place."""

    def __init__(self, path):
        # The scene, without the number of its crop and seed, since a scene is held out as a whole.
        self.scene = re.match(r"\d+_(.+?)(_c\d+)?(_n\d+|_mean)?_\d+spp", os.path.basename(path))[1]
        tensors = {name: torch.from_numpy(planes) for name, planes in load_file(path).items()}
        self.features = tensors["features"]
        render, denoised, truth = tensors["render"].clamp_min(0), tensors["denoised"].clamp_min(0), tensors["truth"]
        exposure, self.samples, self.noise = tensors["facts"].flatten().tolist()
        floor = FLOOR / exposure
        light = denoised.mean(0, keepdim=True)
        self.change = (render.mean(0, keepdim=True) - light) / (light + floor)
        around = F.avg_pool2d(truth.mean(0, keepdim=True)[None], 5, 1, 2, count_include_pad=False)[0]
        place = 0.5 * (light + around.clamp_min(0)) + floor
        self.render = ((render - denoised) / place).clamp(-4, 4)
        self.truth = ((truth - denoised) / place).clamp(-4, 4)
        # Squared errors of what was denoised and of the render, and the error that a mixture can be expected
        # to reach: that of the better of both, less the noise of the truth, which is in both and is taken for
        # half of it.
        self.errors = [float((image**2).mean()) for image in (self.truth, self.render - self.truth)]
        self.scale = max(0.5 * min(self.errors), 0.1 * self.errors[0], 2e-4)

    def crop(self, generator):
        """Features, change, render and truth of a random part of the frame."""
        squares = CROP // SQUARE
        rows, columns = (int(torch.randint(0, side - squares + 1, (), generator=generator)) for side in self.features.shape[1:])
        cut = lambda planes, of: planes[:, rows * of : (rows + squares) * of, columns * of : (columns + squares) * of]
        return cut(self.features, 1), *(cut(planes, SQUARE) for planes in (self.change, self.render, self.truth))


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
    kind = torch.tensor([0 if frame.noise < 1 else 1 if frame.samples >= 8 else 2 for frame in frames])
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


def train(frames, steps, seed):
    """Returns the trained perceptron and what standardises its features."""
    generator = torch.Generator().manual_seed(seed)
    torch.manual_seed(seed)
    standardise = Standard(torch.cat([frame.features.flatten(1) for frame in frames], 1)[None, :, :, None])
    model = Sharing(len(frames[0].features), [-2.0, 0.0])
    optimizer = torch.optim.AdamW(model.parameters(), 3e-3, weight_decay=1e-3)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, 3e-3, steps)
    weights = weights_of(frames)
    for step in range(steps):
        drawn = [frames[at] for at in torch.multinomial(weights, BATCH, True, generator=generator)]
        parts = zip(*(frame.crop(generator) for frame in drawn))
        features, change, render, truth = (torch.stack(part) for part in parts)
        samples, noise, scale = (torch.tensor([getattr(frame, of) for frame in drawn]) for of in ("samples", "noise", "scale"))
        log, known = known_samples(samples, noise, generator)
        features[:, SAMPLES], features[:, KNOWN] = log.view(-1, 1, 1), known.view(-1, 1, 1)
        share = model(standardise(features), features[:, :1], change)
        gain = ((share * render - truth) ** 2 - truth**2).mean((1, 2, 3)) / scale
        loss = gain.clamp(-20, 20).mean()
        perceptron.step(loss, model, optimizer, schedule)
        if (step + 1) % 500 == 0:
            print(f"step {step + 1}: {loss.item():.3f}", flush=True)
    return model, standardise


def report(frames, model, standardise):
    """Prints mean squared errors on frames that were not trained on, less that of the render, in which the
    noise of the reference is the same."""
    print("noise, samples: frames; error less that of the render, in 1e-4: denoised, mixed, mixed without samples; worse than the render")
    for noise, samples in sorted({(frame.noise, frame.samples) for frame in frames}):
        changes = []
        for frame in (frame for frame in frames if (frame.noise, frame.samples) == (noise, samples)):
            denoised, render = frame.errors
            changes.append([denoised - render])
            for known in (1.0, 0.0):
                features = frame.features.clone()
                features[SAMPLES] = known * float(np.log2(samples / max(noise, 1 / 64) ** 2))
                features[KNOWN] = known
                with torch.no_grad():
                    share = model(standardise(features)[None], features[None, :1], frame.change[None])[0]
                changes[-1].append(float(((share * frame.render - frame.truth) ** 2).mean()) - render)
        figures = [f"{1e4 * sum(column) / len(column):.2f}" for column in zip(*changes)]
        worse = [sum(change > 1e-6 for change in column) for column in zip(*changes)]
        print(f"{noise:.1f}, {samples:.0f}: {len(changes)}; " + ", ".join(figures) + f"; {worse}")


def main():
    """Entry point of the script."""
    parser = argparse.ArgumentParser(prog="restraint.py", description="Trains how much of the render a result keeps.")
    parser.add_argument("folders", nargs="+", help="what restraint_features.rs wrote, of pairs of at least 64x64 pixels, sides multiples of 4")
    parser.add_argument("--out", help="safetensors file to write")
    parser.add_argument("--hold-out", action="store_true", help=f"leave one scene in {HELD_OUT} out, and report on those")
    parser.add_argument("--steps", type=int, default=4000)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    paths = sorted(path for folder in options.folders for path in glob.glob(os.path.join(folder, "*.safetensors")))
    frames = [Frame(path) for path in paths]
    is_kept = lambda frame: options.hold_out and zlib.crc32(frame.scene.encode()) % HELD_OUT == 0
    model, standardise = train([frame for frame in frames if not is_kept(frame)], options.steps, options.seed)
    if options.hold_out:
        report([frame for frame in frames if is_kept(frame)], model, standardise)
    if options.out:
        perceptron.save(model, standardise, options.out)


if __name__ == "__main__":
    main()
