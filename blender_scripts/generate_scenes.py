"""Renders training pairs from seeded random scenes: noisy frames with every pass, and references.

    python generate_scenes.py --out DIR --seeds 0:100                with bpy from PyPI
    blender -b -P generate_scenes.py -- --out DIR --seeds 0:100      in Blender

Each seed is one scene: an interior, a street, a garden, things in a studio ... furnished from
--assets where it is given and from procedural shapes and materials otherwise. Crops of --size are
rendered out of larger frames, where there is something to see, so a pixel covers what it covers in
a real frame. The same seed and options give the same scene and the same pixels.

Writes s<seed>_<kind>_<spp>spp.exr with s<seed>_<kind>_ref.exr (all half float, one part), where
several crops of a scene add _c0, _c1 ... to the name, and manifest.csv (scene,noisy,reference,spp),
which lists the further noisy seeds (..._n1.exr, as scene ..._n1) too. Finished scenes are skipped; scenes with
nothing to see go to rejected.csv and are not tried again.
"""

import argparse
import contextlib
import csv
import logging
import os
import random
import sys
import time
import traceback

import bpy

sys.path.insert(0, os.path.dirname(os.path.abspath(bpy.path.abspath(__file__))))

from demc_blender import command_line as cl
from demc_blender import exr, names, rendering
from demc_blender.edits import Edits
from demc_blender.position import store_position, write_position
from demc_scenes import views
from demc_scenes.assets import Library
from demc_scenes.blends import find_blends, open_blend
from demc_scenes.kinds import KINDS
from demc_scenes.stage import Stage

_FRAME_SIZES = ((480, 270), (480, 270), (480, 270), (640, 360), (640, 360), (960, 540))
_LEAST_SAMPLES = 16  # of a pixel in a denoised reference, however even it looks
_DROPPED = (".Depth.Z", "DEMC Position.A")  # passes a network has no use for


def parse(arguments):
    """The command line."""
    parser = argparse.ArgumentParser(
        prog="generate_scenes.py", description="Render training pairs from seeded random scenes.",
        epilog=f"Kinds: {', '.join(KINDS)}, and with --blend the names of its scenes.")
    parser.add_argument("--out", required=True, metavar="DIR", help="folder for the pairs")
    parser.add_argument("--seeds", required=True, type=cl.seed_range, metavar="A:B", help="scenes A to B-1")
    parser.add_argument("--assets", action="append", default=[], metavar="DIR",
                        help="models, textures, HDRIs and pictures to furnish with; may be repeated")
    parser.add_argument("--blend", metavar="DIR", help="also render random views of the .blend scenes below DIR")
    parser.add_argument("--blend-share", type=float, default=0.3, metavar="F",
                        help="share of seeds that go to --blend scenes (default 0.3)")
    parser.add_argument("--kinds", metavar="a,b", help="kinds of scenes (default: all)")
    parser.add_argument("--size", type=cl.side_or_size, default=(128, 128), metavar="N[xM]",
                        help="crops of N by N pixels, or of N by M (default 128)")
    parser.add_argument("--crops", type=cl.positive, default=1, metavar="N", help="crops per scene (default 1)")
    parser.add_argument("--spp", type=cl.counts, default=[4], metavar="N[,N]", help="samples of the noisy crops (default 4)")
    parser.add_argument("--also-spp", type=cl.counts, default=[], metavar="N[,N]",
                        help="a share of the crops is also rendered with one of these sample counts")
    parser.add_argument("--also-share", type=float, default=0.25, metavar="F", help="that share (default 0.25)")
    parser.add_argument("--noisy-seeds", type=cl.positive, default=1, metavar="N",
                        help="noisy renders of each crop and sample count (default 1)")
    parser.add_argument("--ref-spp", type=cl.positive, default=128, metavar="N", help="samples of the references (default 128)")
    parser.add_argument("--ref-noise", type=float, default=0.01, metavar="T",
                        help="references stop early below this noise threshold, 0 for never (default 0.01)")
    parser.add_argument("--denoise-references", action="store_true",
                        help="clean the references' last noise with Blender's own denoiser, guides denoised first: "
                             "64 to 128 samples then serve as well as many more")
    parser.add_argument("--guides-only", action="store_true",
                        help="trace no light beyond the surface that guides are of, in two thirds of the time: pairs for a "
                             "prefilter (their Combined is of no use), whose references keep albedo and normal")
    parser.add_argument("--threads", type=cl.positive, metavar="N", help="CPU threads (default: all)")
    parser.add_argument("--stop-file", metavar="PATH", help="stop before the next scene once this file exists")
    options = parser.parse_args(arguments)
    for name, folders in (("assets", options.assets), ("blend", [options.blend] if options.blend else [])):
        for folder in folders:
            if not os.path.isdir(folder):
                parser.error(f"{folder}: no such folder (--{name})")
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


