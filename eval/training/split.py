"""Writes two manifests, to train and to validate on, from folders that generate_scenes.py filled.

python split.py TRAIN.csv HELD_OUT.csv FOLDER... [--pairs FOLDER] [--one-in 12] [--spp N]

A FOLDER holds manifest.csv (scene, noisy, reference, spp). A scene is held out, with all its views, if the
CRC-32 of its name up to the seed ("s28136" of "s28136_skin") is a multiple of --one-in; of its pairs only the
one with the first noise seed at 4 spp is scored. With --spp only pairs of so many samples are trained on. A
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
options = parser.parse_args()

train, held_out = [], []
for folder in options.folders:
    for row in manifests.read(folder / "manifest.csv"):
        pair = [row["scene"], row["noisy"], row["reference"], row["spp"]]
        scene = re.match(r"s\d+", row["scene"])
        if scene is None:
            raise SystemExit(f"{folder / 'manifest.csv'}: scene {row['scene']!r} does not begin with s and its seed")
        if zlib.crc32(scene.group().encode()) % options.one_in:
            if options.spp in (None, row["spp"]):
                train.append(pair)
        elif row["spp"] == "4" and not re.search(r"_n\d", Path(row["noisy"]).name):
            held_out.append(pair)
for folder in options.pairs:
    for noisy in sorted(folder.glob("*_0004spp.exr")):
        name = noisy.name.removesuffix("_0004spp.exr")
        train.append([name, noisy, folder / f"{name}_ref.exr", "4"])

for path, pairs in (options.train, train), (options.held_out, held_out):
    manifests.write(path, pairs)
    print(f"{path}: {len(pairs)} pairs")
