"""Writes two manifests, to train and to validate on, from folders that generate_scenes.py filled.

python split.py TRAIN.csv HELD_OUT.csv FOLDER... [--pairs FOLDER] [--one-in 12] [--spp N] [--score N,...]
                                                 [--train-only KIND,...]

A FOLDER holds manifest.csv (scene, noisy, reference, spp). A scene is held out, with all its views, if the
CRC-32 of its name up to the seed ("s28136" of "s28136_skin") is a multiple of --one-in; of its pairs only those
of --score samples (4) with the first noise seed are scored, no means. Scenes of the kinds of --train-only are never held
out: many seeds look at one .blend file. With --spp only pairs of so many samples are trained on. A
folder after --pairs holds NAME_0004spp.exr and NAME_ref.exr, and all of its views are trained on.
"""
import argparse, re, zlib
from pathlib import Path

import manifests

parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("train", type=Path)
parser.add_argument("held_out", type=Path)
parser.add_argument("folders", type=Path, nargs="+")
parser.add_argument("--pairs", type=Path, action="append", default=[])
parser.add_argument("--one-in", type=int, default=12, metavar="N")
parser.add_argument("--spp")
parser.add_argument("--score", default="4", metavar="N,...")
parser.add_argument("--train-only", default="", metavar="KIND,...")
options = parser.parse_args()
scored, only_trained = options.score.split(","), options.train_only.split(",")

train, held_out = [], []
for folder in options.folders:
    for row in manifests.read(folder / "manifest.csv"):
        pair = [row["scene"], row["noisy"], row["reference"], row["spp"]]
        scene = re.match(r"(s\d+)_?(.*?)(_c\d+)?(_n\d+|_mean)?$", row["scene"])
        if scene is None:
            raise SystemExit(f"{folder / 'manifest.csv'}: scene {row['scene']!r} does not begin with s and its seed")
        seed, kind, _, further = scene.groups()
        if zlib.crc32(seed.encode()) % options.one_in or kind in only_trained:
            if options.spp in (None, row["spp"]):
                train.append(pair)
        elif row["spp"] in scored and not further:
            held_out.append(pair)
if not held_out:
    raise SystemExit(f"no scene is held out that has a frame of {options.score} samples: name others by --score")
for folder in options.pairs:
    for noisy in sorted(folder.glob("*_0004spp.exr")):
        name = noisy.name.removesuffix("_0004spp.exr")
        train.append([name, noisy, folder / f"{name}_ref.exr", "4"])

for path, pairs in (options.train, train), (options.held_out, held_out):
    manifests.write(path, pairs)
    print(f"{path}: {len(pairs)} pairs")
