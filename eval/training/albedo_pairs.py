"""Makes pairs on which `demc train` makes a prefilter: albedo in the place of radiance.

    python albedo_pairs.py PAIRS... --out OUT

Of each <scene>_<spp>spp.exr and <scene>_ref.exr, Combined becomes what Denoising Albedo was, within 0 to 1 and as much
brighter as radiance is later divided by, and Denoising Albedo becomes 1. References must hold their albedo, as those of
generate_scenes.py do; scenes whose references do not are left out. What is there already is kept.
"""

import argparse
import os

import numpy as np

from clean_references import divisor, exr, pairs, planes

KEPT = ("Combined", "Denoising Normal", "Denoising Albedo")


def lit(channels):
    """Those channels of a frame or reference that a prefilter is trained on; ValueError if it holds no albedo."""
    albedo, albedo_names = planes(channels, "Denoising Albedo", "RGB")
    _, radiance_names = planes(channels, "Combined", "RGB")
    kept = {name: values for name, values in channels.items() if name.rsplit(".", 1)[0].endswith(KEPT)}
    for c, name in enumerate(radiance_names):
        kept[name] = divisor(albedo[..., c])
    kept.update({name: np.ones_like(albedo[..., 0]) for name in albedo_names})
    return kept


def convert(source, target):
    """Writes one frame or reference; returns whether it holds an albedo."""
    try:
        channels = lit(exr.read(source))
    except ValueError:
        return False
    exr.write_half(target, channels)
    return True


def main():
    """Entry point of the script."""
    parser = argparse.ArgumentParser(prog="albedo_pairs.py", description="Puts albedo in the place of radiance.")
    parser.add_argument("pairs", nargs="+", help="folders of <scene>_<spp>spp.exr and <scene>_ref.exr")
    parser.add_argument("--out", required=True, help="folder for the new pairs")
    options = parser.parse_args()
    os.makedirs(options.out, exist_ok=True)
    for folder in options.pairs:
        for scene, reference, noisy in pairs(folder):
            target = os.path.join(options.out, os.path.basename(reference))
            if not noisy or not (os.path.exists(target) or convert(reference, target)):
                continue
            for path in noisy:
                target = os.path.join(options.out, os.path.basename(path))
                if not os.path.exists(target):
                    convert(path, target)
            print(scene, flush=True)


if __name__ == "__main__":
    main()
