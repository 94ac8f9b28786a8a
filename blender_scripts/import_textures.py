"""Makes an assets folder for generate_scenes.py out of any folders of images, by the words in their names.

    python import_textures.py --out DIR FOLDER ...

Meant for the textures of free games: Debian's supertuxkart-data (mostly CC-BY-SA) holds some 550 that fit.
What a name says decides what an image is used for ("old_brick_wall.jpg": brick); images without such a word,
normal and gloss maps, pictures with holes and small ones are left out. DIR/textures/KIND_NAME/color.jpg is
512 pixels wide at most.
"""

import argparse
import os
import re
import sys

import bpy
import numpy as np

sys.path.insert(0, os.path.dirname(os.path.abspath(bpy.path.abspath(__file__))))

from demc_blender import command_line as cl
from demc_scenes.assets import shrink

_LEAST_SIDE = 64  # pixels
_KINDS = tuple((kind, re.compile(words)) for kind, words in (  # the first match wins
    ("bark", "bark|trunk"), ("brick", "brick"), ("tiles", "tile|floor|roof|mosaic"), ("marble", "marble"),
    ("wood", "wood|plank|crate|parquet|board"), ("asphalt", "asphalt|tarmac|road|track"), ("concrete", "concrete|cement"),
    ("plaster", "plaster|wall"), ("metal", "metal|steel|iron|rust|copper|gold"), ("fabric", "fabric|cloth|carpet|rug|wool|textile|flag"),
    ("grass", "grass|moss|turf"), ("ground", "ground|dirt|sand|mud|snow|soil|earth"), ("stone", "stone|rock|cliff|canyon|karst"),
    ("print", "paint|poster|sign|pattern|graffiti|advert|panel")))
_NO_COLOUR = re.compile(r"nm\.|normal|_n\.|gloss|alpha|sky|ibl|mask|splat|light|lit\.|_s\.|shot|minimap|spec|water|lava|rough|leaf|leaves")
_NO_SURFACE = re.compile(r"/(gui|skins|karts|editor|models|skybox|icons?)/")


def parse(arguments):
    """The command line."""
    parser = argparse.ArgumentParser(prog="import_textures.py", description="Make an assets folder of images, by their names.")
    parser.add_argument("--out", required=True, metavar="DIR", help="assets folder to fill")
    parser.add_argument("folders", type=cl.folder, nargs="+", metavar="FOLDER", help="folders with images, searched below")
    return parser.parse_args(arguments)


def candidates(folder):
    """(path, kind) of the images below a folder whose name tells a kind, sorted."""
    for root, folders, files in os.walk(folder):
        folders.sort()
        for file in sorted(files):
            path, plain = os.path.join(root, file), file.lower()
            kind = next((kind for kind, words in _KINDS if words.search(plain)), None)
            if plain.endswith((".jpg", ".jpeg", ".png")) and kind and not _NO_COLOUR.search(plain) and not _NO_SURFACE.search(path):
                yield path, kind


def has_holes(image):
    """Whether more than a hundredth of the pixels let something through."""
    if image.channels != 4:
        return False
    pixels = np.empty(len(image.pixels), np.float32)
    image.pixels.foreach_get(pixels)
    return np.mean(pixels[3::4] < 0.9) > 0.01


def store(path, target):
    """Writes an image as a texture set; False for one that is small, long, or has holes."""
    image = bpy.data.images.load(path)
    try:
        size = tuple(image.size)
        if 0 in size:
            raise ValueError("not an image")
        if min(size) < _LEAST_SIDE or max(size) > 4 * min(size) or has_holes(image):
            return False
        shrink(image)
        os.makedirs(os.path.dirname(target), exist_ok=True)
        image.file_format = "JPEG"
        image.save(filepath=target)
        return True
    finally:
        bpy.data.images.remove(image)


def main():
    """Entry point of the script."""
    options = parse(cl.script_arguments())
    cl.quiet_stdout()
    stored = passed = failed = 0
    for folder in options.folders:
        for path, kind in candidates(folder):
            place = os.path.splitext(os.path.relpath(path, folder))[0]
            name = re.sub(r"\W+", "_", "_".join(place.split(os.sep)[-2:]).lower())
            try:
                kept = store(path, os.path.join(options.out, "textures", f"{kind}_{name}", "color.jpg"))
            except (RuntimeError, ValueError) as error:  # one bad image must not cost the others
                print(f"{path}: left out, {cl.reason(error)}")
                kept = False
                failed += 1
            stored, passed = stored + kept, passed + (not kept)
    print(f"{stored} textures in {options.out}, {passed} of fitting names left out")
    cl.finish(failed)


if __name__ == "__main__":
    main()
