"""Renders small scenes in which denoisers are known to fail, each beside a control without the trouble.

    python hard_scenes.py --list                                     the cases, and why each is hard
    python hard_scenes.py --out DIR                                  all of them, with bpy from PyPI
    python hard_scenes.py --out DIR --cases fog,hair --spp 4 --seeds 1
    python hard_scenes.py --out DIR --check                          compares the files with their hashes

A method that does well on <case>_control and badly on <case> fails at that case, whatever it does elsewhere.
Scenes are built from numbers alone and need no assets. They are for looking and for tests, too small and too
few to choose a model by.

Writes <scene>_<spp>spp.exr with all passes (half float) for every count, ..._n1.exr and on for further noise
seeds, and <scene>_ref.exr (32-bit float, with clean guides): the mean of two adaptive renders that stay in
parts/. manifest.csv (scene,noisy,reference,spp) lists the frames that have their reference, noise seeds as
further rows of a scene; views.csv lists every file with its processor seconds, the noise that is left in a
reference as RelMSE, and SHA-256. What is listed and there is not rendered again, unless the size or the
samples asked for are others.
"""

import argparse
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
from demc_scenes import hard

# A part of a reference: adaptive, with enough samples first that stopping early has no say in the mean.
_PARTS, _PART_NOISE, _PART_LEAST = "ab", 0.007, 64


