"""What is done with a job that has ended: its picture comes into Blender."""

import os

import bpy

from . import compositor
from .jobs import DONE


def take(job):
    """Loads the picture that a job made, if it made one, and wires it into the compositor where that is
    wanted. Returns the image, or None."""
    if job.state != DONE or not job.picture or not os.path.isfile(job.picture):
        return None
    scene = bpy.data.scenes.get(job.scene or "")
    name = f"Denoised {job.scene}"
    image = bpy.data.images.get(name)
    if image is None:
        image = bpy.data.images.load(job.picture)
        image.name = name
    else:
        # A packed image is reloaded from what was packed.
        if image.packed_file:
            image.unpack(method="REMOVE")
        image.filepath = job.picture
        image.reload()
    # Radiance, as the render: without this, Blender would show it as if it were data.
    image.colorspace_settings.is_data = False
    # Its colours are those that Blender computes in; Blender 5 lets a file choose them.
    if hasattr(bpy.data, "colorspace"):
        image.colorspace_settings.name = bpy.data.colorspace.working_space
    if os.path.realpath(job.picture).startswith(os.path.join(os.path.realpath(bpy.app.tempdir), "")):
        image.pack()
        job.notes.append("the .blend has no folder yet: the result is kept in it, and gone unless it is saved")
    if scene is not None and scene.demc.use_compositor:
        layer = job.results[0].get("view_layer") if job.results else None
        if compositor.wire(scene, image, layer or scene.demc.view_layer) is None:
            job.notes.append("the compositor's Use Nodes is off: the result is not wired into it")
    _show(image)
    return image


def _show(image):
    """Puts the result where the render is shown; the editor's list of images leads back."""
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            space = area.spaces.active
            if area.type == "IMAGE_EDITOR" and space.image and space.image.type == "RENDER_RESULT":
                space.image = image
