"""Tells how much of a model's RelMSE is noise of the references, and how much Open Image Denoise has in
common with it.

    python shared_error.py '../shared/data/val/*_0004spp.exr' --model WEIGHTS --oidn PATH/oidnDenoise

Let x be the model's result on a frame and y that of Open Image Denoise (quality high, guides denoised first),
r the frame's reference and t that reference denoised in the same way, and <a, b> the mean of
(a - r) (b - r) / (r^2 + 0.001). Three numbers are printed for each frame, as ratios to <y, y>, which is the
RelMSE of Open Image Denoise:
- <x, x>, which is the ratio of the two RelMSE;
- <x, t>, the noise of the reference: the error that even a frame without any noise would have, plus the
  detail that x and t both lack;
- <x, y>, the error that both have in common: noise of the reference, what the samples do not tell, and what
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
