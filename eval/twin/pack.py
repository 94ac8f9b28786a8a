"""Packs training pairs small, so that they travel to another machine: half floats of the passes that are
read.

    python pack.py MANIFEST --out train.pack [--megabytes 42] [--from 0] [--frames 4] [--seed 1]

MANIFEST is what generate_scenes.py or export_passes.py writes (scene,noisy,reference,spp). Views, which share
a reference, are taken in an order drawn from the seed, from number --from on, until the pack is full; the
line it prints names the number that the next pack begins with. Of each view at most --frames noisy frames are
taken, spread over its sample counts. A pack holds Combined, Denoising Albedo and Denoising Normal of every
noisy frame. Of every reference it holds Combined, also as it was before it was denoised where it was, and the
guides where it keeps them. SHA-256 of every entry is checked when a pack is read. Needs numpy alone.
"""

import argparse
import contextlib
import csv
import hashlib
import json
import os
import random
import sys
import zipfile
import zlib

import numpy as np

sys.path.insert(0, os.path.join(os.path.dirname(os.path.abspath(__file__)), "..", "..", "blender_scripts"))

from demc_blender import exr

GUIDES = (("Denoising Albedo", "RGB"), ("Denoising Normal", "XYZ"))
NOISY = (("Combined", "RGB"), *GUIDES)
_HALF_MAX = 65504.0
_LISTING = "listing.json"


def squeeze(values):
    """Half floats as compressed bytes: all high bytes first, which often repeat, then the low ones."""
    values = np.nan_to_num(np.asarray(values, "f4"), nan=0.0, posinf=_HALF_MAX, neginf=-_HALF_MAX)
    halves = np.clip(values, -_HALF_MAX, _HALF_MAX).astype("<f2")
    return zlib.compress(np.ascontiguousarray(halves.view("u1").reshape(-1, 2).T).tobytes(), 6)


def unsqueeze(data, shape):
    """The half floats that `squeeze` made bytes of."""
    pairs = np.frombuffer(zlib.decompress(data), "u1").reshape(2, -1).T
    return np.ascontiguousarray(pairs).view("<f2").reshape(shape)


def _planes(channels, passes):
    """Some passes of an EXR file's channels, one after another, (C, H, W); None where one is missing."""
    names = {}
    for channel in channels:
        *_, pass_name, component = f".{channel}".rsplit(".", 2)
        names.setdefault((pass_name, component), channel)
    wanted = [names.get((p, component)) for p, components in passes for component in components]
    return None if None in wanted else np.stack([channels[name] for name in wanted])


def _entries(reference, noisy):
    """The parts that a pack holds of some noisy frames and their reference."""
    channels = exr.read(reference)
    parts = {"reference": _planes(channels, NOISY[:1])}
    if parts["reference"] is None:
        raise ValueError(f"{reference}: no Combined pass")
    parts["raw"] = _planes(channels, (("Noisy Image", "RGB"),))
    parts["guides"] = _planes(channels, GUIDES)
    for i, row in enumerate(noisy):
        parts[f"noisy.{i}"] = _planes(exr.read(row["noisy"]), NOISY)
        if parts[f"noisy.{i}"] is None:
            raise ValueError(f"{row['noisy']}: lacks one of {', '.join(p for p, _ in NOISY)}")
    return {name: planes for name, planes in parts.items() if planes is not None}


def _chosen(rows, most):
    """At most `most` frames, spread over the sample counts and in their order."""
    rows = sorted(rows, key=lambda row: int(row["spp"]))
    if len(rows) <= most:
        return rows
    return [rows[i * len(rows) // most] for i in range(most)]


def write(manifest, out, megabytes, first, frames, seed):
    folder = os.path.dirname(os.path.abspath(manifest))
    views = {}
    with open(manifest, encoding="utf-8", newline="") as file:
        for row in csv.DictReader(file):
            row = {**row, **{key: os.path.join(folder, row[key]) for key in ("noisy", "reference")}}
            views.setdefault(row["reference"], []).append(row)
    order = sorted(views)
    random.Random(seed).shuffle(order)
    listing, size, number = [], 0, first
    partial = f"{out}.tmp"
    os.makedirs(os.path.dirname(os.path.abspath(out)), exist_ok=True)
    with zipfile.ZipFile(partial, "w", zipfile.ZIP_STORED) as pack:
        for number, reference in enumerate(order[first:], first):
            noisy = _chosen(views[reference], frames)
            parts = {name: (squeeze(p), p.shape) for name, p in _entries(reference, noisy).items()}
            size += sum(len(data) for data, _ in parts.values())
            if size > megabytes * 1e6:
                break
            view = {"name": os.path.basename(reference), "spp": [int(row["spp"]) for row in noisy], "parts": {}}
            for name, (data, shape) in parts.items():
                view["parts"][name] = {"shape": shape, "sha256": hashlib.sha256(data).hexdigest()}
                pack.writestr(f"{len(listing)}/{name}", data)
            listing.append(view)
        else:
            number = len(order)
        pack.writestr(_LISTING, json.dumps(listing))
    if not listing:
        raise ValueError(f"{out}: nothing was packed: of {len(order)} views {first} are left out, and the next takes {size / 1e6:.1f} MB")
    os.replace(partial, out)
    pairs = sum(len(view["spp"]) for view in listing)
    print(f"{out}: views {first}:{number} of {len(order)}, {pairs} pairs; the next pack begins with --from {number}")


def read(path):
    """The views of a pack: name, spp of each noisy frame, and its parts as half arrays, (C, H, W)."""
    with zipfile.ZipFile(path) as pack:
        views = json.loads(pack.read(_LISTING))
        for i, view in enumerate(views):
            for name, facts in view["parts"].items():
                data = pack.read(f"{i}/{name}")
                if hashlib.sha256(data).hexdigest() != facts["sha256"]:
                    raise ValueError(f"{path}: {view['name']}, {name} is damaged; pack it anew")
                view["parts"][name] = unsqueeze(data, facts["shape"])
    return views


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("manifest")
    parser.add_argument("--out", required=True)
    parser.add_argument("--megabytes", type=float, default=42)
    parser.add_argument("--from", dest="first", type=int, default=0, metavar="N", help="views left out at first")
    parser.add_argument("--frames", type=int, default=4, help="noisy frames of a view, at most")
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    try:
        write(options.manifest, options.out, options.megabytes, options.first, options.frames, options.seed)
    except KeyError as error:
        sys.exit(f"pack.py: {options.manifest}: no column {error}")
    except (OSError, ValueError) as error:
        sys.exit(f"pack.py: {error}")
    finally:
        with contextlib.suppress(FileNotFoundError):
            os.remove(f"{options.out}.tmp")


if __name__ == "__main__":
    main()
