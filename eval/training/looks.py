"""Tells how much a model's errors depend on how its squares lie on a picture, and what the mean of two looks gains.

    python looks.py '../shared/data/val/*_0004spp.exr' --model WEIGHTS --oidn PATH/oidnDenoise [--demc PATH/demc]

Every look is the frame, mirrored or not, grown by some columns on the left and rows above by its mirror image. Printed are, as
geometric means of the RelMSE over that of Open Image Denoise (quality high, guides denoised first): every look alone and its
mean with the first, then the mean over looks of the first figure, by which weights compare with less noise than by one look, and
the mean of all looks.
"""

import argparse
import glob
import os
import tempfile

import numpy as np

from clean_references import clean, exr, planes
from methods import add_options, demc

# Mirrored left to right, top to bottom; columns and rows added.
LOOKS = [
    (False, False, 0, 0), (True, True, 0, 0), (True, True, 1, 1), (False, False, 1, 1), (False, False, 2, 2),
    (False, False, 4, 4), (False, False, 8, 8), (True, False, 3, 5), (False, True, 1, 0),
]
GUIDES = ("Combined", "Denoising Normal", "Denoising Albedo")


def mirrored(image, right, down):
    """An image mirrored left to right, top to bottom."""
    return image[:: -1 if down else 1, :: -1 if right else 1]


def seen(channels, look):
    """The channels of a frame that models read, as a look has them; normals turn as pictures do."""
    right, down, columns, rows = look
    frame = {}
    for name, plane in channels.items():
        if not any(f"{guide}." in name for guide in GUIDES):
            continue
        turned = "Normal" in name and (right and name.endswith("X") or down and name.endswith("Y"))
        plane = np.pad(mirrored(plane, right, down), ((rows, 0), (columns, 0)), mode="reflect")
        frame[name] = -plane if turned else plane
    return frame


def denoised(options, channels, look, folder):
    """What the model makes of a look, as the frame lies."""
    right, down, columns, rows = look
    path = os.path.join(folder, "look_0004spp.exr")
    exr.write_half(path, seen(channels, look))
    return mirrored(demc(options.demc, options.model, path, folder)[rows:, columns:], right, down)


def main():
    """Entry point of the script."""
    parser = argparse.ArgumentParser(prog="looks.py", description="Compares looks at the same frames.")
    parser.add_argument("frames", help="quoted glob of noisy frames, <scene>_<spp>spp.exr beside <scene>_ref.exr")
    add_options(parser)
    options = parser.parse_args()
    alone, pairs, whole = [], [], []
    with tempfile.TemporaryDirectory() as folder:
        for path in sorted(glob.glob(options.frames)):
            channels = exr.read(path)
            reference, _ = planes(exr.read(path[: path.rindex("_")] + "_ref.exr"), "Combined", "RGB")
            relmse = lambda image: ((image - reference) ** 2 / (reference**2 + 1e-3)).mean()
            theirs = relmse(clean(options.oidn, folder, planes(channels, "Combined", "RGB")[0], channels))
            images = [denoised(options, channels, look, folder) for look in LOOKS]
            alone.append([relmse(image) / theirs for image in images])
            pairs.append([relmse((images[0] + image) / 2) / theirs for image in images])
            whole.append(relmse(sum(images) / len(images)) / theirs)
    alone, pairs, whole = (np.exp(np.log(ratios).mean(0)) for ratios in (alone, pairs, whole))
    for (right, down, columns, rows), ratio, pair in zip(LOOKS, alone, pairs):
        sides = " and ".join(side for side, is_so in (("sides", right), ("top and bottom", down)) if is_so)
        name = f"{sides or 'nothing'} mirrored, {columns} columns and {rows} rows more"
        print(f"{name:58} {ratio:.4f}, with the first {pair:.4f}")
    print(f"one look, geometric mean {np.exp(np.log(alone).mean()):.4f}; mean of all {whole:.4f}")


if __name__ == "__main__":
    main()
