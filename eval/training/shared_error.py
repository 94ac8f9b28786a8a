"""Tells how much of a model's RelMSE is noise of the references, and how much Open Image Denoise has in
common with it.

    python shared_error.py '../shared/data/val/*_0004spp.exr' --model WEIGHTS --oidn PATH/oidnDenoise

With x and y what the two make of a frame (Open Image Denoise: quality high, guides denoised first), r its
reference and t that reference denoised in the same way, and <a, b> the mean of (a - r) (b - r) / (r^2 +
0.001), printed is for each frame, over RelMSE <y, y>:
- <x, x>, the ratio of the two;
- <x, t>, noise of the reference: what a frame without any noise would still be charged with, plus the
  detail that x and t both lack;
- <x, y>, what is wrong with both alike: noise of the reference, what the samples do not tell, and what
  both blur.

The last line holds geometric means.
"""

import argparse
import glob
import os
import tempfile

import numpy as np

from clean_references import clean, exr, planes
from methods import add_options, both


def main():
    """Entry point of the script."""
    parser = argparse.ArgumentParser(prog="shared_error.py", description="Parts a model's error by who else makes it.")
    parser.add_argument("frames", help="quoted glob of noisy frames, <scene>_<spp>spp.exr beside <scene>_ref.exr")
    add_options(parser)
    options = parser.parse_args()
    print(f"{'scene':20} {'ours':>6} {'noise':>6} {'shared':>6}")
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for path in sorted(glob.glob(options.frames)):
            image, other = both(options, path, folder)
            stem = path[: path.rindex("_")]
            reference, _ = planes(exr.read(stem + "_ref.exr"), "Combined", "RGB")
            denoised = clean(options.oidn, folder, reference, exr.read(path))
            weight = 1 / (reference**2 + 1e-3)
            product = lambda a, b: ((a - reference) * (b - reference) * weight).mean()
            found = [product(image, image), product(image, denoised), product(image, other)]
            rows.append(np.array(found) / product(other, other))
            print(f"{os.path.basename(stem):20}", *(f"{value:6.3f}" for value in rows[-1]))
    print(f"{'geometric mean':20}", *(f"{value:6.3f}" for value in np.exp(np.log(rows).mean(0))))


if __name__ == "__main__":
    main()
