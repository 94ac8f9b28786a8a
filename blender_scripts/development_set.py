"""Renders the development set: whole ladders of sample counts of views that nothing is trained on.

    python development_set.py --out DIR --assets ASSETS             with bpy from PyPI
    python development_set.py --out DIR --check                     compares the files with their hashes
    python development_set.py --out DIR --assets ASSETS --credits   says whose assets the views show

Choices between methods are made on this set; what is trained must never see its scenes, whose seeds
generate_scenes.py refuses. Every view is a scene of its own seed, or a second look at one, 240 by 135
pixels: the whole frame, or a crop of a frame of 480 by 270.

Writes <view>_<spp>spp.exr with all passes (half float) for every count of the ladder; counts with further
seeds add ..._n1.exr and ..._n2.exr. <view>_ref.exr (32-bit float, with alpha and clean guides) is the mean
of independent renders. Blender's defaults, adaptive with 4096 samples at most and a noise threshold of 0.01,
are a pair of their own, <view>_adaptive_4096spp.exr and <view>_adaptive_ref.exr, as that frame is clean
enough to serve the other reference: no frame shares a sample with its own. What references are made of stays
in parts/.

manifest.csv (scene,noisy,reference,spp) lists every frame that has its reference; views.csv lists every file
with its seeds, processor seconds, the noise that is left in a reference as RelMSE, and SHA-256. What is
listed and there is not rendered again. The first dozen views, each of another kind, come first with 1 to 64
samples, a reference of up to 1024, and the defaults; then the other views and the rest of the ladder; then
more parts for all.
"""

import argparse
import csv
import logging
import os
import sys
import time

import bpy
import numpy as np

sys.path.insert(0, os.path.dirname(os.path.abspath(bpy.path.abspath(__file__))))

from demc_blender import command_line as cl
from demc_blender import exr, names, rendering
from demc_blender.edits import Edits
from demc_blender.ledger import Ledger
from demc_blender.position import store_position, write_position
from demc_scenes import making
from demc_scenes.assets import Library

_SIZE = (240, 135)
_PANORAMA = (240, 120)
_LARGE = (480, 270)
_DOZEN = 12
# (samples, noise seed), in the order in which they come.
_FIRST = ((1, 0), (2, 0), (4, 0), (8, 0), (16, 0), (64, 0))
_DEFAULTS = (rendering.DEFAULT_SAMPLES, 0)
_THEN = ((256, 0), (4, 1), (4, 2), (64, 1), (64, 2))
_LADDER = _FIRST + _THEN
# A part of a reference: adaptive, with enough samples first that stopping early has no say in the mean.
_PART_NOISE, _PART_LEAST, _PART_MOST = 0.007, 64, 512
_DEFAULTS_WEIGHT = (
    4  # of the render at Blender's defaults beside a part: it has up to eight times the samples
)


class View:
    """A look at a scene: kind, seed, which camera, whole frame or crop, pixel filter."""

    def __init__(self, kind, seed, camera=0, crop=False, box=False):
        self.kind, self.seed, self.camera, self.crop, self.box = (
            kind,
            making.DEVELOPMENT_SEEDS[seed],
            camera,
            crop,
            box,
        )
        self.name = f"dev{seed:02d}_{kind}" + (f"_{camera}" if camera else "")
        self.reference = names.reference_name(self.name)
        self.adaptive = f"{self.name}_adaptive"
        self.adaptive_reference = names.reference_name(self.adaptive)
        self.frame = _LARGE if crop else _PANORAMA if kind == "panorama" else _SIZE
        self.filter = "box" if box else "blackman-harris"

    def noisy(self, spp, seed):
        return names.noisy_name(self.adaptive if (spp, seed) == _DEFAULTS else self.name, spp, seed=seed)

    def part(self, which):
        return f"parts/{self.name}_ref_{which}.exr"


