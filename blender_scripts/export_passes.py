"""Renders what demc reads from a Blender scene: noisy frames with every pass, and references.

    python export_passes.py SCENE.blend --out DIR           with bpy from PyPI
    blender -b SCENE.blend -P export_passes.py -- --out DIR in Blender
    (run from Blender's text editor, it renders the open scene into `demc` beside the .blend)

Writes <scene>_<spp>spp.exr and <scene>_ref.exr, with the frame before the extension where --frames
is given. The scene is never saved, and an open scene is left as it was found.
"""

import argparse
import os
import sys
import time
import traceback

import bpy

sys.path.insert(0, os.path.dirname(os.path.abspath(bpy.path.abspath(__file__))))

from demc_blender import command_line as cl
from demc_blender import names, rendering
from demc_blender.edits import Edits
from demc_blender.position import store_position, write_position


def parse(arguments):
    """The command line. `scene` may be left out inside Blender: the open file is rendered."""
    inside = cl.inside_blender()
    parser = argparse.ArgumentParser(
        prog="export_passes.py",
        description="Render noisy frames with the passes demc needs, and clean references.",
        epilog="Half buffers: --half-buffers renders, beside each noisy frame, two independent "
        "images of half its samples, <scene>_<spp>spp_a.exr and <scene>_<spp>spp_b.exr (for "
        "_0004spp: 2 samples each), as two-buffer denoisers and noise estimates want them. "
        "A finished file is skipped unless --overwrite is given.",
    )
    parser.add_argument("scene", nargs="?" if inside else None, metavar="SCENE.blend",
                        help="the scene; inside Blender it may be left out for the open one")
    parser.add_argument("--out", metavar="DIR", required=not inside,
                        help="folder for the EXR files (inside Blender: `demc` beside the .blend)")
    parser.add_argument("--spp", type=cl.counts, default=[4], metavar="N[,N]",
                        help="samples per pixel of the noisy frames (default 4)")
    parser.add_argument("--ref-spp", type=int, default=1024, metavar="N",
                        help="samples of the reference, 0 for none (default 1024)")
    parser.add_argument("--ref-noise", type=float, default=0.0, metavar="T",
                        help="adaptive sampling of the reference down to this noise threshold, "
                        "for example 0.004; much faster, slightly biased (default: off)")
    parser.add_argument("--seed", type=int, default=1, help="seed of all renders (default 1)")
    parser.add_argument("--resolution", type=cl.size, metavar="WxH",
                        help="frame size in pixels (default: the scene's)")
    parser.add_argument("--frames", type=cl.frame_range, metavar="A-B",
                        help="frames to render, --frames=-5--1 where they are negative (default: the current one, named without a number)")
    parser.add_argument("--view-layer", metavar="NAME",
                        help="render this view layer alone (default: all that are on)")
    parser.add_argument("--region", type=cl.region, metavar="X,Y,W,H",
                        help="render this part alone, in pixels from the top left")
    parser.add_argument("--half-buffers", action="store_true", help="see below")
    parser.add_argument("--vector", action="store_true",
                        help="store motion vectors too (Cycles has none while motion blur is on)")
    parser.add_argument("--float", action="store_true", dest="full_float",
                        help="store every pass as 32-bit float (default: half, data passes float)")
    parser.add_argument("--name", help="scene name in the files (default: the .blend's)")
    parser.add_argument("--threads", type=cl.positive, metavar="N", help="CPU threads (default: all)")
    parser.add_argument("--overwrite", action="store_true", help="render finished files again")
    options = parser.parse_args(arguments)
    if options.ref_spp < 0:
        parser.error("--ref-spp must not be negative")
    return options


def open_scene(path):
    """Opens a .blend without its interface; raises RuntimeError in one line where it cannot."""
    if not os.path.isfile(path):
        raise RuntimeError(f"{path}: no such file")
    bpy.ops.wm.open_mainfile(filepath=os.path.abspath(path), load_ui=False)


def chosen_layers(edits, scene, name):
    """The view layers to render; a named one has the others switched off."""
    if name is None:
        layers = [layer for layer in scene.view_layers if layer.use]
        if not layers:
            raise RuntimeError(f"no view layer of {scene.name} is on; choose one with --view-layer")
        return layers
    if name not in scene.view_layers:
        known = ", ".join(layer.name for layer in scene.view_layers)
        raise RuntimeError(f"no view layer {name!r} in {scene.name}; it has {known}")
    for layer in scene.view_layers:
        edits.set(layer, "use", layer.name == name)
    return [scene.view_layers[name]]


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


def render_job(options, scene, layers, job):
    """Renders one image and takes its settings back."""
    with Edits() as edits:
        if job.is_reference:
            rendering.combined_only(edits, layers)
        else:
            store_position(edits, layers)
        threshold = options.ref_noise if job.is_reference else 0.0
        rendering.set_sampling(edits, scene, job.spp, job.seed, threshold)
        rendering.render_to(scene, job.path)


def render_frame(options, scene, layers, scene_name, frame, numbered):
    """Renders what is missing of a frame and prints its line. Returns whether all went well."""
    done, errors = [], []
    placed = scene.frame_current == frame
    for job in jobs_of_frame(options, scene_name, frame, numbered):
        if os.path.exists(job.path) and not options.overwrite:
            done.append(f"{job.label} is there")
            continue
        start = time.perf_counter()
        try:
            if not placed:
                scene.frame_set(frame)
                placed = True
            render_job(options, scene, layers, job)
            done.append(f"{job.label} {time.perf_counter() - start:.1f} s")
        except (RuntimeError, OSError) as error:
            errors.append(f"{job.label} failed: {cl.reason(error)}")
    print(f"{scene_name} frame {frame}: {', '.join(done + errors)}")
    return not errors


def export(options):
    """Renders everything asked for; returns the number of frames that failed."""
    if options.scene:
        open_scene(options.scene)
    scene = bpy.context.scene
    blend = bpy.data.filepath
    name = options.name or os.path.splitext(os.path.basename(blend))[0] or "untitled"
    options.out = os.path.abspath(options.out or os.path.join(os.path.dirname(blend), "demc"))
    os.makedirs(options.out, exist_ok=True)
    if scene.camera is None:
        raise RuntimeError(f"{name} has no camera")
    first, last = options.frames or (scene.frame_current, scene.frame_current)
    start, part = scene.frame_current, scene.frame_subframe
    with Edits() as edits:
        edits.on_undo(lambda: scene.frame_set(start, subframe=part))
        rendering.prepare_scene(edits, scene)
        rendering.set_output(edits, scene, options.full_float)
        if options.resolution:
            rendering.set_resolution(edits, scene, options.resolution)
        if options.region:
            rendering.set_region(edits, scene, options.region)
        if options.threads:
            edits.set(scene.render, "threads_mode", "FIXED")
            edits.set(scene.render, "threads", options.threads)
        layers = chosen_layers(edits, scene, options.view_layer)
        rendering.enable_passes(edits, layers, options.vector)
        if options.vector and scene.render.use_motion_blur:
            print(f"warning: {name} has motion blur on, so Cycles stores no motion vectors")
        refused = write_position(edits, layers)
        if refused:
            print(f"warning: no averaged position for {len(refused)} materials that cannot be "
                  f"edited (linked from a library?): {', '.join(refused[:4])}")
        numbered = options.frames is not None
        return sum(not render_frame(options, scene, layers, name, frame, numbered)
                   for frame in range(first, last + 1))


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
