"""The panel, Render Properties > demc."""

import bpy

from . import jobs, passes
from .settings import WEIGHTS_FILE


class DEMC_PT_panel(bpy.types.Panel):
    """Model, options and buttons."""

    bl_label, bl_idname = "demc Denoiser", "DEMC_PT_panel"
    bl_space_type, bl_region_type, bl_context = "PROPERTIES", "WINDOW", "render"
    bl_options = {"DEFAULT_CLOSED"}

    def draw(self, context):
        scene, layout = context.scene, self.layout
        settings = scene.demc
        layout.use_property_split, layout.use_property_decorate = True, False
        column = layout.column()
        column.prop(settings, "model")
        if settings.model == WEIGHTS_FILE:
            column.prop(settings, "weights")
        _state(layout)
        lacks = passes.missing(scene)
        if lacks:
            box = layout.box()
            for lack in lacks:
                box.label(text=lack.text, icon="ERROR")
            if any(lack.prepared for lack in lacks):
                box.operator("demc.prepare")
        column = layout.column(align=True)
        column.operator("demc.denoise_render", icon="RENDER_STILL")
        column.operator("demc.denoise_range", icon="RENDER_ANIMATION")
        row = column.row(align=True)
        row.operator("demc.denoise_folder", icon="FILE_FOLDER")
        layout.prop(settings, "folder")
        layout.prop(settings, "after_render")
        layout.prop(settings, "use_compositor")


class DEMC_PT_options(bpy.types.Panel):
    """What is chosen seldom."""

    bl_label, bl_idname, bl_parent_id = "Options", "DEMC_PT_options", "DEMC_PT_panel"
    bl_space_type, bl_region_type, bl_context = "PROPERTIES", "WINDOW", "render"
    bl_options = {"DEFAULT_CLOSED"}

    def draw(self, context):
        settings, layout = context.scene.demc, self.layout
        layout.use_property_split, layout.use_property_decorate = True, False
        layout.prop_search(settings, "view_layer", context.scene, "view_layers")
        for name in ("alpha", "light_passes", "keep_noisy", "overwrite", "output", "threads"):
            layout.prop(settings, name)
        layout.prop(settings, "use_temporal")
        row = layout.row()
        row.active = settings.use_temporal
        row.prop(settings, "temporal")
        layout.prop(settings, "use_own_range")
        if settings.use_own_range:
            layout.prop(settings, "frame_first")
            layout.prop(settings, "frame_last")


def _state(layout):
    job = jobs.current()
    if job is None:
        return
    if job.state == jobs.RUNNING:
        row = layout.row()
        row.progress(factor=job.progress, text=f"{job.title}: {job.finished} of {job.total}")
        row.operator("demc.cancel", text="", icon="X")
    else:
        failed = job.state == jobs.FAILED
        layout.label(text=job.summary(), icon="ERROR" if failed else "CHECKMARK")


_CLASSES = (DEMC_PT_panel, DEMC_PT_options)


def register():
    """Adds the panel."""
    for panel in _CLASSES:
        bpy.utils.register_class(panel)


def unregister():
    """Takes it away."""
    for panel in reversed(_CLASSES):
        bpy.utils.unregister_class(panel)
