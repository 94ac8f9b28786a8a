"""Renders what demc reads from a Blender scene: noisy frames with every pass, and references.

    python export_passes.py SCENE.blend --out DIR           with bpy from PyPI
    blender -b SCENE.blend -P export_passes.py -- --out DIR in Blender
    (opened and run in Blender's text editor, it renders the open scene into `demc` beside the .blend)

Writes <scene>_<spp>spp.exr and <scene>_ref.exr, with the frame before the extension where --frames
is given. Each file's header tells what it was made with, so that a rerun makes what is missing and
names what was made otherwise. The scene is never saved, and an open scene is left as it was found.
"""

import argparse
import hashlib
import json
import os
import sys
import time
import traceback

import bpy

_here = os.path.dirname(os.path.abspath(bpy.path.abspath(__file__)))
if not os.path.isdir(_here):  # Blender's text editor calls the script a file below the .blend
    _here = os.path.dirname(bpy.path.abspath(bpy.data.texts[os.path.basename(__file__)].filepath))
sys.path.insert(0, _here)

from demc_blender import command_line as cl
from demc_blender import exr, names, picking, rendering
from demc_blender.edits import Edits
from demc_blender.position import store_position, write_position

_STAMP = "demcExport"  # header attribute: what a file was made with
_STATE = "blend"  # of that, which state of the .blend: a change of it may be none of the picture


def parse(arguments):
    """The command line. `scene` may be left out inside Blender: the open file is rendered."""
    inside = cl.inside_blender()
    parser = argparse.ArgumentParser(
        prog="export_passes.py",
        description="Render noisy frames with the passes demc needs, and clean references.",
        epilog="Half buffers: --half-buffers renders, beside each noisy frame, two independent "
        "images of half its samples, <scene>_<spp>spp_a.exr and <scene>_<spp>spp_b.exr (for "
        "_0004spp: 2 samples each), as two-buffer denoisers and noise estimates want them. "
        "A finished file is skipped, and one that was made with other settings is named as failed, "
        "unless --overwrite is given; a damaged one is made again.",
    )
    parser.add_argument("scene", nargs="?" if inside else None, metavar="SCENE.blend",
                        help="the scene; inside Blender it may be left out for the open one")
    parser.add_argument("--out", metavar="DIR", required=not inside,
                        help="folder for the EXR files (inside Blender: `demc` beside the .blend)")
    parser.add_argument("--spp", type=cl.counts, default=[4], metavar="N[,N]",
                        help="samples per pixel of the noisy frames (default 4)")
    parser.add_argument("--ref-spp", type=int, default=1024, metavar="N",
                        help="samples of the reference, 0 for none (default 1024)")
    parser.add_argument("--ref-noise", type=cl.share, default=0.0, metavar="T",
                        help="adaptive sampling of the reference down to this noise threshold, "
                        "for example 0.004; much faster, slightly biased (default: off)")
    parser.add_argument("--seed", type=int, default=1, help="seed of all renders (default 1)")
    parser.add_argument("--resolution", type=cl.size, metavar="WxH",
                        help="frame size in pixels (default: the scene's)")
    parser.add_argument("--frames", type=cl.frame_spans, default=[], metavar="A-B[:S],...",
                        help="frames to render: 7, 1-9, 1-9:4, 1,3,7-9, or scene for the scene's own range; A-B "
                        "without a step keeps to the scene's. --frames=-5--1 where they are negative (default: "
                        "the current one, named without a number)")
    parser.add_argument("--scene", metavar="NAME", dest="scene_name",
                        help="the scene to render, where the file has several (default: the active one)")
    parser.add_argument("--views", type=cl.names, metavar="NAME[,NAME]",
                        help="stereo views to render into each file (default: those that the scene renders)")
    parser.add_argument("--view-layer", metavar="NAME",
                        help="render this view layer alone (default: all that are on)")
    parser.add_argument("--region", type=cl.region, metavar="X,Y,W,H",
                        help="render this part alone, in pixels from the top left (default: the scene's render "
                        "border where it is on)")
    parser.add_argument("--half-buffers", action="store_true", help="see below")
    parser.add_argument("--vector", action=argparse.BooleanOptionalAction,
                        help="store motion vectors, which denoising over time wants (default: where --frames is "
                        "given). Cycles has none while motion blur is on")
    parser.add_argument("--no-motion-blur", action="store_true", help="render without motion blur")
    parser.add_argument("--ref-guides", action="store_true",
                        help="references keep albedo and normal (default: Combined alone)")
    parser.add_argument("--float", action="store_true", dest="full_float",
                        help="store every pass as 32-bit float (default: half, data passes float)")
    parser.add_argument("--name", type=cl.file_stem, help="scene name in the files (default: the .blend's)")
    parser.add_argument("--scripts", action="store_true",
                        help="let the scripts and scripted drivers of SCENE.blend run (default: as Blender does)")
    parser.add_argument("--threads", type=cl.positive, metavar="N", help="CPU threads (default: all)")
    parser.add_argument("--overwrite", action="store_true", help="render finished files again")
    options = parser.parse_args(arguments)
    if options.ref_spp < 0:
        parser.error("--ref-spp must not be negative")
    return options


