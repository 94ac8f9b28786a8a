"""Makes training pairs of many samples from denoised references: no render needed.

    python many_samples.py PAIRS OUT --spp 32

A reference of generate_scenes.py --denoise-references holds the noisy image and the guides that it was denoised
from. Each becomes a pair: that image with those guides as <scene>_<spp>spp.exr, and the denoised one as
<scene>_ref.exr. The noise that is left in the reference is not independent of the frame's, but small; what the
pairs teach is to leave alone what needs no filter. What is there already is kept.
"""

import argparse
import os
import sys

from clean_references import exr, pairs

from demc_blender import names  # found through the import above


def main():
    """Entry point of the script."""
    parser = argparse.ArgumentParser(prog="many_samples.py", description="Makes pairs of many samples from denoised references.")
    parser.add_argument("pairs", help="folder of <scene>_ref.exr")
    parser.add_argument("out", help="folder for the pairs")
    parser.add_argument("--spp", type=int, required=True, help="samples of the references")
    options = parser.parse_args()
    os.makedirs(options.out, exist_ok=True)
    for scene, source, _ in pairs(options.pairs):
        channels = exr.read(source)
        noisy = {name.replace("Noisy Image", "Combined"): v for name, v in channels.items() if "Noisy Image" in name}
        if not noisy:
            sys.exit(f"{source}: no pass Noisy Image; render with --denoise-references")
        guides = {name: v for name, v in channels.items() if ".Denoising " in name}
        clean = {name: v for name, v in channels.items() if ".Combined." in name}
        alpha = {name: v for name, v in clean.items() if name.endswith(".A")}
        for name, planes in ((names.noisy_name(scene, options.spp), {**guides, **alpha, **noisy}),
                             (names.reference_name(scene), clean)):
            target = os.path.join(options.out, name)
            if not os.path.exists(target):
                exr.write_half(target, planes)


if __name__ == "__main__":
    main()
