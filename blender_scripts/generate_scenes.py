"""Renders training pairs from seeded random scenes: noisy frames with every pass, and references.

    python generate_scenes.py --out DIR --seeds 0:100                with bpy from PyPI
    python generate_scenes.py --out DIR --check                      compares the files with their hashes
    blender -b -P generate_scenes.py -- --out DIR --seeds 0:100      in Blender

Each seed is one scene: an interior, a street, a garden, things in a studio ... furnished from
--assets where it is given and from procedural shapes and materials otherwise. Crops of --size are
rendered out of larger frames, where there is something to see, so a pixel covers what it covers in
a real frame. The same seed and options give the same scene and the same pixels.

Writes s<seed>_<kind>_<spp>spp.exr with s<seed>_<kind>_ref.exr (all half float, one part; references
keep their guides, which are what a prefilter aims at), where several crops of a scene add _c0, _c1 ... to
the name. With --sequence N it writes N frames, s<seed>_<kind>_<spp>spp.0001.exr and on, in which camera and
things move, with vectors, and the reference of the middle one alone, or with --all-references of each.
manifest.csv (scene,noisy,reference,spp)
lists the further noisy seeds (..._n1.exr, as scene ..._n1) and their means (..._mean.exr) too; views.csv lists
every file with its seeds, processor seconds and SHA-256.
Finished scenes are skipped; scenes with nothing to see go to rejected.csv and are not tried again.
"""

import argparse
import contextlib
import csv
import logging
import os
import random
import re
import sys
import time
import traceback

import bpy
import numpy

sys.path.insert(0, os.path.dirname(os.path.abspath(bpy.path.abspath(__file__))))

from demc_blender import command_line as cl
from demc_blender import exr, names, rendering
from demc_blender.edits import Edits
from demc_blender.ledger import Ledger, append, whole_lines
from demc_blender.position import store_position, write_position
from demc_scenes import making, moving
from demc_scenes.assets import Library
from demc_scenes.blends import find_blends
from demc_scenes.kinds import KINDS

_LEAST_SAMPLES = 16  # of a pixel in a denoised reference, however even it looks
_LEAST_CLEAN = 512  # of a pixel in a clean one
_CLEAN_RATIO = 8  # frames of more than one in so many of its samples, a denoised reference is too coarse for
# Light that is stored divided by a colour, and that colour: as Blender 5 calls them, and as Blender 4 does.
_LIT = (
    (re.compile(r"(Diffuse|Glossy|Transmission) (?:Direct|Indirect)\.([RGB])$"), r"\1 Color.\2"),
    (re.compile(r"(Diff|Gloss|Trans)(?:Dir|Ind)\.([RGB])$"), r"\1Col.\2"),
)
_DROPPED = (".Depth.Z", "DEMC Position.A")  # passes a network has no use for


