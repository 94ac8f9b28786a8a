"""What demc needs of a scene: which of it is missing, in words, and turning it on.

Only properties of scenes and view layers are set, so Blender's own undo takes all of it back.
"""

from collections import namedtuple

# Compressions of OpenEXR that lose nothing; the others blur the passes that guide demc.
_LOSSLESS = ("NONE", "ZIP", "ZIPS", "RLE", "PIZ")

# text: what is wrong and where it is set. prepared: whether Prepare Passes can set it.
Lack = namedtuple("Lack", "text prepared")


def rendered_layers(scene):
    """The view layers that a render makes."""
    return [layer for layer in scene.view_layers if layer.use]


def is_multilayer(scene):
    """Whether frames are written with all their passes."""
    return scene.render.image_settings.file_format == "OPEN_EXR_MULTILAYER"


def missing(scene, frames=False, still=False):
    """What a render of the scene would lack for demc, most important first. `frames` asks for what frames in
    files need as well, `still` for what a render in memory needs alone."""
    is_sequence = scene.demc.use_temporal and not still
    lacks = _of_scene(scene)
    if hasattr(scene, "cycles"):
        for layer in _read_layers(scene):
            lacks += _of_layer(layer, is_sequence)
    if is_sequence:
        lacks += _of_sequence(scene)
    if frames or is_sequence:
        lacks += _of_output(scene)
    return lacks


def _read_layers(scene):
    """The view layers that demc needs passes of: the one that was chosen, or all."""
    rendered = rendered_layers(scene)
    return [layer for layer in rendered if layer.name == scene.demc.view_layer] or rendered


def prepare(scene):
    """Sets what is missing. Returns what was done, in words."""
    done = []
    if not hasattr(scene, "cycles"):
        return done

    def put(owner, name, value, words):
        if getattr(owner, name) != value:
            setattr(owner, name, value)
            if words not in done:
                done.append(words)

    put(scene.render, "engine", "CYCLES", "Cycles renders")
    put(scene.cycles, "use_denoising", False, "Blender's own denoising is off")
    for layer in rendered_layers(scene):
        put(layer, "use_pass_combined", True, "Combined is on")
        put(layer.cycles, "denoising_store_passes", True, "Denoising Data is on")
        if scene.demc.use_temporal:
            put(layer, "use_pass_vector", True, "Vector is on")
    if scene.demc.use_temporal:
        put(scene.cycles, "use_animated_seed", True, "the seed changes from frame to frame")
    _prepare_output(scene, put)
    return done


def _prepare_output(scene, put):
    settings = scene.render.image_settings
    if not is_multilayer(scene):
        # Blender 5 offers the format for this media type alone, and chooses it then.
        words = "frames are saved as OpenEXR MultiLayer"
        if hasattr(settings, "media_type"):
            put(settings, "media_type", "MULTI_LAYER_IMAGE", words)
        else:
            put(settings, "file_format", "OPEN_EXR_MULTILAYER", words)
    if settings.exr_codec not in _LOSSLESS:
        put(settings, "exr_codec", "ZIP", "files are compressed without loss (ZIP)")
    if _keeps_no_views(scene):
        put(settings, "views_format", "MULTIVIEW", "both eyes go into one file")
    if _is_unnamed(scene):
        put(scene.render, "use_file_extension", True, "files are named .exr")
    if _wants_interleave(scene):
        put(settings, "use_exr_interleave", True, "passes are interleaved in one part, as pixels are not square")


def _wants_interleave(scene):
    """Blender 5 writes no frames of pixels that are not square but with all passes in one part."""
    render = scene.render
    is_square = render.pixel_aspect_x == render.pixel_aspect_y
    return not is_square and getattr(render.image_settings, "use_exr_interleave", None) is False


def _keeps_no_views(scene):
    """Whether two eyes go into one picture, which Blender writes to no file with passes."""
    render = scene.render
    return render.use_multiview and render.image_settings.views_format not in ("INDIVIDUAL", "MULTIVIEW")


def _is_unnamed(scene):
    """Whether frames get no .exr in their names."""
    return not scene.render.use_file_extension and not scene.render.filepath.lower().endswith(".exr")


def _of_scene(scene):
    if not hasattr(scene, "cycles"):
        return [Lack("Cycles is not enabled: turn on Preferences > Add-ons > Cycles Render Engine", False)]
    lacks = []
    if scene.render.engine != "CYCLES":
        lacks.append(Lack("demc denoises Cycles renders: set Render Engine to Cycles", True))
    if scene.camera is None:
        lacks.append(Lack("The scene has no camera: Add > Camera, and View > Cameras > Set Active", False))
    if not rendered_layers(scene):
        lacks.append(Lack("No view layer is rendered: turn on View Layer > Use for Rendering", False))
    if scene.render.use_sequencer and _has_strips(scene):
        lacks.append(Lack("The Sequencer makes the frames, which then have no passes: turn off Output Properties > "
                          "Post Processing > Sequencer", False))
    return lacks


def _has_strips(scene):
    editor = scene.sequence_editor
    # Blender 4.4 renamed sequences to strips.
    return editor is not None and len(getattr(editor, "strips", None) or getattr(editor, "sequences", ())) > 0


def _of_layer(layer, is_sequence):
    lacks = []
    if not layer.use_pass_combined:
        lacks.append(Lack(f"{layer.name} lacks Combined: turn on View Layer > Passes > Data > Combined", True))
    if not layer.cycles.denoising_store_passes:
        lacks.append(Lack(f"{layer.name} lacks albedo and normals: turn on View Layer > Passes > Data > Denoising "
                          "Data", True))
    if is_sequence and not layer.use_pass_vector:
        lacks.append(Lack(f"{layer.name} lacks motion: turn on View Layer > Passes > Data > Vector", True))
    return lacks


def _of_sequence(scene):
    lacks = []
    if scene.render.use_motion_blur:
        lacks.append(Lack("Motion Blur leaves the Vector pass empty: turn it off and blur in the compositor, or turn "
                          "off Temporal", False))
    if hasattr(scene, "cycles") and not scene.cycles.use_animated_seed:
        lacks.append(Lack("All frames have the same noise: turn on the clock beside Sampling > Advanced > Seed", True))
    return lacks


def _of_output(scene):
    settings = scene.render.image_settings
    if not is_multilayer(scene):
        where = "Media Type to Multi-Layer EXR" if hasattr(settings, "media_type") else "File Format to OpenEXR MultiLayer"
        return [Lack(f"{settings.file_format} keeps no passes in files: set Output > {where}", True)]
    if settings.exr_codec not in _LOSSLESS:
        return [Lack(f"{settings.exr_codec} compression loses detail of the passes: set Output > Codec to ZIP", True)]
    if _wants_interleave(scene):
        return [Lack("Blender writes no frames whose pixels are not square: turn on Output > Interleave", True)]
    if _keeps_no_views(scene):
        return [Lack("Blender writes no Stereo 3D files with passes: set Output > Views Format to Multi-View", True)]
    if _is_unnamed(scene):
        return [Lack("Files without .exr in their names are not found again: turn on Output > File Extensions", True)]
    return []
