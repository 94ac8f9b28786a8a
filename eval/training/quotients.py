#!/usr/bin/env python3
"""Tells what dividing radiance by its own noisy albedo is worth.

    python quotients.py '../shared/data/val/*_0004spp.exr' --clean DIR

Of the pixels of each frame whose albedo is more than 5% off, prints the median RelMSE of the radiance as it is, and of the
radiance times the clean albedo over the noisy one. DIR holds the frames with their albedo denoised (`clean_guides.py FRAMES DIR
--oidn PATH/oidnDenoise --guides albedo`), the reference lies beside each frame. Needs numpy.
"""

import argparse
import glob
from pathlib import Path

import numpy as np

from clean_references import divisor, exr, planes

NOISE = 0.05
EPSILON = 1e-3  # of RelMSE


def colours(path, render_pass):
    return planes(exr.read(str(path)), render_pass, "RGB")[0].astype(np.float64)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("frames", help="quoted glob of noisy frames, <scene>_<spp>spp.exr beside <scene>_ref.exr")
    parser.add_argument("--clean", required=True, type=Path)
    args = parser.parse_args()

    for frame in map(Path, sorted(glob.glob(args.frames))):
        scene = frame.name.rsplit("_", 1)[0]
        radiance = colours(frame, "Combined")
        reference = colours(frame.with_name(f"{scene}_ref.exr"), "Combined")
        noisy, clean = (divisor(colours(path, "Denoising Albedo")) for path in (frame, args.clean / frame.name))
        off = np.abs(noisy - clean).mean(axis=-1) > NOISE * clean.mean(axis=-1)
        errors = [
            ((image - reference) ** 2 / (reference**2 + EPSILON)).mean(axis=-1)[off]
            for image in (radiance, radiance * clean / noisy)
        ]
        print(f"{scene}: {off.mean():.1%} of pixels, {np.median(errors[0]):.4f} as it is, {np.median(errors[1]):.4f}")


if __name__ == "__main__":
    main()