class Job:
    """One image of one frame: its file, samples, seed and whether it is the reference."""

    def __init__(self, path, label, spp, seed, is_reference=False):
        self.path, self.label, self.spp, self.seed = path, label, spp, seed
        self.is_reference = is_reference


def jobs_of_frame(options, scene_name, frame, numbered):
    """The images to render for a frame. Every one has its own seed: noise must be independent
    between noisy frame and reference, between half buffers, and from frame to frame."""
    number = frame if numbered else None

    def job(file_name, label, spp, role, is_reference=False):
        seed = rendering.mixed_seed(options.seed, frame, role)
        return Job(os.path.join(options.out, file_name), label, spp, seed, is_reference)

    for spp in options.spp:
        yield job(names.noisy_name(scene_name, spp, number), f"{spp} spp", spp, f"noisy {spp}")
        if options.half_buffers:
            for half in "ab":
                yield job(names.noisy_name(scene_name, spp, number, half), f"{spp} spp {half}",
                          (spp + 1) // 2, f"half {half} {spp}")
    if options.ref_spp:
        yield job(names.reference_name(scene_name, number), "reference", options.ref_spp,
                  "reference", True)


def common_settings(options, scene, layers, views, vector, state):
    """What every file of a run is made with, by the names that a user knows it by."""
    render = scene.render
    border = [round(getattr(render, f"border_{side}"), 6) for side in ("min_x", "max_x", "min_y", "max_y")]
    return {
        "scene": scene.name,
        "view layers": [layer.name for layer in layers],
        "views": views,
        "resolution": "{}x{}".format(*rendering.frame_size(scene)),
        "pixel aspect": round(render.pixel_aspect_x / render.pixel_aspect_y, 6),
        "region": border + [render.use_crop_to_border] if render.use_border else None,
        "motion blur": render.use_motion_blur,
        "vector": vector,
        "float": options.full_float,
        "seed": options.seed,
        _STATE: state,
    }


def settings_of(options, common, job):
    """What one file is made with."""
    own = {"samples": job.spp}
    if job.is_reference:
        own |= {"noise threshold": options.ref_noise, "guides": options.ref_guides, "vector": False}
    return common | own


def state_of(blend):
    """What tells a saved scene from another, or from itself after a change of its file or of a library's; none for a scene
    without a file."""
    if not os.path.isfile(blend):
        return None
    with open(blend, "rb") as file:
        state = hashlib.file_digest(file, "sha256")
    libraries = {os.path.realpath(bpy.path.abspath(library.filepath)) for library in bpy.data.libraries}
    for path in sorted(path for path in libraries if os.path.isfile(path)):
        with open(path, "rb") as file:
            state.update(hashlib.file_digest(file, "sha256").digest())
    # What is not saved cannot be told.
    state.update(b"changed" if bpy.data.is_dirty else b"")
    return state.hexdigest()


def settings_in(path):
    """What a finished file was made with; empty where it tells nothing: it was made by an older script."""
    return json.loads(exr.text_attribute(path, _STAMP) or "{}")


def difference(made, settings):
    """How the settings that a file was made with differ from those wanted, in words; empty where they do not, or
    where nothing is told of them."""
    if not made:
        return ""
    changed = [name for name in settings if name != _STATE and made.get(name) != settings[name]]
    return ", ".join(f"{name} {made.get(name)} instead of {settings[name]}" for name in changed)


def render_job(options, scene, layers, job, settings):
    """Renders one image and takes its settings back."""
    with Edits() as edits:
        if job.is_reference:
            rendering.combined_only(edits, layers)
            if options.ref_guides:
                rendering.store_guides(edits, layers)
        else:
            store_position(edits, layers)
        threshold = options.ref_noise if job.is_reference else 0.0
        rendering.set_sampling(edits, scene, job.spp, job.seed, threshold)
        rendering.render_to(scene, job.path, attributes={_STAMP: json.dumps(settings)})


class Export:
    """A scene that is set up, and what every file of it is made with."""

    def __init__(self, options, scene, name, layers, common):
        self.options, self.scene, self.name, self.layers = options, scene, name, layers
        self.common = common
        self.of_other_state = 0

    def frame(self, frame, numbered):
        """Renders what is missing of a frame and prints its line. Returns whether all went well."""
        done, errors = [], []
        # Frames that are numbered are whole; a scene may have been saved between two.
        self.placed = self.scene.frame_current == frame and not (numbered and self.scene.frame_subframe)
        for job in jobs_of_frame(self.options, self.name, frame, numbered):
            try:
                done.append(f"{job.label} {self._image(job, frame)}")
            except (RuntimeError, OSError, ValueError) as error:
                errors.append(f"{job.label} failed: {cl.reason(error)}")
        print(f"{self.name} frame {frame}: {', '.join(done + errors)}")
        return not errors

    def _image(self, job, frame):
        """Renders an image where it is missing; returns what its line says of it."""
        settings, damaged = settings_of(self.options, self.common, job), False
        if os.path.exists(job.path) and not self.options.overwrite:
            damaged = not exr.is_whole(job.path)
            made = {} if damaged else settings_in(job.path)
            other = difference(made, settings)
            if other:
                raise RuntimeError(f"{job.path} was made with {other}; --overwrite renders it again, or choose "
                                   "another --out or --name")
            if not damaged:
                states = {made.get(_STATE), settings[_STATE]}
                self.of_other_state += None not in states and len(states) > 1
                return "is there"
        start = time.perf_counter()
        if not self.placed:
            self.scene.frame_set(frame)
            self.placed = True
        render_job(self.options, self.scene, self.layers, job, settings)
        return f"{time.perf_counter() - start:.1f} s" + (" (was damaged)" if damaged else "")


def export(options):
    """Renders everything asked for; returns the number of frames that failed."""
    if options.scene:
        picking.open_scene(options.scene, options.scripts)
    picking.warn_of_scripts()
    blend = bpy.data.filepath
    name = options.name or os.path.splitext(os.path.basename(blend))[0] or "untitled"
    scene = picking.chosen_scene(options.scene_name, os.path.basename(blend) or name)
    # As Blender has it, // is the folder of the .blend.
    options.out = os.path.abspath(bpy.path.abspath(options.out or os.path.join(os.path.dirname(blend), "demc")))
    cl.make_folder(options.out)
    if not picking.has_camera(scene):
        raise RuntimeError(f"{name} has no camera in the scene {scene.name}: add one and make it the scene's, or choose "
                           "another with --scene")
    picking.warn_of_missing_files()
    numbered = options.frames != []
    frames = picking.chosen_frames(scene, options.frames) if numbered else [scene.frame_current]
    if numbered:
        picking.warn_of_simulations(scene)
    start, part, camera = scene.frame_current, scene.frame_subframe, scene.camera
    with Edits() as edits:
        # Markers on the timeline switch cameras.
        edits.on_undo(lambda: setattr(scene, "camera", camera))
        edits.on_undo(lambda: scene.frame_set(start, subframe=part))
        rendering.prepare_scene(edits, scene, as_framed=True)
        rendering.set_output(edits, scene, options.full_float)
        if options.resolution:
            rendering.set_resolution(edits, scene, options.resolution)
        if options.region:
            rendering.set_region(edits, scene, options.region)
        elif scene.render.use_border:
            size = "{},{}".format(*rendering.frame_size(scene))
            print(f"note: {scene.name} has a render border: only that part is rendered (--region 0,0,{size} for all)")
        if options.threads:
            edits.set(scene.render, "threads_mode", "FIXED")
            edits.set(scene.render, "threads", options.threads)
        if options.no_motion_blur:
            edits.set(scene.render, "use_motion_blur", False)
        views = picking.choose_views(edits, scene, options.views)
        layers = picking.chosen_layers(edits, scene, options.view_layer)
        vector = choose_vector(edits, options, scene, layers, numbered)
        refused = write_position(edits, layers)
        if refused:
            print(f"warning: no averaged position for {len(refused)} materials that cannot be "
                  f"edited (linked from a library?): {', '.join(refused[:4])}")
        common = common_settings(options, scene, layers, views, vector, state_of(blend))
        run = Export(options, scene, name, layers, common)
        failed = sum(not run.frame(frame, numbered) for frame in frames)
        if run.of_other_state:
            print(f"warning: {run.of_other_state} files that are there were made of another state of {os.path.basename(blend)}; "
                  "if the picture has changed, --overwrite renders them again")
        return failed


def choose_vector(edits, options, scene, layers, numbered):
    """Turns on the passes; returns whether motion vectors are among them."""
    wanted = numbered if options.vector is None else options.vector
    rendering.enable_passes(edits, layers, wanted)
    if not scene.render.use_motion_blur:
        return any(layer.use_pass_vector for layer in layers)
    if options.vector:
        print(f"warning: {scene.name} has motion blur on, with which Cycles stores no motion vectors: Vector is "
              "left out; --no-motion-blur renders it")
    rendering.leave_out_vectors(edits, layers)
    return False


def main():
    """Entry point of the script."""
    options = parse(cl.script_arguments())
    cl.quiet_stdout()
    cl.end_at_once(lambda: None)  # a render goes to a temporary name first
    try:
        failed = export(options)
    except (RuntimeError, ValueError, OSError) as error:
        if os.environ.get("DEMC_TRACEBACK"):
            traceback.print_exc()
        print(f"error: {cl.reason(error)}", file=sys.stderr)
        failed = 1
    cl.finish(failed)


if __name__ == "__main__":
    main()
