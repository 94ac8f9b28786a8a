"""What each button asks for, as a job: which files, which options, and where results go."""

import os
import tempfile

import bpy

from . import passes
from .jobs import Job, JobError
from .settings import WEIGHTS_FILE

LAYER = "Denoised"
_NOTHING = "Nothing is rendered yet: press F12 first"
_SUFFIX = ".exr"


def of_render(scene):
    """The render that is in memory: it is saved with all its passes, and the result becomes a picture."""
    render = bpy.data.images.get("Render Result")
    if render is None:
        raise JobError(_NOTHING)
    _refuse(scene, passes.missing(scene), "the render")
    scratch = tempfile.mkdtemp(prefix="demc-", dir=bpy.app.tempdir)
    name = os.path.splitext(os.path.basename(bpy.data.filepath))[0] or "render"
    noisy = os.path.join(scratch, f"{name}_{scene.name}_{scene.frame_current:04}{_SUFFIX}".replace(os.sep, "_"))
    _save(render, scene, noisy)
    beside = os.path.dirname(bpy.data.filepath) or bpy.app.tempdir
    job = Job(
        "this render", [noisy], _output(scene, beside), [*_options(scene), "--overwrite", "--layer", LAYER], 1,
        picture=LAYER, scene=scene.name,
    )
    job.scratch.append(scratch)
    return job


def of_folder(scene):
    """The EXR files of a folder."""
    folder = bpy.path.abspath(scene.demc.folder)
    if not scene.demc.folder or not os.path.isdir(folder):
        raise JobError("Choose the folder of the frames first")
    count = sum(name.lower().endswith(_SUFFIX) for name in os.listdir(folder))
    if not count:
        raise JobError(f"{folder} holds no EXR files: render to OpenEXR MultiLayer")
    return Job("this folder", [folder], _output(scene, folder), _options_of_files(scene), count)


def of_range(scene):
    """The frames of the scene's animation that are on disk."""
    settings = scene.demc
    first, last = scene.frame_start, scene.frame_end
    if settings.use_own_range:
        first, last = settings.frame_first, settings.frame_last
    if first > last:
        raise JobError(f"The first frame, {first}, lies behind the last, {last}")
    step = 1 if settings.use_own_range else scene.frame_step
    wanted = [bpy.path.abspath(scene.render.frame_path(frame=frame)) for frame in range(first, last + 1, step)]
    found = [path for path in wanted if os.path.isfile(path)]
    if not found:
        raise JobError(f"None of the frames {first} to {last} is there, such as {wanted[0]}: render the animation first")
    if not found[0].lower().endswith(_SUFFIX):
        raise JobError(f"{os.path.basename(found[0])} keeps no passes: press Prepare Passes and render again")
    return of_files(scene, found)


def of_files(scene, paths):
    """Frames that were rendered to files."""
    return Job("frames", paths, _output(scene, os.path.dirname(paths[0])), _options_of_files(scene), len(paths))


def _refuse(scene, lacks, what):
    """Says what is missing, before anything is begun."""
    if lacks:
        more = " Prepare Passes sets it." if any(lack.prepared for lack in lacks) else ""
        raise JobError(f"{lacks[0].text}, and render again: {what} of {scene.name} cannot be denoised.{more}")


def _output(scene, beside):
    folder = bpy.path.abspath(scene.demc.output) if scene.demc.output else os.path.join(beside, "denoised")
    try:
        os.makedirs(folder, exist_ok=True)
    except OSError as error:
        raise JobError(f"{folder}: cannot be made ({error.strerror}); choose another Output folder") from None
    if not os.access(folder, os.W_OK):
        raise JobError(f"{folder}: nothing can be written there; choose another Output folder")
    return folder


def _options(scene):
    settings = scene.demc
    model = settings.model
    if model == WEIGHTS_FILE:
        model = bpy.path.abspath(settings.weights)
        if not os.path.isfile(model):
            raise JobError("Choose the weights file of the model first")
    options = ["--model", model, "--alpha", settings.alpha]
    if settings.light_passes:
        options.append("--passes")
    if settings.view_layer:
        options += ["--view-layer", settings.view_layer]
    if settings.threads:
        options += ["--threads", str(settings.threads)]
    return options


def _options_of_files(scene):
    settings = scene.demc
    options = _options(scene)
    options += [] if settings.keep_noisy else ["--replace"]
    if settings.use_temporal:
        options += ["--temporal", str(settings.temporal)]
    if settings.overwrite:
        options.append("--overwrite")
    return options


def _save(render, scene, path):
    """Saves a render with all its passes as floats, by settings of a copy: the scene's own stay as they
    are."""
    settings = scene.render.image_settings
    kept = {}

    def put(name, value):
        if hasattr(settings, name):
            kept.setdefault(name, getattr(settings, name))
            setattr(settings, name, value)

    try:
        put("media_type", "MULTI_LAYER_IMAGE")
        put("file_format", "OPEN_EXR_MULTILAYER")
        put("color_depth", "32")
        put("exr_codec", "ZIP")
        render.save_render(path, scene=scene)
    except RuntimeError as error:
        # Blender has no other way to tell that there is no render.
        if "buffer" in str(error):
            raise JobError(_NOTHING) from None
        raise JobError(f"The render cannot be saved to {path}: {' '.join(str(error).split())}") from None
    finally:
        # In the order in which they were set: the media type decides which formats there are.
        for name, value in kept.items():
            setattr(settings, name, value)