def crop_names(options, scene_name):
    """Names of a scene's crops."""
    return [scene_name] if options.crops == 1 else [f"{scene_name}_c{i}" for i in range(options.crops)]


def noisy_names(options, crop):
    """(file, spp, noise seed number) of every noisy render of a crop."""
    for spp in options.spp:
        for n in range(options.noisy_seeds):
            plain = names.noisy_name(crop, spp)
            yield (plain if n == 0 else plain.replace(".exr", f"_n{n}.exr")), spp, n
    rng = random.Random(f"also {crop}")
    if options.also_spp and rng.random() < options.also_share:
        spp = rng.choice(options.also_spp)
        if spp not in options.spp:
            yield names.noisy_name(crop, spp), spp, 0


class Records:
    """The folder's manifest.csv and rejected.csv, and the mark of a scene under way."""

    def __init__(self, out):
        self.out = out
        self.mark = os.path.join(out, ".under_way")
        self.done = {row[0] for row in self._rows("manifest.csv")}
        self.rejected = {row[0]: row[1] for row in self._rows("rejected.csv")}

    def _rows(self, name):
        path = os.path.join(self.out, name)
        if not os.path.exists(path):
            return []
        with open(path, encoding="utf-8", newline="") as file:
            return [row for row in csv.reader(file) if len(row) > 1][1:]

    def _append(self, name, header, rows):
        path = os.path.join(self.out, name)
        fresh = not os.path.exists(path)
        with open(path, "a", encoding="utf-8", newline="") as file:
            csv.writer(file, lineterminator="\n").writerows(([header] if fresh else []) + rows)

    def add_crop(self, options, crop):
        reference = names.reference_name(crop)
        rows = [[crop if n == 0 else f"{crop}_n{n}", file, reference, spp]
                for file, spp, n in noisy_names(options, crop)]
        self._append("manifest.csv", ["scene", "noisy", "reference", "spp"], rows)
        self.done.add(crop)

    def reject(self, scene_name, reason):
        self._append("rejected.csv", ["scene", "reason"], [[scene_name, reason]])
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
            self.reject(scene_name, "Blender crashed")
            return False
        with open(self.mark, "w", encoding="utf-8") as file:
            file.write(f"{scene_name} {tries + 1}")
        return True

    def end(self):
        """Takes the mark away: Blender still runs, whatever became of the scene."""
        with contextlib.suppress(FileNotFoundError):
            os.remove(self.mark)


def settings_of_scene(edits, scene, rng, options, is_blend):
    """Render settings that artists use; those of a finished .blend are left as they are."""
    rendering.prepare_scene(edits, scene)
    rendering.set_output(edits, scene)
    for name in ("use_stamp_date", "use_stamp_time", "use_stamp_render_time", "use_stamp_memory",
                 "use_stamp_hostname", "use_stamp_filename"):
        edits.set(scene.render, name, False)
    if options.threads:
        edits.set(scene.render, "threads_mode", "FIXED")
        edits.set(scene.render, "threads", options.threads)
    rendering.set_resolution(edits, scene, rng.choice(_FRAME_SIZES))
    if scene.world:  # the map that Cycles builds by itself takes seconds, for every single crop
        scene.world.cycles.sampling_method = "MANUAL"
        scene.world.cycles.sample_map_resolution = 512
    if is_blend:
        return
    cycles = scene.cycles
    cycles.device = "CPU"
    cycles.max_bounces, cycles.diffuse_bounces = rng.choice((6, 8)), rng.choice((2, 3, 4))
    cycles.glossy_bounces, cycles.transmission_bounces, cycles.transparent_max_bounces = 4, 8, 8
    cycles.sample_clamp_indirect = rng.choice((0.0, 0.0, 10.0, 10.0))
    cycles.sample_clamp_direct = 0.0
    cycles.blur_glossy = rng.choice((0.0, 1.0))
    cycles.caustics_reflective = cycles.caustics_refractive = rng.random() < 0.85
    cycles.use_light_tree = rng.random() < 0.7
    scene.frame_set(1)


