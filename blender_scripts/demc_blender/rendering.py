"""One Cycles render into one multilayer EXR: passes, sampling, region, output, all undoable."""

import os
import tempfile
import time

import bpy

from . import command_line, exr

# The passes demc reads besides Combined and the position AOV; depth lets others reuse the files.
DATA_PASSES = (
    "use_pass_z",
    "use_pass_position",
    "use_pass_normal",
    "use_pass_diffuse_color",
    "use_pass_glossy_color",
    "use_pass_transmission_color",
)

# The light that KPCN's two streams read, and what neither of them filters.
LIGHT_PASSES = ("use_pass_diffuse_direct", "use_pass_diffuse_indirect", "use_pass_emit", "use_pass_environment")

# What Blender renders with as it comes: adaptive, this many samples at most.
DEFAULT_SAMPLES = 4096
DEFAULT_NOISE = 0.01


def prepare_scene(edits, scene, as_framed=False):
    """What holds for every render: Cycles, no denoising, no post-processing, nothing kept between
    renders (persistent data gave materials wrong textures on the second render of a process).
    `as_framed` keeps the scene's stereo views and render border."""
    if scene.render.engine != "CYCLES":
        print(f"warning: {scene.name} is set to {scene.render.engine}; rendering it with Cycles")
    render, cycles = scene.render, scene.cycles
    edits.set(render, "engine", "CYCLES")
    for name in ("use_persistent_data", "use_compositing", "use_sequencer", "use_single_layer",
                 "use_freestyle", "use_file_extension", "use_stamp"):
        edits.set(render, name, False)
    if not as_framed:
        for name in ("use_multiview", "use_border", "use_crop_to_border"):
            edits.set(render, name, False)
    edits.set(render, "use_overwrite", True)
    # The extension would denoise every file that is rendered here.
    if hasattr(scene, "demc"):
        edits.set(scene.demc, "after_render", False)
    for name in ("use_denoising", "use_animated_seed", "use_sample_subset"):
        edits.set(cycles, name, False)
    edits.set(cycles, "time_limit", 0.0)
    edits.set(cycles, "sample_offset", 0)
    edits.set(cycles, "use_layer_samples", "IGNORE")
    for layer in scene.view_layers:
        edits.set(layer.cycles, "use_denoising", False)


def enable_passes(edits, layers, vector=False, light=False):
    """Turns on what demc needs, and leaves on what the user has on. `light` adds the passes that `kpcn`
    reads besides."""
    names = ("use_pass_combined",) + DATA_PASSES
    names += (("use_pass_vector",) if vector else ()) + (LIGHT_PASSES if light else ())
    for layer in layers:
        for name in names:
            edits.set(layer, name, True)
        edits.set(layer.cycles, "denoising_store_passes", True)


def leave_out_vectors(edits, layers):
    """Cycles fills the Vector pass with zeros while motion blur is on: no motion is worse than none
    stored."""
    for layer in layers:
        edits.set(layer, "use_pass_vector", False)


def combined_only(edits, layers):
    """Turns every pass off but Combined (the user's own AOVs stay). The shadow catcher's stays as it is: it decides
    whether Combined's alpha holds the shadows that were caught."""
    for layer in layers:
        for owner in (layer, layer.cycles):
            for prop in owner.bl_rna.properties:
                if prop.identifier.startswith("use_pass_") and prop.identifier != "use_pass_shadow_catcher":
                    edits.set(owner, prop.identifier, prop.identifier == "use_pass_combined")
        edits.set(layer.cycles, "denoising_store_passes", False)


def store_guides(edits, layers):
    """Denoising Albedo, Normal and Depth beside Combined."""
    for layer in layers:
        edits.set(layer.cycles, "denoising_store_passes", True)


def stop_at_guides(edits, scene):
    """No light beyond the first surface that is not a mirror or clear glass, whose albedo and normal the
    denoising guides hold: those of nearly all pixels stay the same to the bit, in two thirds of the time."""
    edits.set(scene.cycles, "diffuse_bounces", 0)
    edits.set(scene.cycles, "volume_bounces", 0)


def denoise(edits, scene, layers):
    """Open Image Denoise at its best, inside Cycles: high quality, guides denoised first."""
    for name, value in (("use_denoising", True), ("denoiser", "OPENIMAGEDENOISE"),
                        ("denoising_input_passes", "RGB_ALBEDO_NORMAL"), ("denoising_prefilter", "ACCURATE"),
                        ("denoising_quality", "HIGH"), ("denoising_use_gpu", False)):
        edits.set(scene.cycles, name, value)
    for layer in layers:
        edits.set(layer.cycles, "use_denoising", True)