class Pair:
    """A case or its control: its scene's name, its files, and the size of its frames."""

    def __init__(self, case, troubled, size):
        self.case, self.troubled = case, troubled
        self.name = case if troubled else f"{case}_control"
        self.reference = names.reference_name(self.name)
        self.size = (size[0], size[0] // 2) if case == "panorama" else size

    def noisy(self, spp, seed):
        """The file of a noisy frame."""
        return names.noisy_name(self.name, spp, seed=seed)

    def part(self, which):
        """The file of a part of the reference."""
        return f"parts/{self.name}_ref_{which}.exr"


def parse(arguments):
    """The command line."""
    parser = argparse.ArgumentParser(
        prog="hard_scenes.py", description="Render small scenes in which denoisers are known to fail."
    )
    parser.add_argument("--out", metavar="DIR", help="folder for the scenes")
    parser.add_argument(
        "--cases", type=cl.names, default=list(hard.CASES), metavar="a,b",
        help="these cases only (default: all)",
    )
    parser.add_argument(
        "--spp", type=cl.counts, default=[4, 16, 64], metavar="N[,N]", help="sample counts (default: 4,16,64)"
    )
    parser.add_argument(
        "--seeds", type=cl.positive, default=2, metavar="N", help="noise seeds of each count (default: 2)"
    )
    parser.add_argument(
        "--size", type=cl.size, default=(160, 96), metavar="WxH",
        help="pixels of a frame (default: 160x96); panoramas are half as high as wide",
    )
    parser.add_argument(
        "--ref-spp", type=cl.positive, default=512, metavar="N",
        help="samples a part of a reference has at most (default: 512)",
    )
    parser.add_argument("--threads", type=cl.positive, metavar="N", help="CPU threads (default: all)")
    parser.add_argument("--list", action="store_true", help="render nothing, print the cases")
    parser.add_argument(
        "--check", action="store_true", help="render nothing, compare files with their hashes"
    )
    options = parser.parse_args(arguments)
    unknown = [name for name in options.cases if name not in hard.CASES]
    if unknown:
        parser.error(f"unknown case {', '.join(unknown)}; there are {', '.join(hard.CASES)}")
    if not options.list and not options.out:
        parser.error("the folder is missing (--out)")
    return options


class Table(Ledger):
    """The folder's views.csv, and the manifest.csv that follows from it."""

    def lacks(self, pair, file, spp):
        """Whether a file is still to be made: not there, or of another size or sample count."""
        row = None if self.missing(file) else self.rows()[file]
        return not row or (row["frame"], row["spp"]) != (_frame(pair), str(spp))

    def record(self, pair, file, spp, noise_seed, seconds, noise=""):
        """Adds a file's row."""
        self.add(
            view=pair.name,
            kind=pair.case,
            frame=_frame(pair),
            file=file,
            spp=spp,
            noise_seed=noise_seed,
            seconds=f"{seconds:.1f}",
            noise=noise,
        )

    def list_pairs(self):
        """Lists every noisy frame whose scene has its reference."""
        exists = lambda row: os.path.exists(os.path.join(self.folder, row["file"]))
        there = list(filter(exists, self.rows().values()))
        references = {row["view"]: row for row in there if row["noise_seed"] == _PARTS}
        noisy = [row for row in there if row["noise_seed"].isdigit() and row["view"] in references]
        cases = list(hard.CASES)
        noisy.sort(
            key=lambda row: (cases.index(row["kind"]), row["view"], int(row["spp"]), int(row["noise_seed"]))
        )
        pairs = []
        for row in noisy:
            reference = references[row["view"]]
            if row["frame"] == reference["frame"]:
                pairs.append([row["view"], row["file"], reference["file"], row["spp"]])
        self.write_manifest(pairs)


def _frame(pair):
    return "{}x{}".format(*pair.size)


class Studio:
    """A pair's scene, ready to render any of its files."""

    def __init__(self, options, pair, edits):
        self.options, self.pair = options, pair
        self.scene = hard.build(pair.case, pair.troubled).scene
        rendering.prepare_scene(edits, self.scene)
        rendering.set_output(edits, self.scene)
        rendering.set_resolution(edits, self.scene, pair.size)
        if options.threads:
            edits.set(self.scene.render, "threads_mode", "FIXED")
            edits.set(self.scene.render, "threads", options.threads)
        self.layers = list(self.scene.view_layers)
        write_position(edits, self.layers)

    def noisy(self, spp, noise_seed):
        """Renders a noisy file with all passes; returns its processor seconds."""
        with Edits() as edits:
            rendering.enable_passes(edits, self.layers)
            store_position(edits, self.layers)
            # A case and its control share their seed: what differs between them is the trouble alone.
            seed = rendering.mixed_seed(self.pair.case, spp, noise_seed)
            rendering.set_sampling(edits, self.scene, spp, seed)
            channels, seconds = self._render()
        exr.write_half(os.path.join(self.options.out, self.pair.noisy(spp, noise_seed)), channels, spp)
        return seconds

    def part(self, which):
        """Renders a part of the reference; returns its processor seconds."""
        with Edits() as edits:
            rendering.reference_passes(edits, self.scene, self.layers)
            seed = rendering.mixed_seed(self.pair.case, "reference", which)
            most = self.options.ref_spp
            rendering.set_sampling(edits, self.scene, most, seed, _PART_NOISE, min(_PART_LEAST, most))
            channels, seconds = self._render()
        exr.write_float(os.path.join(self.options.out, self.pair.part(which)), channels)
        return seconds

    def _render(self):
        return rendering.render_channels(self.scene, os.path.join(self.options.out, f"{self.pair.name}.tmp"))


def join(table, pair, spp):
    """Writes a reference, the mean of its parts. Its noise is the RelMSE that its variance, which is known
    from how the parts differ, adds to any score."""
    images = [exr.read(os.path.join(table.folder, pair.part(which))) for which in _PARTS]
    mean = {name: np.mean([image[name] for image in images], 0) for name in images[0]}
    color = [name for name in mean if name.endswith(("Combined.R", "Combined.G", "Combined.B"))]
    variance = {name: np.var([image[name] for image in images], 0, ddof=1) / len(images) for name in color}
    noise = np.mean([variance[name] / (mean[name] ** 2 + 0.001) for name in color])
    exr.write_float(os.path.join(table.folder, pair.reference), mean)
    rows = table.rows()
    seconds = sum(float(rows[pair.part(which)]["seconds"]) for which in _PARTS)
    table.record(pair, pair.reference, spp * len(_PARTS), _PARTS, seconds, f"{noise:.3g}")
    return noise


def render_pair(options, table, pair):
    """Renders what a scene lacks; returns the words of its line, None where nothing is missing."""
    frames = [(spp, seed) for spp in options.spp for seed in range(options.seeds)]
    frames = [entry for entry in frames if table.lacks(pair, pair.noisy(*entry), entry[0])]
    lacking = [which for which in _PARTS if table.lacks(pair, pair.part(which), options.ref_spp)]
    start = time.process_time()
    if frames or lacking:
        with Edits() as edits:
            studio = Studio(options, pair, edits)
            for spp, seed in frames:
                table.record(pair, pair.noisy(spp, seed), spp, seed, studio.noisy(spp, seed))
            for which in lacking:
                table.record(pair, pair.part(which), options.ref_spp, which, studio.part(which))
    joined = ""
    if lacking or table.lacks(pair, pair.reference, options.ref_spp * len(_PARTS)):
        joined = f", noise {join(table, pair, options.ref_spp):.2g} left in the reference"
    table.list_pairs()
    if not (frames or joined):
        return None
    seconds = time.process_time() - start
    return f"{len(frames)} frames, {len(lacking)} parts in {seconds:.0f} s of processors{joined}"


def main():
    """Entry point of the script."""
    options = parse(cl.script_arguments())
    if options.list:
        for name in options.cases:
            print(f"{name:19} {hard.CASES[name]}")
        return
    options.out = os.path.abspath(options.out)
    if options.check:
        cl.finish(Table(options.out).check())
        return
    cl.quiet_stdout()
    cl.make_folder(os.path.join(options.out, "parts"))
    cl.end_at_once(lambda: None)  # a frame is whole or not there: nothing to tidy
    table, failed = Table(options.out), 0
    for case in options.cases:
        for troubled in (True, False):
            pair = Pair(case, troubled, options.size)
            try:
                said = render_pair(options, table, pair)
            except Exception as error:  # one bad scene must not stop the others
                failed += 1
                said = f"failed, {cl.reason(error)}"
            if said:
                print(f"{pair.name}: {said}")
    cl.finish(failed)


if __name__ == "__main__":
    main()