# Many kinds first, so that a set that is under way serves already.
VIEWS = (
    View("print", 41),
    View("embossed", 8, crop=True),
    View("glass", 6),
    View("cutout", 12),
    View("glints", 41),
    View("foliage", 41),
    View("backdrop", 52),
    View("pool", 40),
    View("screens", 27),
    View("beams", 51),
    View("sunlit", 2, crop=True),
    View("hair", 51),
    View("stars", 61),
    View("street", 17),
    View("materials", 21),
    View("skin", 20, crop=True),
    View("panorama", 43),
    View("bokeh", 43),
    View("room", 1),
    View("print", 43, crop=True, box=True),
    View("cutout", 42),
    View("fog", 19),
    View("outdoor", 23),
    View("foliage", 43, box=True),
    View("backdrop", 54, crop=True),
    View("glints", 11, crop=True),
    View("pool", 43, crop=True),
    View("beams", 56),
    View("glass", 6, 1, box=True),
    View("relief", 50, crop=True),
    View("stars", 58, crop=True),
    View("street", 17, 1, crop=True),
    View("manylights", 14, crop=True),
    View("screens", 44, crop=True),
    View("room", 26, crop=True),
    View("beams", 71),
    View("hair", 53, crop=True),
)


def parse(arguments):
    """The command line."""
    parser = argparse.ArgumentParser(
        prog="development_set.py",
        description="Render the development set.",
        epilog=f"Views: {', '.join(view.name for view in VIEWS)}.",
    )
    parser.add_argument("--out", required=True, metavar="DIR", help="folder for the set")
    parser.add_argument(
        "--assets",
        type=cl.folder,
        action="append",
        default=[],
        metavar="DIR",
        help="models, textures, HDRIs and pictures to furnish with; may be repeated. The set is what it "
        "is with the assets it was made with",
    )
    parser.add_argument("--views", metavar="a,b", help="these views only (default: all)")
    parser.add_argument(
        "--spp",
        type=cl.counts,
        metavar="N[,N]",
        help="these sample counts only and no references, for a first look",
    )
    parser.add_argument(
        "--check", action="store_true", help="render nothing, compare files with their hashes"
    )
    parser.add_argument(
        "--credits",
        action="store_true",
        help="render nothing, write credits.csv: each asset with its author, licence and views",
    )
    parser.add_argument("--threads", type=cl.positive, metavar="N", help="CPU threads (default: all)")
    options = parser.parse_args(arguments)
    known = {view.name: view for view in VIEWS}
    chosen = options.views.split(",") if options.views else list(known)
    unknown = set(chosen) - set(known)
    if unknown:
        parser.error(f"unknown view {', '.join(sorted(unknown))}; there are {', '.join(known)}")
    options.views = [known[name] for name in chosen]
    return options


class Table(Ledger):
    """The set's views.csv, and the manifest.csv that follows from it."""

    def record(self, view, file, spp, noise_seed, seconds, noise=""):
        self.add(
            view=view.name,
            kind=view.kind,
            seed=view.seed,
            camera=view.camera,
            frame="{}x{}".format(*view.frame),
            filter=view.filter,
            file=file,
            spp=spp,
            noise_seed=noise_seed,
            seconds=f"{seconds:.1f}",
            noise=noise,
        )
        self._list_pairs()

    def sources(self, file):
        """What a reference is the mean of, empty where there is none."""
        return "" if self.missing(file) else self.rows()[file]["noise_seed"]

    def _list_pairs(self):
        listed, rows = set(self.rows()), []
        for view in VIEWS:
            pairs = [
                (
                    view.name if seed == 0 else f"{view.name}_n{seed}",
                    view.noisy(spp, seed),
                    view.reference,
                    spp,
                )
                for spp, seed in sorted(_LADDER, key=lambda entry: entry[::-1])
            ]
            pairs.append((view.adaptive, view.noisy(*_DEFAULTS), view.adaptive_reference, _DEFAULTS[0]))
            rows += [pair for pair in pairs if {pair[1], pair[2]} <= listed]
        self.write_manifest(rows)


