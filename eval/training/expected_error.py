"""Trains the perceptron that tells how far off a denoised frame is: src/filters/shrinkage/expected.rs.

    cargo run --release --example restraint_features -- demc-m PAIRS.csv FEATURES/m  (others likewise)
    python expected_error.py FEATURES/* --hold-out --out ../../src/filters/shrinkage/expected.safetensors

With --hold-out it reports what it reaches on views that it did not see: the rank correlation with the true
error over squares of 8x8 pixels, and for each tenth of them, ordered by the expected error, the ratio of the
true error to the expected one.

It learns the mean of the squared error over squares of 4x4 pixels, relative to the reference's squared light.
The loss is the deviance of a gamma distribution, t / e + ln(e) for an error t and an expected error e. It is
least where e equals the mean of t, however widely t is spread. The product of the differences to two
references that share no noise is, in the mean, the squared error without their noise. So a pair is listed
twice, the second time with `_b` after its scene's name and another reference. Of a pair that is listed once,
the reference as rendered and the denoised reference serve as the two. Needs torch and safetensors.
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

# The same constants as in features.rs, expected.rs and mod.rs of src/filters/shrinkage.
SQUARE = 4
FLOOR, BLACK, TINY, LARGEST_CHANGE, LEAST, MOST = 0.02, 0.001, 1e-8, 100.0, -14.0, 4.0
WINDOW = torch.tensor([1.0, 4.0, 6.0, 4.0, 1.0])

# Added to the true and to the expected error, so that smaller errors count as alike.
SMALL = 2e-6
BATCH, HELD_OUT = 32, 5

# A squared relative error that counts as none, added to both where their quotient is reported.
NO_ERROR = 1e-4


def means(image, size=SQUARE):
    """Means over squares, (C, H / size, W / size)."""
    return F.avg_pool2d(torch.from_numpy(np.ascontiguousarray(image))[None], size)[0]


def around(squares):
    """Weighted means over 5x5 squares."""
    kernel = (WINDOW[:, None] * WINDOW)[None, None]
    total = lambda planes: F.conv2d(planes[None], kernel, padding=2)[0]
    return total(squares) / total(torch.ones_like(squares))


def read(folders):
    """All frames as they were rendered, each as (features (38, h, w), errors (1, h, w), scene, samples)."""
    paths = {}
    for path in sorted(path for folder in folders for path in glob.glob(os.path.join(folder, "*_0.safetensors"))):
        scene, again, samples = re.match(r"\d+_(.+?)(_b)?_(\d+)spp_0", os.path.basename(path)).groups()
        paths.setdefault((os.path.dirname(path), scene, int(samples)), {})[bool(again)] = path
    frames = []
    for (_, scene, samples), of in paths.items():
        tensors = load_file(of[False])
        height, width = (size // (2 * SQUARE) * 2 * SQUARE for size in tensors["result"].shape[1:])
        result, render, first, clean = (tensors[name][:, :height, :width] for name in ("result", "render", "truth", "clean"))
        second = load_file(of[True])["truth"][:, :height, :width] if True in of else clean
        exposure = tensors["facts"].flatten()[0]
        floor = FLOOR / exposure
        light = 0.5 * (first + second)
        error = (result - first) * (result - second) / (light**2 + min(floor**2, BLACK))
        change = ((render.clip(0) - result) / (result + floor)).mean(0, keepdims=True)
        changed = means(np.minimum(change**2, LARGEST_CHANGE))
        log = lambda planes: torch.log(planes + TINY)
        features = torch.from_numpy(tensors["features"])[:, :height // SQUARE, :width // SQUARE]
        features = torch.cat([features, log(changed), log(around(changed))])
        # Crops and seeds of a scene are held out together.
        scene = re.sub(r"(_c\d+)?(_n\d+|_mean)?$", "", scene)
        frames.append((features.float(), means(error).mean(0, keepdim=True).float(), scene, samples))
    return frames


class Expecting(Perceptron):
    """The logarithm of the error that is expected."""

    def forward(self, standard):
        return self.outputs(standard).clamp(LEAST, MOST)


def train(frames, steps, seed):
    """Returns the trained perceptron and what standardises its features."""
    generator = torch.Generator().manual_seed(seed)
    torch.manual_seed(seed)
    features = torch.stack([frame[0] for frame in frames])
    errors = torch.stack([frame[1] for frame in frames])
    logs = torch.tensor([np.log2(frame[3]) for frame in frames]).float()
    standardise = Standard(features)
    model = Expecting(features.shape[1], [-6.0])
    optimizer = torch.optim.AdamW(model.parameters(), 2e-3, weight_decay=1e-2)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, 2e-3, steps)
    # Each number of samples is drawn equally often, unless it has fewer than 20 frames.
    of_count = {count: sum(frame[3] == count for frame in frames) for count in {frame[3] for frame in frames}}
    weights = torch.tensor([1 / max(of_count[frame[3]], 20) for frame in frames])
    for step in range(steps):
        at = torch.multinomial(weights, BATCH, True, generator=generator)
        seen = features[at].clone()
        known = (torch.rand(BATCH, generator=generator) < 0.75).float()
        blurred = (logs[at] + 0.4 * torch.randn(BATCH, generator=generator)).clamp_min(0)
        seen[:, SAMPLES], seen[:, KNOWN] = (blurred * known).view(-1, 1, 1), known.view(-1, 1, 1)
        expected = model(standardise(seen)).exp()
        # The loss is over squares of 8x8, by which it is judged; the largest errors count by their logarithm.
        expected, error = (F.avg_pool2d(planes, 2) + SMALL for planes in (expected, errors[at]))
        ratio = error / expected
        ratio = torch.where(ratio > 30, 30 + 30 * torch.log(ratio.clamp_min(1) / 30), ratio).clamp_min(-3)
        loss = (ratio + torch.log(expected)).mean()
        perceptron.step(loss, model, optimizer, schedule)
        if (step + 1) % 1000 == 0:
            print(f"step {step + 1}: {loss.item():.3f}", flush=True)
    return model, standardise


def ranks(values):
    """The rank of each value."""
    return np.argsort(np.argsort(values))


def report(name, frames, model, standardise):
    """Prints how the expected errors of frames agree with the true ones."""
    if not frames:
        return
    pairs = []
    for features, error, _, samples in frames:
        features = features.clone()
        features[SAMPLES], features[KNOWN] = float(np.log2(samples)), 1.0
        with torch.no_grad():
            expected = model(standardise(features)[None])[0].exp()
        pairs.append([F.avg_pool2d(planes, 2).flatten().numpy() for planes in (expected, error)])
    expected, error = (np.concatenate(part) for part in zip(*pairs))
    correlate = lambda pair: np.corrcoef(*map(ranks, pair))[0, 1]
    inside = np.nanmean([correlate(pair) for pair in pairs])
    of_frames = np.log([pair[1].mean().clip(1e-7) / pair[0].mean() for pair in pairs]).std()
    tenths = np.array_split(np.argsort(expected), 10)
    factors = " ".join(f"{(error[tenth].mean() + NO_ERROR) / (expected[tenth].mean() + NO_ERROR):.2f}" for tenth in tenths)
    print(f"{name}: {len(frames)} frames; rank {correlate((expected, error)):.3f}, within a frame {inside:.3f}; tenths {factors}; "
          f"mean {error.mean():.5f} / {expected.mean():.5f}, of frames within e^{of_frames:.2f}")


def main():
    """Entry point of the script."""
    parser = argparse.ArgumentParser(prog="expected_error.py", description="Trains how far off a result is expected to be.")
    parser.add_argument("folders", nargs="+", help="what restraint_features.rs wrote, frames of one size")
    parser.add_argument("--out", help="safetensors file to write")
    parser.add_argument("--hold-out", action="store_true", help=f"leave one scene in {HELD_OUT} out, and report on those")
    parser.add_argument("--test", nargs="+", default=[], help="folders of other frames to report on")
    parser.add_argument("--steps", type=int, default=4000)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    frames = read(options.folders)
    is_held_out = lambda frame: options.hold_out and zlib.crc32(frame[2].encode()) % HELD_OUT == 0
    chosen = [frame for frame in frames if not is_held_out(frame)]
    trained = train(chosen, options.steps, options.seed)
    for name, part in (("trained on", chosen), ("held out", [frame for frame in frames if is_held_out(frame)]),
                       ("test", read(options.test))):
        report(name, part, *trained)
        for samples in sorted({frame[3] for frame in part}) if name != "trained on" else ():
            report(f"  {samples} spp", [frame for frame in part if frame[3] == samples], *trained)
    if options.out:
        perceptron.save(*trained, options.out)


if __name__ == "__main__":
    main()
