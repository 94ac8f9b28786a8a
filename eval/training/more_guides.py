"""Copies frames with the guides of a render with more samples: what a better filter of albedo and normal could gain, at most.

    python more_guides.py '../shared/data/val/*_0004spp.exr' OUT --spp 16 --guides albedo,normal

Frames without <scene>_<spp>spp.exr beside them, or whose reference does not show the same scene, are for the caller to leave
out. References are copied.
"""

import argparse
import glob
import os
import shutil

from clean_guides import GUIDES
from clean_references import exr, planes


def main():
    """Entry point of the script."""
    parser = argparse.ArgumentParser(prog="more_guides.py", description="Gives frames the guides of more samples.")
    parser.add_argument("frames", help="quoted glob of <scene>_<spp>spp.exr, beside <scene>_ref.exr")
    parser.add_argument("out", help="folder for the frames")
    parser.add_argument("--spp", type=int, default=16, help="samples of the render that the guides are taken from (default 16)")
    parser.add_argument("--guides", default="albedo,normal", help="albedo, normal or both (default)")
    options = parser.parse_args()
    os.makedirs(options.out, exist_ok=True)
    for path in sorted(glob.glob(options.frames)):
        stem = path[: path.rindex("_")]
        more = f"{stem}_{options.spp:04}spp.exr"
        if not os.path.exists(more):
            continue
        frame, other = exr.read(path), exr.read(more)
        for guide in options.guides.split(","):
            name, axes, _ = GUIDES[guide]
            (_, names), (values, _) = planes(frame, name, axes), planes(other, name, axes)
            frame.update({channel: values[..., c] for c, channel in enumerate(names)})
        exr.write_half(os.path.join(options.out, os.path.basename(path)), frame)
        shutil.copy(f"{stem}_ref.exr", options.out)
        print(os.path.basename(stem), flush=True)


if __name__ == "__main__":
    main()