class Studio:
    """One view's scene, ready to render any of its files."""

    def __init__(self, options, library, view, edits):
        self.view, self.folder = view, options.out
        stage, place = making.build(library, view.seed, view.kind, {})
        stage.rng.seed(
            f"camera {view.seed} {view.kind} {view.camera}"
        )  # a second look takes nothing from the first
        making.set_up(edits, stage, options.threads, size=_LARGE if view.crop else _SIZE)
        self.scene = stage.scene
        (region,) = making.look(edits, stage, place, 1, _SIZE if view.crop else None)
        rendering.set_region(edits, self.scene, region)
        edits.set(self.scene.cycles, "pixel_filter_type", "BOX" if view.box else "BLACKMAN_HARRIS")
        edits.set(self.scene.cycles, "filter_width", 1.5)
        self.layers = list(self.scene.view_layers)
        write_position(edits, self.layers)

    def noisy(self, spp, noise_seed):
        """Renders a noisy file with all passes; returns its processor seconds."""
        with Edits() as edits:
            rendering.enable_passes(edits, self.layers)
            store_position(edits, self.layers)
            seed = rendering.mixed_seed(self.view.seed, self.view.name, spp, noise_seed)
            rendering.set_sampling(
                edits,
                self.scene,
                spp,
                seed,
                rendering.DEFAULT_NOISE if spp == rendering.DEFAULT_SAMPLES else 0.0,
            )
            channels, seconds = self._render()
        exr.write_half(os.path.join(self.folder, self.view.noisy(spp, noise_seed)), channels, spp)
        return seconds

    def part(self, which):
        """Renders a part of the reference; returns its processor seconds."""
        with Edits() as edits:
            rendering.reference_passes(edits, self.scene, self.layers)
            seed = rendering.mixed_seed(self.view.seed, self.view.name, "reference", which)
            rendering.set_sampling(edits, self.scene, _PART_MOST, seed, _PART_NOISE, _PART_LEAST)
            channels, seconds = self._render()
        exr.write_float(os.path.join(self.folder, self.view.part(which)), channels)
        return seconds

    def _render(self):
        return rendering.render_channels(self.scene, os.path.join(self.folder, f"{self.view.name}.tmp"))


def join(table, view, parts):
    """Writes a view's references from the parts that are there, and from the render at Blender's defaults
    where it is: that one goes into the reference of the others alone."""
    read = lambda file: exr.read(os.path.join(table.folder, file))
    images, rows = [read(view.part(which)) for which in parts], table.rows()
    seconds = sum(float(rows[view.part(which)]["seconds"]) for which in parts)
    mean = {name: np.mean([image[name] for image in images], 0) for name in images[0]}
    color = [name for name in mean if name.endswith(("Combined.R", "Combined.G", "Combined.B"))]
    # The variance of the mean, from how its parts differ.
    variance = {name: np.var([image[name] for image in images], 0, ddof=1) / len(images) for name in color}
    defaults = view.noisy(*_DEFAULTS)
    store(table, view, view.adaptive_reference, parts, mean, variance, seconds)
    if table.missing(defaults):
        store(table, view, view.reference, parts, mean, variance, seconds)
        return
    share = len(parts) / (len(parts) + _DEFAULTS_WEIGHT)
    light = {name: plane.astype("f4") for name, plane in read(defaults).items()}
    # The defaults are stored as half: beyond its range they are cut, and count nothing.
    shares = {name: np.where(np.abs(light[name]) < exr.MOST_HALF, share, 1) for name in mean}
    both = {name: shares[name] * plane + (1 - shares[name]) * light[name] for name, plane in mean.items()}
    # The defaults' own variance: what they differ by from the mean of the parts, less what that varies by.
    beyond = {name: (mean[name] - light[name]) ** 2 - variance[name] for name in color}
    variance = {
        name: shares[name] ** 2 * variance[name] + (1 - shares[name]) ** 2 * beyond[name] for name in color
    }
    store(
        table, view, view.reference, parts + "+", both, variance, seconds + float(rows[defaults]["seconds"])
    )


