"""Denoise After Render: a still when it is done, the frames of an animation when all are."""

import functools
import os

import bpy
from bpy.app.handlers import persistent

from . import jobs, outcome, panel, passes, plans

_LOOK_SECONDS = 0.3
# No operator is at hand to take a key.
_CANCELS = "The X in Render Properties > demc Denoiser"

# The scene whose render is under way: those of strips in its sequencer are rendered in between.
_rendered = None
# Files of the animation that the render under way has written.
_written = []
# When files of the current frame were written that were there before it: a single render that is written has
# another name, and leaves them as they are.
_before = {}
# The timer that waits for the render's thread to end.
_later = None


@persistent
def _on_init(scene, _depsgraph=None):
    global _rendered
    if _rendered is not None and _is_strip(scene, bpy.data.scenes.get(_rendered)):
        return
    _rendered = scene.name
    _written.clear()
    _before.clear()
    if scene.demc.after_render:
        _before.update((path, _written_at(path)) for path in _files(scene))


@persistent
def _on_write(scene, _depsgraph=None):
    if not scene.demc.after_render or scene.name != _rendered:
        return
    for path in _files(scene):
        if scene.render.is_movie_format or _written_at(path) not in (None, _before.get(path)):
            _written.append(path)


def _is_strip(scene, edit):
    """Whether a scene is rendered for a strip of another one's sequencer."""
    editor = edit.sequence_editor if edit else None
    if editor is None or edit.name == scene.name:
        return False
    strips = editor.strips_all if hasattr(editor, "strips_all") else editor.sequences_all  # before 4.4
    return any(strip.type == "SCENE" and strip.scene and strip.scene.name == scene.name for strip in strips)


def _files(scene):
    """The files of the current frame; none where its path cannot be read, which Blender itself tells."""
    try:
        return plans.frame_files(scene, scene.frame_current)
    except jobs.JobError:
        return []


def _written_at(path):
    return os.stat(path).st_mtime_ns if os.path.isfile(path) else None


@persistent
def _on_cancel(scene, _depsgraph=None):
    global _rendered
    if scene.name == _rendered:
        _rendered = None


@persistent
def _on_complete(scene, _depsgraph=None):
    global _rendered, _later
    if scene.name != _rendered:
        return
    _rendered = None
    if not scene.demc.after_render:
        return
    frames = list(dict.fromkeys(_written))
    _written.clear()
    if bpy.app.background:
        if _begin(scene, frames):
            _finish(jobs.current().wait())
    else:
        # Not here: this is the thread of the render, where no data may be changed.
        _later = functools.partial(_begin_later, scene.name, frames)
        bpy.app.timers.register(_later, first_interval=_LOOK_SECONDS)


@persistent
def _on_load(_path, _unused=None):
    """Another file is opened: nobody would take the result, and Blender takes the timer away."""
    global _rendered
    _rendered = None
    jobs.abandon()


def _begin(scene, written):
    """Starts the job for a render, and returns whether there is one."""
    frames = [path for path in written if path.lower().endswith(".exr") and os.path.isfile(path)]
    try:
        if written and not frames:
            lack = passes.missing(scene, frames=True)
            raise jobs.JobError(lack[0].text if lack else "The frames are no EXR files")
        # Results of these frames that are there are of a render before.
        jobs.begin(plans.of_files(scene, frames, overwrite=True) if frames else plans.of_render(scene))
    except jobs.JobError as error:
        jobs.refuse(str(error))
        print(f"demc: {error}")
        return False
    return True


def _begin_later(name, written):
    """Called from a timer until the render's thread has ended, and what is denoised by then is done."""
    if bpy.app.is_job_running("RENDER") or jobs.is_running():
        return _LOOK_SECONDS
    scene = bpy.data.scenes.get(name)
    if scene is not None and _begin(scene, written):
        bpy.app.timers.register(_follow, first_interval=_LOOK_SECONDS)
    panel.show_progress(jobs.current(), _CANCELS)
    return None


def _follow():
    """Called from a timer until the job has ended."""
    job = jobs.current()
    if job is None:
        return None
    runs = job.poll()
    panel.show_progress(job, _CANCELS)
    if runs:
        return _LOOK_SECONDS
    _finish(job)
    return None


def _finish(job):
    if outcome.take(job) is not None and not bpy.app.background:
        with bpy.context.temp_override(window=bpy.context.window_manager.windows[0]):
            bpy.ops.ed.undo_push(message="Denoise After Render")
    for line in (*dict.fromkeys(job.notes), job.summary()):
        print(f"demc: {line}")


_HANDLERS = (
    ("render_init", _on_init), ("render_write", _on_write), ("render_complete", _on_complete),
    ("render_cancel", _on_cancel), ("load_pre", _on_load),
)


def register():
    """Adds the handlers."""
    for name, handler in _HANDLERS:
        getattr(bpy.app.handlers, name).append(handler)


def unregister():
    """Takes them away, and the timers."""
    for name, handler in _HANDLERS:
        listed = getattr(bpy.app.handlers, name)
        if handler in listed:
            listed.remove(handler)
    for timer in (_follow, _later):
        if timer is not None and bpy.app.timers.is_registered(timer):
            bpy.app.timers.unregister(timer)
