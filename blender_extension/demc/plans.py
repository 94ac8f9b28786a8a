"""What each button asks for, as a job: which files, which options, and where results go."""

import os
import re
import shutil
import tempfile

import bpy

from . import passes
from .jobs import Job, JobError
from .settings import WEIGHTS_FILE

LAYER = "Denoised"
_NOTHING = "Nothing is rendered yet: press F12 first"
_SUFFIX = ".exr"
# How Denoise This Render saves a render, in the order in which it is set: the media type decides which formats
# there are, and choosing a format changes what is below it.
_SAVED_AS = (
    ("media_type", "MULTI_LAYER_IMAGE"), ("file_format", "OPEN_EXR_MULTILAYER"), ("color_depth", "32"),
    ("exr_codec", "ZIP"), ("views_format", "MULTIVIEW"),
    # Blender 5.0 writes no other files with pixels that are not square.
    ("use_exr_interleave", True),
)


def of_render(scene):
    """The render that is in memory: it is saved with all its passes, and the result becomes a picture."""
    render = bpy.data.images.get("Render Result")
    if render is None:
        raise JobError(_NOTHING)
    _refuse(scene, passes.missing(scene, still=True), "the render")
    # All that may be refused comes before the render is saved, which takes seconds.
    folder, options = _output(scene, os.path.dirname(bpy.data.filepath) or bpy.app.tempdir), _options(scene)
    scratch = tempfile.mkdtemp(prefix="demc-", dir=bpy.app.tempdir)
    name = os.path.splitext(os.path.basename(bpy.data.filepath))[0] or "render"
    # What some system lets no file be called.
    plain = re.sub(r'[\\/:*?"<>|\x00-\x1f]', "_", f"{name}_{scene.name}")
    noisy = os.path.join(scratch, f"{plain}_{scene.frame_current:04}{_SUFFIX}")
    try:
        _save(render, scene, noisy)
    except JobError:
        shutil.rmtree(scratch, ignore_errors=True)
        raise
    job = Job(
        "this render", [noisy], folder, [*options, "--overwrite", "--layer", LAYER], 1, picture=LAYER, scene=scene.name
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
    wanted = [path for frame in range(first, last + 1, step) for path in frame_files(scene, frame)]
    found = [path for path in wanted if os.path.isfile(path)]
    if not found:
        raise JobError(f"None of the frames {first} to {last} is there, such as {wanted[0]}: render the animation first")
    if not found[0].lower().endswith(_SUFFIX):
        raise JobError(f"{os.path.basename(found[0])} keeps no passes: press Prepare Passes and render again")
    job = of_files(scene, found)
    lost = sorted(set(wanted) - set(found))
    if lost:
        job.notes.append(f"{len(lost)} of the frames {first} to {last} are not there, such as {os.path.basename(lost[0])}")
    return job


def of_files(scene, paths, overwrite=False):
    """Frames that were rendered to files. `overwrite` makes results anew that are there."""
    options = _options_of_files(scene, overwrite)
    return Job("frames", paths, _output(scene, os.path.dirname(paths[0])), options, len(paths))


def frame_files(scene, frame):
    """The files that a frame of the animation is rendered to: one, or one for each eye."""
    render = scene.render
    eyes = [""]
    if render.use_multiview and render.image_settings.views_format == "INDIVIDUAL":
        views = render.stereo_views if render.views_format == "STEREO_3D" else render.views
        eyes = [view.name for view in views if view.use]
    try:
        return [bpy.path.abspath(render.frame_path(frame=frame, view=eye)) for eye in eyes]
    except RuntimeError as error:  # from 4.5 on, Blender looks for variables in braces
        raise JobError(f"The Output path {render.filepath} cannot be read: {' '.join(str(error).split())}") from None


def _refuse(scene, lacks, what):
    """Says what is missing, before anything is begun."""
    if lacks:
        more = " Prepare Passes sets it." if any(lack.prepared for lack in lacks) else ""
        raise JobError(f"{lacks[0].text}, and render again: {what} of {scene.name} cannot be denoised.{more}")


def _output(scene, beside):
    if scene.demc.output.startswith("//") and not bpy.data.filepath:
        raise JobError(f"{scene.demc.output} begins at the .blend, which has no place yet: save it first, or choose another "
                       "Output folder")
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


def _options_of_files(scene, overwrite=False):
    settings = scene.demc
    options = _options(scene)
    if settings.use_temporal and settings.light_passes:
        raise JobError("Temporal leaves light passes as they are: turn off Light Passes or Temporal")
    options += [] if settings.keep_noisy else ["--replace"]
    if settings.use_temporal:
        options += ["--temporal", str(settings.temporal)]
    if settings.overwrite or overwrite:
        options.append("--overwrite")
    return options


def _save(render, scene, path):
    """Saves a render with all its passes as floats, by settings of a copy: the scene's own stay as they
    are."""
    settings = scene.render.image_settings
    # All of it before anything is set, since one setting changes others.
    kept = {name: getattr(settings, name) for name, _ in _SAVED_AS if hasattr(settings, name)}
    # Choosing a format resets the colour space of files, even if it is the same one.
    linear = getattr(settings, "linear_colorspace_settings", None)
    space = linear.name if linear is not None else ""
    try:
        for name, value in _SAVED_AS:
            if name in kept:
                setattr(settings, name, value)
        _save_as_set(render, scene, path)
    except RuntimeError as error:
        # Blender has no other way to tell that there is no render.
        if "buffer" in str(error):
            raise JobError(_NOTHING) from None
        raise JobError(f"The render cannot be saved to {path}: {' '.join(str(error).split())}") from None
    finally:
        for name, value in kept.items():
            if value != "":  # what Blender says of a choice that this format does not have
                setattr(settings, name, value)
        if space:
            linear.name = space


def _save_as_set(render, scene, path):
    try:
        render.save_render(path, scene=scene)
    except RuntimeError:
        # The first time, Blender goes by the views format that the scene had when it was rendered.
        if not scene.render.use_multiview:
            raise
        render.save_render(path, scene=scene)
