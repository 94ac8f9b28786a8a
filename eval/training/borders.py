"""Tells how two programs differ on frames that they must pad: RelMSE of one over that of the other.

    python borders.py '../shared/data/val/*_0004spp.exr' --demc BEFORE --demc AFTER --size 480x258 [--model demc-m]

Frames, <scene>_<spp>spp.exr beside <scene>_ref.exr, are cut to that many columns and rows from the top left and denoised. Printed
are geometric means over the frames: of everything, and of the last 16 rows and columns.
"""

import argparse
import glob
import os
import tempfile

import numpy as np

from clean_references import exr, planes
from methods import demc

LAST = 16


def errors(program, model, frame, reference, size, folder):
    """RelMSE of the frame cut to `size`, of its last rows and of its last columns."""
    width, height = size
    source = os.path.join(folder, "in.exr")
    exr.write_half(source, {name: plane[:height, :width] for name, plane in frame.items()})
    image = demc(program, model, source, folder)
    error = ((image - reference[:height, :width]) ** 2 / (reference[:height, :width] ** 2 + 1e-3)).mean(-1)
    return error.mean(), error[-LAST:].mean(), error[:, -LAST:].mean()


def main():
    """Entry point of the script."""
    parser = argparse.ArgumentParser(prog="borders.py", description="Compares two programs on frames of any size.")
    parser.add_argument("frames", help="quoted glob of noisy frames")
    parser.add_argument("--demc", action="append", required=True, help="a program demc; twice, the former of the two first")
    parser.add_argument("--size", required=True, help="columns and rows, as 480x258")
    parser.add_argument("--model", default="demc-m", help="a model's name or a weights file")
    options = parser.parse_args()
    before, after = options.demc
    size, ratios = tuple(map(int, options.size.split("x"))), []
    with tempfile.TemporaryDirectory() as folder:
        for path in sorted(glob.glob(options.frames)):
            reference, _ = planes(exr.read(path[: path.rindex("_")] + "_ref.exr"), "Combined", "RGB")
            frame = exr.read(path)
            old, new = (errors(program, options.model, frame, reference, size, folder) for program in (before, after))
            ratios.append(np.divide(new, old))
    for name, ratio in zip(("all", f"last {LAST} rows", f"last {LAST} columns"), np.exp(np.log(ratios).mean(0))):
        print(f"{name:16} {ratio:.3f}")


if __name__ == "__main__":
    main()