def set_output(edits, scene, full_float=False):
    """Multilayer EXR, ZIP. Half keeps files small: Cycles' data passes stay 32-bit float in it."""
    settings = scene.render.image_settings
    # Registered first and so undone last, the file format before the rest: the media type resets it, it resets the
    # colour space, and a depth is valid only for its own.
    linear = getattr(settings, "linear_colorspace_settings", None)
    if linear is not None and linear.name:
        edits.keep(linear, "name")
    if hasattr(settings, "view_settings"):  # of files that have their own colours, which Blender then sets anew
        edits.keep(settings.view_settings, "view_transform", "look", "exposure", "gamma")
        edits.keep(settings.display_settings, "display_device")
    edits.keep(settings, "file_format", "color_depth", "views_format")
    if hasattr(settings, "media_type"):  # Blender 5 wants it before the file format
        edits.set(settings, "media_type", "MULTI_LAYER_IMAGE")
    edits.set(settings, "file_format", "OPEN_EXR_MULTILAYER")
    edits.set(settings, "color_depth", "32" if full_float else "16")
    edits.set(settings, "exr_codec", "ZIP")
    edits.set(settings, "use_preview", False)
    # In a colour space of the file's own, Blender would take positions for colours and convert them.
    edits.set(settings, "color_management", "FOLLOW_SCENE")
    edits.set(settings, "views_format", "MULTIVIEW")  # both eyes in one file, where there are two
    render = scene.render
    if render.pixel_aspect_x != render.pixel_aspect_y:
        # Blender 5 fails to write its one part a pass where pixels are not square.
        edits.set(settings, "use_exr_interleave", True)


def set_resolution(edits, scene, resolution):
    """Width and height in pixels."""
    edits.set(scene.render, "resolution_x", resolution[0])
    edits.set(scene.render, "resolution_y", resolution[1])
    edits.set(scene.render, "resolution_percentage", 100)


def frame_size(scene):
    """Pixels of the whole frame, (width, height), as Blender rounds them."""
    render = scene.render
    return (render.resolution_x * render.resolution_percentage // 100,
            render.resolution_y * render.resolution_percentage // 100)


def set_region(edits, scene, region):
    """Renders X,Y,W,H alone, in pixels from the top left; raises ValueError outside the frame."""
    width, height = frame_size(scene)
    x, y, w, h = region
    if x + w > width or y + h > height:
        raise ValueError(f"the region {x},{y},{w},{h} leaves the frame of {width}x{height}")
    render = scene.render
    bottom = height - y - h
    # Blender truncates border times size; a quarter pixel keeps rounding on the right side.
    for name, pixels, size in (("min_x", x, width), ("max_x", x + w, width),
                               ("min_y", bottom, height), ("max_y", bottom + h, height)):
        edits.set(render, f"border_{name}", min((pixels + 0.25) / size, 1.0))
    edits.set(render, "use_border", True)
    edits.set(render, "use_crop_to_border", True)


def set_sampling(edits, scene, spp, seed, noise_threshold=0.0, least=0):
    """Exactly `spp` samples a pixel, or adaptive where a noise threshold is given: from `least` (0
    for Cycles' own choice) up to `spp`."""
    cycles = scene.cycles
    edits.set(cycles, "samples", spp)
    edits.set(cycles, "seed", seed)
    edits.set(cycles, "use_adaptive_sampling", noise_threshold > 0.0)
    if noise_threshold > 0.0:
        edits.set(cycles, "adaptive_threshold", noise_threshold)
        edits.set(cycles, "adaptive_min_samples", least)


def render_to(scene, path, layer=None, attributes=None):
    """Renders into `path`: to a temporary name first, so that a killed run leaves no half file.
    `attributes` are texts by name for the file's header.

    Raises RuntimeError where Blender fails or writes nothing."""
    folder = os.path.dirname(os.path.abspath(path))
    handle, temporary = tempfile.mkstemp(suffix=".tmp", prefix="demc_", dir=folder)
    os.close(handle)
    os.remove(temporary)
    old = scene.render.filepath
    # From 4.5 on, Blender looks for variables in braces, {blend_name} for one.
    has_variables = bpy.app.version >= (4, 5)
    scene.render.filepath = temporary.replace("{", "{{").replace("}", "}}") if has_variables else temporary
    command_line.forget_chatter()
    try:
        try:
            # Of a scene that is not the active one, Blender would render the active one's frame.
            with bpy.context.temp_override(scene=scene):
                bpy.ops.render.render(write_still=True, scene=scene.name, **({"layer": layer} if layer else {}))
        except RuntimeError as error:  # it tells where, and of the reason "see console"
            raise RuntimeError(f"{str(error).strip()}; {command_line.trouble_heard()}") from error
        if not os.path.exists(temporary) or not exr.is_whole(temporary):
            raise RuntimeError(f"Blender wrote no image; {command_line.trouble_heard()}")
        for name, text in (attributes or {}).items():
            exr.add_text_attribute(temporary, name, text)
        os.replace(temporary, path)
    finally:
        scene.render.filepath = old
        if os.path.exists(temporary):
            os.remove(temporary)


def render_channels(scene, partial):
    """Renders by way of the file `partial`, which is gone afterwards; returns channels and processor
    seconds."""
    start = time.process_time()
    render_to(scene, partial)
    seconds = time.process_time() - start
    channels = exr.read(partial)
    os.remove(partial)
    return channels, seconds


def reference_passes(edits, scene, layers):
    """Combined and the denoising guides alone, as 32-bit floats: what a part of a reference holds."""
    edits.set(scene.render.image_settings, "color_depth", "32")
    combined_only(edits, layers)
    store_guides(edits, layers)


def mixed_seed(*parts):
    """A Cycles seed from any numbers or words, the same on every machine (FNV-1a, 31 bits)."""
    value = 0xCBF29CE484222325
    for byte in "/".join(str(part) for part in parts).encode():
        value = ((value ^ byte) * 0x100000001B3) & 0xFFFFFFFFFFFFFFFF
    return (value ^ (value >> 32)) & 0x7FFFFFFF
