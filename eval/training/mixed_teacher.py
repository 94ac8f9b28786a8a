"""Writes what a model and Open Image Denoise make of noisy frames together, as targets for `demc train --raw-references`.

    python mixed_teacher.py MANIFEST --out OUT --model demc-m --oidn PATH/oidnDenoise [--demc PATH/demc]

MANIFEST is a CSV of pairs as `demc train --data` takes it. Each noisy frame gets a reference of its own, OUT/<frame>_ref.exr:
the pair's, and as its Noisy Image, against which squared errors are taken, the mean of four looks of the model at that frame and
two of Open Image Denoise (quality high, guides denoised first). Such targets depend on nothing that a network does not see, so they
have no noise of their own. What is there already is kept.
"""

import argparse
import os
import tempfile

import manifests
from clean_references import clean, exr, planes
from looks import denoised, mirrored, seen
from methods import add_options

OURS = [(right, down, 0, 0) for right in (False, True) for down in (False, True)]
THEIRS = [(False, down, 0, 0) for down in (False, True)]


def teach(options, noisy, folder):
    """The mean of what both make of a frame, (height, width, 3)."""
    channels = exr.read(noisy)
    ours = sum(denoised(options, channels, look, folder) for look in OURS) / len(OURS)
    theirs = 0
    for look in THEIRS:
        frame = seen(channels, look)
        theirs = theirs + mirrored(clean(options.oidn, folder, planes(frame, "Combined", "RGB")[0], frame), *look[:2])
    return (ours + theirs / len(THEIRS)) / 2


def main():
    """Entry point of the script."""
    parser = argparse.ArgumentParser(prog="mixed_teacher.py", description="Denoises noisy frames for networks to imitate.")
    parser.add_argument("manifest", help="CSV with columns scene, noisy, reference and spp")
    parser.add_argument("--out", required=True, help="folder for the references and their manifest.csv")
    add_options(parser)
    options = parser.parse_args()
    os.makedirs(options.out, exist_ok=True)
    pairs = []
    with tempfile.TemporaryDirectory() as folder:
        for row in manifests.read(options.manifest):
            frame = os.path.basename(row["noisy"]).removesuffix(".exr")
            target = os.path.join(options.out, f"{frame}_ref.exr")
            if not os.path.exists(target):
                reference, names = planes(exr.read(row["reference"]), "Combined", "RGB")
                taught = teach(options, row["noisy"], folder)
                channels = {name: reference[..., c] for c, name in enumerate(names)}
                channels |= {name.replace("Combined", "Noisy Image"): taught[..., c] for c, name in enumerate(names)}
                exr.write_half(target, channels)
            pairs.append([row["scene"], row["noisy"], target, row["spp"]])
    manifests.write(os.path.join(options.out, "manifest.csv"), pairs)
    print(f"{len(pairs)} pairs in {options.out}")


if __name__ == "__main__":
    main()