def build(options, library, seed, kind):
    """Builds a scene; returns its stage and the function that places a camera."""
    rng = random.Random(f"scene {seed} {kind}")
    bpy.ops.wm.read_factory_settings(use_empty=True)
    stage = Stage(rng, library)
    if kind in options.blends:
        return stage, open_blend(stage, options.blends[kind])
    stage.scene.render.engine = "CYCLES"
    return stage, KINDS[kind][0](stage)


def render_crop(options, scene, region, crop, seed, partial):
    """Renders a crop: noisy images with all passes, then the reference: Combined, where it is denoised also
    what it was denoised from (Noisy Image and the guides), and the guides where they are all that is wanted."""
    layers = [layer for layer in scene.view_layers if layer.use][:1]
    with Edits() as edits:
        rendering.set_region(edits, scene, region)
        for layer in scene.view_layers:
            edits.set(layer, "use", layer == layers[0])
        if options.guides_only:
            rendering.stop_at_guides(edits, scene)
        with Edits() as passes:
            rendering.combined_only(passes, layers)
            rendering.enable_passes(passes, layers)
            store_position(passes, layers)
            for file, spp, n in noisy_names(options, crop):
                rendering.set_sampling(passes, scene, spp, rendering.mixed_seed(seed, crop, spp, n))
                render_compact(scene, os.path.join(options.out, file), partial)
        with Edits() as passes:
            rendering.combined_only(passes, layers)
            rendering.set_sampling(passes, scene, options.ref_spp, rendering.mixed_seed(seed, crop, "reference"),
                                   options.ref_noise, _LEAST_SAMPLES if options.denoise_references else 0)
            if options.denoise_references:
                rendering.denoise(passes, scene, layers)
            if options.denoise_references or options.guides_only:
                for layer in layers:
                    passes.set(layer.cycles, "denoising_store_passes", True)
            render_compact(scene, os.path.join(options.out, names.reference_name(crop)), partial)


def render_compact(scene, path, partial):
    """Renders, drops what no network reads, and stores the rest as half in one part."""
    rendering.render_to(scene, partial)
    channels = {name: plane for name, plane in exr.read(partial).items() if not name.endswith(_DROPPED)}
    exr.write_half(path, channels)
    os.remove(partial)


def render_scene(options, library, records, seed, kind, scene_name):
    """Builds and renders one scene; returns the words of its line."""
    start = time.perf_counter()
    stage, place_camera = build(options, library, seed, kind)
    with Edits() as edits:
        settings_of_scene(edits, stage.scene, stage.rng, options, kind in options.blends)
        reason = "no place for a camera"
        for _ in range(3):
            camera = place_camera()
            if camera is None:
                continue
            if kind not in options.blends:
                views.lens_effects(stage, camera)
            guides = views.probe(stage.scene)
            reason = views.refusal(guides)
            regions = [] if reason else views.crops(stage.rng, stage.scene, guides, options.crops, options.size)
            if len(regions) == options.crops:
                break
            reason = reason or "featureless"
        else:  # no camera of three sees enough
            records.reject(scene_name, reason)
            return f"rejected, {reason}"
        if kind not in options.blends:
            views.expose(stage.rng, stage.scene, guides[0])
        built = time.perf_counter() - start
        write_position(edits, list(stage.scene.view_layers))
        for region, crop in zip(regions, crop_names(options, scene_name)):
            if crop in records.done:  # before the script was stopped
                continue
            render_crop(options, stage.scene, region, crop, seed, os.path.join(options.out, f"{scene_name}.tmp"))
            records.add_crop(options, crop)
    objects = sum(o.type == "MESH" for o in stage.scene.objects)
    return f"{len(regions)} crops, {objects} meshes, built in {built:.1f} s, rendered in {time.perf_counter() - start - built:.1f} s"


def main():
    """Entry point of the script."""
    options = parse(cl.script_arguments())
    cl.quiet_stdout()
    logging.disable(logging.INFO)  # the glTF importer tells every step
    cl.make_folder(options.out)
    options.out = os.path.abspath(options.out)
    library, records, failed = Library(options.assets), Records(options.out), 0
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
            print(f"{scene_name}: rejected, Blender crashed on it twice")
            continue
        try:
            print(f"{scene_name}: {render_scene(options, library, records, seed, kind, scene_name)}")
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
