"""Copies a folder of pairs, or of sequences, with its references cleaned by Open Image Denoise.

    python clean_references.py PAIRS OUT --oidn PATH/oidnDenoise

Each <scene>_ref[.FRAME].exr is denoised by Open Image Denoise, quality high. Its guides, which are denoised
first, are its own albedo and normal, or those of the scene's noisy frame where it has none. The reference as
rendered is kept in it as Noisy Image. Noisy frames and manifest.csv are copied as they are, and files that exist already are
kept. With --join N, for references of N samples, the reference is first averaged with the scene's frame of N
samples. That frame is then no longer one of the pairs, since a network would learn to keep the noise that
both share.
"""

import argparse
import glob
import os
import re
import shutil
import subprocess
import sys
import tempfile

import numpy as np

sys.path.insert(0, os.path.join(os.path.dirname(os.path.abspath(__file__)), "..", "..", "blender_scripts"))

from demc_blender import exr


def pairs(folder):
    """Each (scene, reference, its noisy frames) of a folder; every frame of a sequence is one."""
    folder = glob.escape(folder)
    for reference in sorted(glob.glob(os.path.join(folder, "*_ref.exr")) + glob.glob(os.path.join(folder, "*_ref.*.exr"))):
        scene, frame = re.fullmatch(r"(.+)_ref((?:\.-?\d+)?)\.exr", os.path.basename(reference)).groups()
        # Half buffers and further noise seeds of a still are among its noisy frames.
        ending = f"*{glob.escape(frame)}.exr" if frame else "*.exr"
        noisy = glob.glob(os.path.join(folder, glob.escape(scene) + "_[0-9]*spp" + ending))
        # A scene whose name goes on, such as kitchen_2 beside kitchen, is another one.
        own = re.compile(re.escape(scene) + r"_\d+spp(_\w+)?(\.-?\d+)?\.exr")
        yield scene + frame, reference, sorted(file for file in noisy if own.fullmatch(os.path.basename(file)))


def planes(channels, ending, letters):
    """The channels of the only pass whose name ends in `ending`, (height, width, 3), and their names."""
    found = [[c for c in channels if c.endswith(f"{ending}.{letter}")] for letter in letters]
    if any(len(names) != 1 for names in found):
        raise ValueError(f"no single pass {ending}")
    return np.stack([channels[names[0]].astype("<f4") for names in found], axis=-1), [names[0] for names in found]


def divisor(albedo):
    """What radiance is divided by: `divisor` of src/features.rs."""
    return np.clip(albedo, 0, 1) + 0.05


def write_pfm(path, image):
    with open(path, "wb") as file:
        file.write(b"PF\n%d %d\n-1.0\n" % (image.shape[1], image.shape[0]))
        file.write(image[::-1].astype("<f4").tobytes())


def read_pfm(path):
    with open(path, "rb") as file:
        kind, size, scale = (file.readline().split() for _ in range(3))
        if kind != [b"PF"] or float(scale[0]) >= 0:
            raise ValueError(f"{path}: not a little-endian colour PFM")
        width, height = map(int, size)
        values = np.frombuffer(file.read(), "<f4").reshape(height, width, 3)
    return values[::-1]


def denoise(oidn, folder, output, *flags, **images):
    """Runs oidnDenoise, quality high, on images given by their options (`--hdr`, `--alb`, `--nrm`). An image
    may be the name of a PFM file in `folder`. Returns the result, which also stays there as `output`.pfm."""
    path = lambda name: os.path.join(folder, name + ".pfm")
    arguments = []
    for option, image in images.items():
        name = image if isinstance(image, str) else output + option
        if not isinstance(image, str):
            write_pfm(path(name), image)
        arguments += [option, path(name)]
    command = [oidn, "-d", "cpu", "-q", "high", *arguments, *flags, "-o", path(output)]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    return read_pfm(path(output))


def clean(oidn, folder, radiance, frame):
    """Denoised radiance; `frame` holds the channels of the frame from which the guides are taken."""
    albedo, _ = planes(frame, "Denoising Albedo", "RGB")
    normal, _ = planes(frame, "Denoising Normal", "XYZ")
    denoise(oidn, folder, "albedo", **{"--alb": albedo})
    denoise(oidn, folder, "normal", **{"--nrm": normal})
    guides = {"--alb": "albedo", "--nrm": "normal"}
    return denoise(oidn, folder, "clean", "--clean_aux", **{"--hdr": radiance}, **guides)


def joined(noisy, samples):
    """Splits a scene's noisy frames into those to copy and those of `samples` samples."""
    is_joined = lambda path: samples is not None and re.search(rf"_0*{samples}spp\b", os.path.basename(path))
    return [path for path in noisy if not is_joined(path)], [path for path in noisy if is_joined(path)]


def copy(files, folder):
    """Copies files into a folder, but for those that are there."""
    for path in files:
        target = os.path.join(folder, os.path.basename(path))
        if not os.path.exists(target):
            shutil.copy(path, f"{target}.tmp")
            os.replace(f"{target}.tmp", target)


def main():
    """Entry point of the script."""
    parser = argparse.ArgumentParser(prog="clean_references.py", description="Denoises the references of a folder of pairs.")
    parser.add_argument("pairs", help="folder of <scene>_<spp>spp.exr and <scene>_ref.exr")
    parser.add_argument("out", help="folder for the pairs with clean references")
    parser.add_argument("--oidn", default=os.environ.get("OIDN_DENOISE", "oidnDenoise"), help="the program oidnDenoise")
    parser.add_argument("--join", type=int, metavar="N", help="average references with the frames of N samples")
    options = parser.parse_args()
    os.makedirs(options.out, exist_ok=True)
    manifest = os.path.join(options.pairs, "manifest.csv")
    if options.join is None and os.path.exists(manifest):
        shutil.copy(manifest, options.out)
    with tempfile.TemporaryDirectory() as folder:
        if options.join is None:
            # Frames of a sequence that have no reference are what others take as neighbours.
            copy(glob.glob(os.path.join(glob.escape(options.pairs), "*_[0-9]*spp*.exr")), options.out)
        elif glob.glob(os.path.join(glob.escape(options.pairs), "*_mean.exr")):
            sys.exit(f"{options.pairs}: holds means of renders (*_mean.exr), which share noise with what --join averages")
        for scene, source, noisy in pairs(options.pairs):
            target = os.path.join(options.out, os.path.basename(source))
            if os.path.exists(target) or not joined(noisy, options.join)[0]:
                continue
            noisy, others = joined(noisy, options.join)
            copy(noisy, options.out)
            channels = exr.read(source)
            reference, names = planes(channels, "Combined", "RGB")
            renders = [reference, *(planes(exr.read(path), "Combined", "RGB")[0] for path in others)]
            reference = np.mean(renders, axis=0)
            has_guides = any(name.endswith("Denoising Albedo.R") for name in channels)
            cleaned = clean(options.oidn, folder, reference, channels if has_guides else exr.read(noisy[0]))
            for c, name in enumerate(names):
                channels.update({name: cleaned[..., c], name.replace("Combined", "Noisy Image"): reference[..., c]})
            exr.write_half(target, channels)
            print(scene, flush=True)


if __name__ == "__main__":
    main()
