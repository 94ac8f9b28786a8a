"""Tells at which sizes of features a model errs more than Open Image Denoise, quality high with guides
denoised first.

    python octaves.py '../shared/data/val/*_0004spp.exr' --model WEIGHTS --oidn PATH/oidnDenoise

The error relative to the reference is split into octaves: the differences between squares of 1, 2, ... 32
pixels and those twice as large, and the rest. For each octave it prints its share of Open Image Denoise's
squared error (the mean over frames), and the geometric mean of the ratio of the model's to it.
"""

import argparse
import glob
import tempfile

import numpy as np

from clean_references import exr, planes
from methods import add_options, both

OCTAVES = 6


def energies(error):
    """Mean square of each octave of a (height, width, 3) image, finest first, then of the rest."""
    found = []
    for _ in range(OCTAVES):
        height, width = (n // 2 * 2 for n in error.shape[:2])
        fine = error[:height, :width]
        error = fine.reshape(height // 2, 2, width // 2, 2, 3).mean((1, 3))
        found.append(((fine - error.repeat(2, 0).repeat(2, 1)) ** 2).mean())
    return np.array([*found, (error**2).mean()])


def main():
    """Entry point of the script."""
    parser = argparse.ArgumentParser(prog="octaves.py", description="Compares a model with Open Image Denoise by octaves.")
    parser.add_argument("frames", help="quoted glob of noisy frames, <scene>_<spp>spp.exr beside <scene>_ref.exr")
    add_options(parser)
    options = parser.parse_args()
    ours, theirs = [], []
    with tempfile.TemporaryDirectory() as folder:
        for path in sorted(glob.glob(options.frames)):
            image, other = both(options, path, folder)
            reference, _ = planes(exr.read(path[: path.rindex("_")] + "_ref.exr"), "Combined", "RGB")
            weight = 1 / np.sqrt(reference**2 + 1e-3)
            for found, result in ((ours, image), (theirs, other)):
                found.append(energies((result - reference) * weight))
    ours, theirs = np.array(ours), np.array(theirs)
    shares, ratios = (theirs / theirs.sum(1, keepdims=True)).mean(0), np.exp(np.log(ours / theirs).mean(0))
    for octave, (share, ratio) in enumerate(zip(shares, ratios)):
        name = f"{2**octave} to {2 ** (octave + 1)} pixels" if octave < OCTAVES else "above"
        print(f"{name:16} share {share:.3f}, ratio {ratio:.3f}")


if __name__ == "__main__":
    main()