def parse(arguments):
    """The command line."""
    parser = argparse.ArgumentParser(
        prog="generate_scenes.py", description="Render training pairs from seeded random scenes.",
        epilog=f"Kinds: {', '.join(KINDS)}, and with --blend the names of its scenes.")
    parser.add_argument("--out", required=True, metavar="DIR", help="folder for the pairs")
    parser.add_argument("--seeds", type=cl.seed_range, metavar="A:B", help="scenes A to B-1")
    parser.add_argument(
        "--check", action="store_true", help="render nothing, compare files with their hashes"
    )
    parser.add_argument(
        "--development-seeds",
        action="store_true",
        help=f"allow the seeds {_span(making.DEVELOPMENT_SEEDS)}, of which development_set.py makes what "
        "trained models are judged on: never train on these pairs",
    )
    parser.add_argument("--assets", type=cl.folder, action="append", default=[], metavar="DIR",
                        help="models, textures, HDRIs and pictures to furnish with; may be repeated")
    parser.add_argument("--blend", type=cl.folder, metavar="DIR", help="also render random views of the .blend scenes below DIR")
    parser.add_argument("--blend-share", type=cl.share, default=0.3, metavar="F",
                        help="share of seeds that go to --blend scenes (default 0.3)")
    parser.add_argument("--kinds", metavar="a,b", help="kinds of scenes (default: all)")
    parser.add_argument("--size", type=cl.side_or_size, default=(128, 128), metavar="N[xM]",
                        help="crops of N by N pixels, or of N by M (default 128)")
    parser.add_argument("--crops", type=cl.positive, default=1, metavar="N", help="crops per scene (default 1)")
    parser.add_argument("--spp", type=cl.counts, default=[4], metavar="N[,N]", help="samples of the noisy crops (default 4)")
    parser.add_argument(
        "--draw-spp",
        type=cl.positive,
        metavar="N",
        help="only N of the --spp counts for each crop, spread over them (default: all)",
    )
    parser.add_argument(
        "--adaptive-share",
        type=cl.share,
        default=0.0,
        metavar="F",
        help=f"a share of the crops is also rendered at Blender's defaults: {rendering.DEFAULT_SAMPLES} "
        f"samples and a noise threshold of {rendering.DEFAULT_NOISE} (default 0)",
    )
    parser.add_argument("--also-spp", type=cl.counts, default=[], metavar="N[,N]",
                        help="a share of the crops is also rendered with one of these sample counts")
    parser.add_argument("--also-share", type=cl.share, default=0.25, metavar="F", help="that share (default 0.25)")
    parser.add_argument("--noisy-seeds", type=cl.positive, default=1, metavar="N",
                        help="noisy renders of each crop and sample count (default 1)")
    parser.add_argument(
        "--means",
        action="store_true",
        help="also the mean of a crop's noisy renders of one sample count, as a frame of so many times more "
        "samples that costs nothing",
    )
    parser.add_argument(
        "--filter-share",
        type=cl.share,
        default=0.0,
        metavar="F",
        help="share of crops with a pixel filter that is not Blender's default, half of them a box",
    )
    parser.add_argument(
        "--blue-share",
        type=cl.share,
        default=0.0,
        metavar="F",
        help="share of crops whose noise is blue, as that of files made in Blender 4.4 and later: one noise seed each, "
        "since mixtures of several would not be (default 0)",
    )
    parser.add_argument(
        "--plain-share",
        type=cl.share,
        default=0.0,
        metavar="F",
        help="share of scenes whose crops are drawn evenly, walls and sky too, and not by how much they show (default 0)",
    )
    parser.add_argument(
        "--light-passes",
        action="store_true",
        help="noisy crops hold diffuse light, emission and environment too, which kpcn reads",
    )
    parser.add_argument(
        "--sequence",
        type=cl.positive,
        default=1,
        metavar="N",
        help="N frames of each crop, an odd number, in which camera and things move, with motion vectors; the "
        "middle one has a reference and stands in the manifest",
    )
    parser.add_argument(
        "--all-references",
        action="store_true",
        help="every frame of a sequence has a reference and stands in the manifest, so that flicker can be measured",
    )
    parser.add_argument("--ref-spp", type=cl.positive, default=128, metavar="N", help="samples of the references (default 128)")
    parser.add_argument("--ref-noise", type=cl.share, default=0.01, metavar="T",
                        help="references stop early below this noise threshold, 0 for never (default 0.01)")
    parser.add_argument("--denoise-references", action="store_true",
                        help="clean the references' last noise with Blender's own denoiser, guides denoised first: "
                             "64 to 128 samples then serve as well as many more")
    parser.add_argument(
        "--clean-share",
        type=cl.share,
        default=0.0,
        metavar="F",
        help=f"share of scenes whose references have at least {_LEAST_CLEAN} samples everywhere and are not "
        f"denoised. Beside --denoise-references, only these get frames and means of more than an "
        f"{_CLEAN_RATIO}th of --ref-spp (default 0)",
    )
    parser.add_argument(
        "--clean-spp",
        type=cl.positive,
        default=2048,
        metavar="N",
        help="samples of such references, at most (default 2048)",
    )
    parser.add_argument(
        "--clean-noise",
        type=cl.share,
        default=0.005,
        metavar="T",
        help="and their noise threshold (default 0.005)",
    )
    parser.add_argument("--guides-only", action="store_true",
                        help="trace no light beyond the surface that guides are of, in two thirds of the time: pairs for a "
                             "prefilter (their Combined is of no use), whose references keep albedo and normal")
    parser.add_argument("--threads", type=cl.positive, metavar="N", help="CPU threads (default: all)")
    parser.add_argument("--stop-file", metavar="PATH", help="stop before the next scene once this file exists")
    options = parser.parse_args(arguments)
    if options.check:
        return options
    if options.seeds is None:
        parser.error("--seeds is missing: which scenes to make, for example 0:100")
    if not options.development_seeds and _overlap(options.seeds, making.DEVELOPMENT_SEEDS):
        parser.error(
            f"the seeds {_span(making.DEVELOPMENT_SEEDS)} are kept for judging what was trained: take others"
        )
    if options.clean_share and not options.clean_spp > _LEAST_CLEAN:
        parser.error(f"--clean-spp must be above {_LEAST_CLEAN}, which every pixel gets")
    if options.sequence % 2 == 0:
        parser.error("--sequence must be odd: the middle frame is the one with a reference")
    if options.all_references and options.sequence == 1:
        parser.error("--all-references goes with --sequence")
    if options.sequence > 1 and (options.noisy_seeds > 1 or options.also_spp or options.guides_only):
        parser.error("--sequence does not go with --noisy-seeds, --also-spp and --guides-only")
    if options.guides_only and options.denoise_references:
        parser.error("--guides-only keeps no light that --denoise-references could clean")
    try:
        options.blends = find_blends(options.blend, KINDS) if options.blend else {}
    except ValueError as error:
        parser.error(str(error))
    known = set(KINDS) | set(options.blends)
    options.kinds = options.kinds.split(",") if options.kinds else sorted(known)
    unknown = set(options.kinds) - known
    if unknown:
        parser.error(f"unknown kind {', '.join(sorted(unknown))}; there are {', '.join(sorted(known))}")
    return options


