"""Makes small hard cases of one pair of renders: what a denoiser must leave alone, mend, or see through.

    python make_cases.py NOISY REFERENCE --out DIR

Needs numpy alone. NOISY has Combined, Denoising Albedo and Denoising Normal; a REFERENCE of
development_set.py has clean guides too. Writes <case>_<spp>spp.exr and <case>_ref.exr (32-bit float), a
folder that `demc eval` takes:

    identity      the reference as input: comes out as it went in
    black         no light at all: stays so
    inf_disc      a disc of +inf, 12 pixels wide: is bright, the largest finite value, and does not spread
    nan_pixels    one pixel in a hundred is NaN: is filled from its neighbours
    border        the middle of the frame, cut out: its outermost pixels keep their light
    rolled        left and right changed places: an all-round frame comes out rolled and else the same
    other_guides  guides that the light contradicts, moved by a fifth of the frame: are not followed
"""

import argparse
import os
import re
import sys

import numpy as np

sys.path.insert(0, os.path.dirname(os.path.abspath(__file__)))

from demc_blender import exr, names

_SEED = 1  # of the pixels that become NaN
_BRIGHTEST = np.float32(exr.MOST_HALF)  # the largest finite half, which formats and screens agree on
_LIGHT = (".Combined.R", ".Combined.G", ".Combined.B")
_GUIDES = (".Denoising Albedo", ".Denoising Normal")


def with_light(frame, change):
    """A frame whose radiance is changed, channel by channel."""
    return {name: change(plane) if name.endswith(_LIGHT) else plane for name, plane in frame.items()}


def with_all(frame, change):
    """A frame all of whose channels are changed alike."""
    return {name: change(plane) for name, plane in frame.items()}


def is_guide(name):
    return any(guide in name for guide in _GUIDES)


def identity(noisy, reference):
    return {name: reference.get(name, plane) for name, plane in noisy.items()}, reference


def black(noisy, reference):
    return with_light(noisy, np.zeros_like), with_light(reference, np.zeros_like)


def inf_disc(noisy, reference):
    height, width = next(iter(noisy.values())).shape
    y, x = np.mgrid[:height, :width]
    disc = np.hypot(x - width // 3, y - height // 3) < 6
    put = lambda value: lambda plane: np.where(disc, value, plane)
    return with_light(noisy, put(np.float32(np.inf))), with_light(reference, put(_BRIGHTEST))


def nan_pixels(noisy, reference):
    holes = np.random.default_rng(_SEED).random(next(iter(noisy.values())).shape) < 0.01
    return with_light(noisy, lambda plane: np.where(holes, np.float32(np.nan), plane)), reference


def border(noisy, reference):
    height, width = next(iter(noisy.values())).shape
    middle = np.s_[height // 4 : height - height // 4, width // 4 : width - width // 4]
    return with_all(noisy, lambda plane: plane[middle]), with_all(reference, lambda plane: plane[middle])


def rolled(noisy, reference):
    roll = lambda plane: np.roll(plane, plane.shape[1] // 2, 1)
    return with_all(noisy, roll), with_all(reference, roll)


def other_guides(noisy, reference):
    moved = {name: np.roll(p, p.shape[1] // 5, 1) if is_guide(name) else p for name, p in noisy.items()}
    return moved, reference


CASES = (identity, black, inf_disc, nan_pixels, border, rolled, other_guides)


def read(path):
    """A frame as 32-bit floats."""
    return {name: plane.astype("f4") for name, plane in exr.read(path).items()}


def main():
    """Entry point of the script."""
    parser = argparse.ArgumentParser(prog="make_cases.py", description="Make hard cases of one pair of renders.")
    parser.add_argument("noisy", metavar="NOISY", help="a noisy frame, named <scene>_<spp>spp.exr")
    parser.add_argument("reference", metavar="REFERENCE", help="its reference")
    parser.add_argument("--out", required=True, metavar="DIR", help="folder for the cases")
    options = parser.parse_args()
    spp = re.search(r"_(\d+)spp", os.path.basename(options.noisy))
    if not spp:
        parser.error(f"{options.noisy} is not named <scene>_<spp>spp.exr")
    noisy, reference = read(options.noisy), read(options.reference)
    lacking = [end for end in _LIGHT if not any(name.endswith(end) for name in noisy)]
    lacking += [guide for guide in _GUIDES if not any(guide in name for name in noisy)]
    if lacking:
        parser.error(f"{options.noisy} has no {lacking[0][1:]}: render it with the passes of development_set.py")
    sizes = {plane.shape for frame in (noisy, reference) for plane in frame.values()}
    if len(sizes) > 1:
        parser.error(f"{options.noisy} and {options.reference} are not of one size")
    os.makedirs(options.out, exist_ok=True)
    for case in CASES:
        changed, expected = case(noisy, reference)
        name = case.__name__
        exr.write_float(os.path.join(options.out, names.noisy_name(name, int(spp.group(1)))), changed)
        exr.write_float(os.path.join(options.out, names.reference_name(name)), expected)
    print(f"{len(CASES)} cases in {options.out}")


if __name__ == "__main__":
    main()
