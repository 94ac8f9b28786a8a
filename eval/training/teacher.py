"""Writes what Open Image Denoise makes of noisy frames, as references to imitate.

    python teacher.py MANIFEST --out OUT --oidn PATH/oidnDenoise

MANIFEST is a CSV of pairs as `demc train --data` takes it. Of each reference and number of samples OUT gets <frame>_ref.exr,
named after the first of its noisy frames: the mean of what quality high makes of each, with guides denoised first. They share
it in OUT/manifest.csv, since `demc train` mixes renders of one reference pixel by pixel. A reference holds detail that no network
can know from 4 samples; a teacher's output does not, and so tells with less noise which way the weights should go. What is
there already is kept.
"""

import argparse
import os
import tempfile

import numpy as np

import manifests
from clean_references import clean, exr, planes


def teach(oidn, folder, frames):
    """The mean of what the teacher makes of some frames, and the names of its channels."""
    taught = []
    for frame in frames:
        channels = exr.read(frame)
        radiance, names = planes(channels, "Combined", "RGB")
        taught.append(clean(oidn, folder, radiance, channels).copy())
    return np.mean(taught, axis=0), names


def main():
    """Entry point of the script."""
    parser = argparse.ArgumentParser(prog="teacher.py", description="Denoises noisy frames for networks to imitate.")
    parser.add_argument("manifest", help="CSV with columns noisy, reference and spp")
    parser.add_argument("--out", required=True, help="folder for the references and their manifest.csv")
    parser.add_argument("--oidn", default=os.environ.get("OIDN_DENOISE", "oidnDenoise"), help="the program oidnDenoise")
    options = parser.parse_args()
    os.makedirs(options.out, exist_ok=True)
    views = {}
    for row in manifests.read(options.manifest):
        views.setdefault((row["reference"], row["spp"]), []).append(row["noisy"])
    pairs = []
    with tempfile.TemporaryDirectory() as folder:
        for (_, spp), frames in views.items():
            scenes = [os.path.basename(frame).removesuffix(".exr") for frame in frames]
            target = os.path.join(options.out, f"{scenes[0]}_ref.exr")
            if not os.path.exists(target):
                taught, names = teach(options.oidn, folder, frames)
                exr.write_half(target, {name: taught[..., c] for c, name in enumerate(names)})
            pairs += [[f"{scene}_taught", frame, target, spp] for scene, frame in zip(scenes, frames)]
    manifests.write(os.path.join(options.out, "manifest.csv"), pairs)
    print(f"{len(pairs)} pairs in {options.out}")


if __name__ == "__main__":
    main()