def kind_of(options, seed):
    """The kind of a seed's scene, by weight."""
    rng = random.Random(f"kind {seed}")
    made = [k for k in options.kinds if k in KINDS]
    blends = [k for k in options.kinds if k in options.blends]
    if blends and (not made or rng.random() < options.blend_share):
        return rng.choice(blends)
    return rng.choices(made, [KINDS[k][1] for k in made])[0]


def _span(seeds):
    return f"{seeds.start}:{seeds.stop}"


def _overlap(one, other):
    return max(one.start, other.start) < min(one.stop, other.stop)


def crop_names(options, scene_name):
    """Names of a scene's crops."""
    return [scene_name] if options.crops == 1 else [f"{scene_name}_c{i}" for i in range(options.crops)]


class Crop:
    """What is rendered of a crop, drawn from its name alone: sample counts, reference, pixel filter."""

    def __init__(self, options, scene_name, name, seed):
        self.name, self.seed = name, seed
        is_still = options.sequence == 1
        self.frames = [None] if is_still else list(range(1, options.sequence + 1))
        self.middle = None if is_still else moving.middle(options.sequence)
        self.aimed_at = self.frames if options.all_references else [self.middle]
        self.clean = random.Random(f"clean {scene_name}").random() < options.clean_share
        self.counts = self._counts(options)
        rng = random.Random(f"adaptive {name}")
        # Where the reference is denoised, a frame that is cleaner than it has nothing to aim at.
        self.adaptive = rng.random() < options.adaptive_share and (
            self.clean or not options.denoise_references
        )
        rng = random.Random(f"filter {name}")
        self.filter = None
        if rng.random() < options.filter_share:
            self.filter = rng.choice(
                (
                    ("BOX", 1.0),
                    ("BOX", 1.0),
                    ("BLACKMAN_HARRIS", round(rng.uniform(0.8, 2.5), 2)),
                    ("GAUSSIAN", 1.5),
                )
            )
        self.blue = (
            bpy.app.version >= (4, 3, 0) and random.Random(f"blue {name}").random() < options.blue_share
        )
        self.seeds = 1 if self.blue else options.noisy_seeds
        self.means = options.means and self.seeds > 1

    def _counts(self, options):
        counts = options.spp
        most = options.ref_spp // _CLEAN_RATIO // (options.noisy_seeds if options.means else 1)
        if options.clean_share and options.denoise_references and not self.clean:
            counts = [spp for spp in counts if spp <= most] or [min(counts)]
        rng = random.Random(f"counts {self.name}")
        if options.draw_spp and options.draw_spp < len(counts):
            cuts = [len(counts) * i // options.draw_spp for i in range(options.draw_spp + 1)]
            counts = [rng.choice(counts[a:b]) for a, b in zip(cuts, cuts[1:])]
        rng = random.Random(f"also {self.name}")
        if options.also_spp and rng.random() < options.also_share:
            spp = rng.choice(options.also_spp)
            return counts, [spp] if spp not in options.spp else []
        return counts, []

    def noisy(self):
        """(file, samples, noise seed, frame) of every noisy render; stills have no frame."""
        counts, also = self.counts
        for frame in self.frames:
            for spp in counts:
                for n in range(self.seeds):
                    yield names.noisy_name(self.name, spp, frame, seed=n), spp, n, frame
            for spp in also + [rendering.DEFAULT_SAMPLES] * self.adaptive:
                yield names.noisy_name(self.name, spp, frame), spp, 0, frame

    def mean_of(self, spp):
        """The name of the mean of the noisy renders of one sample count."""
        return names.noisy_name(self.name, spp * self.seeds).replace(".exr", "_mean.exr")

    def reference(self, frame):
        """The name of a frame's reference."""
        return names.reference_name(self.name, frame)

    def pairs(self):
        """(scene, file, reference, samples) for the manifest."""
        for file, spp, n, frame in self.noisy():
            if frame in self.aimed_at:
                yield self.name if n == 0 else f"{self.name}_n{n}", file, self.reference(frame), spp
        for spp in self.counts[0] if self.means else []:
            yield f"{self.name}_mean", self.mean_of(spp), self.reference(None), spp * self.seeds


class Records:
    """The folder's manifest.csv and rejected.csv, and the mark of a scene under way."""

    def __init__(self, out):
        self.out = out
        self.mark = os.path.join(out, ".under_way")
        self.done = {row[0] for row in self._rows("manifest.csv")}
        self.rejected = {row[0]: row[1] for row in self._rows("rejected.csv")}

    def _rows(self, name):
        rows = csv.reader(whole_lines(os.path.join(self.out, name)))
        return [row for row in rows if len(row) > 1][1:]

    def add_crop(self, crop):
        path = os.path.join(self.out, "manifest.csv")
        append(path, ("scene", "noisy", "reference", "spp"), crop.pairs())
        self.done.add(crop.name)

    def reject(self, scene_name, reason):
        append(os.path.join(self.out, "rejected.csv"), ("scene", "reason"), [(scene_name, reason)])
        self.rejected[scene_name] = reason

    def begin(self, scene_name):
        """Marks a scene as under way; a mark that is still there is of a try that `end` never came
        after. A scene that took Blender down twice is rejected: returns False for it."""
        tries = 0
        if os.path.exists(self.mark):
            with open(self.mark, encoding="utf-8") as file:
                name, _, count = file.read().rpartition(" ")  # a .blend's name may hold spaces
            tries = int(count or 0) if name == scene_name else 0
        if tries >= 2:
            self.reject(scene_name, "Blender ended on it twice without a word (a crash, or a kill)")
            return False
        with open(self.mark, "w", encoding="utf-8") as file:
            file.write(f"{scene_name} {tries + 1}")
        return True

    def end(self):
        """Takes the mark away: Blender still runs, whatever became of the scene."""
        with contextlib.suppress(FileNotFoundError):
            os.remove(self.mark)


def render_crop(options, ledger, scene, region, crop, facts):
    """Renders a crop: noisy images with all passes, their means, then the reference with its guides; where it
    is denoised, also the Noisy Image that it was denoised from. `facts` are what the ledger tells of it
    too."""
    layers = [layer for layer in scene.view_layers if layer.use][:1]
    facts = facts | {"view": crop.name, "frame": "{}x{}+{}+{}".format(*region[2:], *region[:2])}
    with Edits() as edits:
        rendering.set_region(edits, scene, region)
        for layer in scene.view_layers:
            edits.set(layer, "use", layer == layers[0])
        if options.guides_only:
            rendering.stop_at_guides(edits, scene)
        if crop.filter:
            edits.set(scene.cycles, "pixel_filter_type", crop.filter[0])
            edits.set(scene.cycles, "filter_width", crop.filter[1])
        facts["filter"] = (
            f"{scene.cycles.pixel_filter_type.lower().replace('_', '-')} {scene.cycles.filter_width:.2f}"
        )
        with Edits() as passes:
            rendering.combined_only(passes, layers)
            is_moving = crop.middle is not None
            rendering.enable_passes(passes, layers, vector=is_moving, light=options.light_passes)
            store_position(passes, layers)
            if crop.blue:
                passes.set(scene.cycles, "sampling_pattern", "AUTOMATIC")  # as new files have it
            for file, spp, n, frame in crop.noisy():
                noise = rendering.DEFAULT_NOISE if spp == rendering.DEFAULT_SAMPLES else 0.0
                words = (crop.seed, crop.name, spp, n)
                if frame is not None:
                    scene.frame_set(frame)
                    words += (frame,)
                rendering.set_sampling(passes, scene, spp, rendering.mixed_seed(*words), noise)
                seconds = render_compact(scene, os.path.join(options.out, file))
                pattern = "blue" if crop.blue else ""
                ledger.add(file=file, spp=spp, noise_seed=n, seconds=f"{seconds:.1f}", pattern=pattern, **facts)
        for spp in crop.counts[0] if crop.means else []:
            write_mean(
                options.out, crop.mean_of(spp), [file for file, count, *_ in crop.noisy() if count == spp]
            )
            ledger.add(
                file=crop.mean_of(spp), spp=spp * crop.seeds, noise_seed="mean", seconds="0.0", **facts
            )
        for frame in crop.aimed_at:
            if frame is not None:
                scene.frame_set(frame)
            render_reference(options, ledger, scene, layers, crop, frame, facts)
        if crop.middle is not None:
            scene.frame_set(crop.middle)


def render_reference(options, ledger, scene, layers, crop, frame, facts):
    """Renders the reference of a frame of a crop, the scene's current one."""
    with Edits() as passes:
        rendering.combined_only(passes, layers)
        rendering.store_guides(passes, layers)
        words = (crop.seed, crop.name, "reference") + ((frame,) if options.all_references else ())
        seed = rendering.mixed_seed(*words)
        spp = options.clean_spp if crop.clean else options.ref_spp
        if crop.clean:
            rendering.set_sampling(passes, scene, spp, seed, options.clean_noise, _LEAST_CLEAN)
        else:
            least = _LEAST_SAMPLES if options.denoise_references else 0
            rendering.set_sampling(passes, scene, spp, seed, options.ref_noise, least)
            if options.denoise_references:
                rendering.denoise(passes, scene, layers)
        seconds = render_compact(scene, os.path.join(options.out, crop.reference(frame)))
        kind = "clean" if crop.clean else "reference"
        ledger.add(
            file=crop.reference(frame), spp=spp, noise_seed=kind, seconds=f"{seconds:.1f}", **facts
        )


def render_compact(scene, path):
    """Renders, drops what no network reads, stores the rest as half in one part; returns processor
    seconds."""
    channels, seconds = rendering.render_channels(scene, f"{path}.render.tmp")
    exr.write_half(path, {name: plane for name, plane in channels.items() if not name.endswith(_DROPPED)})
    return seconds


def write_mean(folder, name, files):
    """Writes the mean of several renders, of the guides too. Light that Cycles stores divided by a colour is averaged as
    light."""
    frames = [exr.read(os.path.join(folder, file)) for file in files]

    def mean(of):
        return sum(of(frame) for frame in frames) / len(frames)

    means = {c: mean(lambda frame, c=c: frame[c].astype("f4")) for c in frames[0]}
    for c in frames[0]:
        colour = next((lit.sub(name, c) for lit, name in _LIT if lit.search(c)), None)
        if colour in means:
            lit = mean(lambda frame, c=c, colour=colour: frame[c].astype("f4") * frame[colour].astype("f4"))
            means[c] = lit / numpy.maximum(means[colour], 1e-6) * (means[colour] > 0)
    exr.write_half(os.path.join(folder, name), means)


def render_scene(options, library, records, ledger, seed, kind, scene_name):
    """Builds and renders one scene; returns the words of its line."""
    start, finished = time.perf_counter(), kind in options.blends
    stage, place_camera = making.build(library, seed, kind, options.blends)
    with Edits() as edits:
        making.set_up(edits, stage, options.threads, finished)
        try:
            plain = random.Random(f"plain {scene_name}").random() < options.plain_share
            regions = making.look(
                edits, stage, place_camera, options.crops, options.size, finished, options.sequence, plain
            )
        except making.Unseen as reason:
            records.reject(scene_name, str(reason))
            return f"rejected, {reason}"
        built = time.perf_counter() - start
        write_position(edits, list(stage.scene.view_layers))
        for i, (region, name) in enumerate(zip(regions, crop_names(options, scene_name))):
            if name in records.done:  # before the script was stopped
                continue
            crop = Crop(options, scene_name, name, seed)
            render_crop(options, ledger, stage.scene, region, crop, {"kind": kind, "seed": seed, "camera": i})
            records.add_crop(crop)
    objects = sum(o.type == "MESH" for o in stage.scene.objects)
    return f"{len(regions)} crops, {objects} meshes, built in {built:.1f} s, rendered in {time.perf_counter() - start - built:.1f} s"


def main():
    """Entry point of the script."""
    options = parse(cl.script_arguments())
    if options.check:
        cl.finish(Ledger(options.out).check())
        return
    cl.quiet_stdout()
    logging.disable(logging.INFO)  # the glTF importer tells every step
    cl.make_folder(options.out)
    options.out = os.path.abspath(options.out)
    library, records, ledger, failed = Library(options.assets), Records(options.out), Ledger(options.out), 0
    cl.end_at_once(records.end)
    for seed in options.seeds:
        if options.stop_file and os.path.exists(options.stop_file):
            print(f"stopped: {options.stop_file} exists")
            break
        kind = kind_of(options, seed)
        scene_name = f"s{seed:04d}_{kind}"
        if scene_name in records.rejected or all(c in records.done for c in crop_names(options, scene_name)):
            print(f"{scene_name}: is there" if scene_name not in records.rejected else f"{scene_name}: rejected before, {records.rejected[scene_name]}")
            continue
        if not records.begin(scene_name):
            print(f"{scene_name}: rejected, {records.rejected[scene_name]}")
            continue
        try:
            print(f"{scene_name}: {render_scene(options, library, records, ledger, seed, kind, scene_name)}")
        except Exception as error:  # one bad scene must not stop a night of rendering
            failed += 1
            if os.environ.get("DEMC_TRACEBACK"):
                traceback.print_exc()
            print(f"{scene_name}: failed, {cl.reason(error)}")
        finally:
            records.end()
    cl.finish(failed)


if __name__ == "__main__":
    main()
