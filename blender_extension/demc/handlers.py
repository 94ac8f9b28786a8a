"""Denoise After Render: a still when it is done, the frames of an animation when all are."""

import os

import bpy
from bpy.app.handlers import persistent

from . import jobs, outcome, passes, plans

_LOOK_SECONDS = 0.3

# Files that the render under way has written.
_written = []


@persistent
def _on_init(_scene, _depsgraph=None):
    _written.clear()


@persistent
def _on_write(scene, _depsgraph=None):
    if scene.demc.after_render:
        _written.append(bpy.path.abspath(scene.render.frame_path(frame=scene.frame_current)))


@persistent
def _on_complete(scene, _depsgraph=None):
    if not scene.demc.after_render:
        return
    frames = [path for path in dict.fromkeys(_written) if path.lower().endswith(".exr") and os.path.isfile(path)]
    lost = bool(_written) and not frames
    _written.clear()
    try:
        if lost:
            lack = passes.missing(scene, frames=True)
            raise jobs.JobError(lack[0].text if lack else "The frames are no EXR files")
        job = plans.of_files(scene, frames) if frames else plans.of_render(scene)
        jobs.begin(job)
    except jobs.JobError as error:
        print(f"demc: {error}")
        return
    if bpy.app.background:
        _finish(job.wait())
    else:
        bpy.app.timers.register(_follow, first_interval=_LOOK_SECONDS)


def _follow():
    """Called from a timer, outside of the render: there, no data may be added."""
    job = jobs.current()
    if job is None or not job.poll():
        if job is not None:
            _finish(job)
        return None
    return _LOOK_SECONDS


def _finish(job):
    outcome.take(job)
    print(f"demc: {job.summary()}")


_HANDLERS = (
    ("render_init", _on_init), ("render_write", _on_write), ("render_complete", _on_complete),
)


def register():
    """Adds the handlers."""
    for name, handler in _HANDLERS:
        getattr(bpy.app.handlers, name).append(handler)


def unregister():
    """Takes them away, and the timer."""
    for name, handler in _HANDLERS:
        listed = getattr(bpy.app.handlers, name)
        if handler in listed:
            listed.remove(handler)
    if bpy.app.timers.is_registered(_follow):
        bpy.app.timers.unregister(_follow)