def store(table, view, file, sources, image, variance, seconds):
    """Writes a reference; its noise is the RelMSE that its variance adds to any score."""
    exr.write_float(os.path.join(table.folder, file), image)
    noise = np.mean([variance[name] / (image[name] ** 2 + 0.001) for name in variance])
    spp = sum(_DEFAULTS[0] if source == "+" else _PART_MOST for source in sources)
    table.record(view, file, spp, sources, seconds, f"{noise:.3g}")


def render_view(options, library, table, view, frames, parts):
    """Renders what a view lacks of frames and of its reference's parts; returns the words of its line, None
    where nothing is missing."""
    if options.spp:
        frames, parts = [entry for entry in frames if entry[0] in options.spp], ""
    frames = [entry for entry in frames if table.missing(view.noisy(*entry))]
    lacking = [which for which in parts if table.missing(view.part(which))]
    start = time.process_time()
    if frames or lacking:
        with Edits() as edits:
            studio = Studio(options, library, view, edits)
            for entry in frames:
                table.record(view, view.noisy(*entry), *entry, studio.noisy(*entry))
            for which in lacking:
                table.record(view, view.part(which), _PART_MOST, which, studio.part(which))
    wanted = parts if table.missing(view.noisy(*_DEFAULTS)) else parts + "+"
    unjoined = parts and len(table.sources(view.reference)) < len(wanted)
    if unjoined:
        join(table, view, parts)
    if not (frames or lacking or unjoined):
        return None
    seconds = time.process_time() - start
    joined = table.sources(view.reference) or "nothing yet"
    return f"{len(frames)} frames, {len(lacking)} parts in {seconds:.0f} s of processors, reference of {joined}"


def write_credits(options, library):
    """Builds every view and writes credits.csv (asset,author,licence,views) from the assets' indices."""
    shown = {}
    for view in options.views:
        stage, _ = making.build(library, view.seed, view.kind, {})
        for credit in {*map(library.credit, stage.files())} - {None}:
            shown.setdefault(credit, []).append(view.name)
    with open(os.path.join(options.out, "credits.csv"), "w", encoding="utf-8", newline="") as file:
        rows = [(*credit, " ".join(names_)) for credit, names_ in sorted(shown.items())]
        csv.writer(file, lineterminator="\n").writerows([("asset", "author", "licence", "views"), *rows])
    print(f"{len(shown)} assets in {len(options.views)} views")


def main():
    """Entry point of the script."""
    options = parse(cl.script_arguments())
    options.out = os.path.abspath(options.out)
    if options.check:
        cl.finish(Table(options.out).check())
        return
    cl.quiet_stdout()
    logging.disable(logging.INFO)  # the glTF importer tells every step
    cl.make_folder(os.path.join(options.out, "parts"))
    cl.end_at_once(lambda: None)  # a frame is whole or not there: nothing to tidy
    library, table, failed = Library(options.assets), Table(options.out), 0
    if options.credits:
        write_credits(options, library)
        return
    dozen, others = options.views[:_DOZEN], options.views[_DOZEN:]
    steps = (
        (dozen, _FIRST, "ab"),
        (dozen, (_DEFAULTS,), "ab"),
        (others, _FIRST, "ab"),
        (options.views, _THEN, "ab"),
        (others, (_DEFAULTS,), "ab"),
        (options.views, (), "abcd"),
        (options.views, (), "abcdefgh"),
    )
    for views, frames, parts in steps:
        for view in views:
            try:
                said = render_view(options, library, table, view, frames, parts)
            except Exception as error:  # one bad view must not stop a night of rendering
                failed += 1
                said = f"failed, {cl.reason(error)}"
            if said:
                print(f"{view.name}: {said}")
    cl.finish(failed)


if __name__ == "__main__":
    main()
