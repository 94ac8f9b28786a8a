"""The panel, Render Properties > demc."""

import textwrap

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
        lacks = passes.missing(scene)
        box = layout.box() if lacks else layout
        for lack in lacks:
            _paragraph(box, context, lack.text, "ERROR")
        # Always, as it also sets what files need, which the panel does not ask for where a render may do.
        box.operator("demc.prepare")
        column = layout.column(align=True)
        column.operator("demc.denoise_render", icon="RENDER_STILL")
        column.operator("demc.denoise_range", icon="RENDER_ANIMATION")
        column.operator("demc.denoise_folder", icon="FILE_FOLDER")
        # Below the buttons, which stay where they are while it comes and goes.
        _state(layout, context)
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


def show_progress(job, cancels):
    """Says in the status bar how far a job is while it runs, and has the panel drawn anew. job: may be
    None. cancels: what ends it."""
    runs = job is not None and job.state == jobs.RUNNING
    for workspace in bpy.data.workspaces:
        workspace.status_text_set(f"demc denoises {_how_far(job)}. {cancels} cancels" if runs else None)
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            if area.type == "PROPERTIES":
                area.tag_redraw()


def _how_far(job):
    return f"{job.title}: {job.finished} of {job.total}"


def _state(layout, context):
    job = jobs.current()
    if jobs.refusal():
        _paragraph(layout, context, jobs.refusal(), "ERROR")
    elif job is None:
        return
    elif job.state == jobs.RUNNING:
        row = layout.row()
        row.progress(factor=job.progress, text=_how_far(job))
        row.operator("demc.cancel", text="", icon="X")
    else:
        failed = job.state == jobs.FAILED
        _paragraph(layout, context, job.summary(), "ERROR" if failed else "CHECKMARK")
        for note in dict.fromkeys(job.notes):
            _paragraph(layout, context, note, "INFO")


def _paragraph(layout, context, text, icon):
    """Text in as many lines as the panel's width asks for: labels do not wrap, and are cut."""
    width = context.region.width / context.preferences.system.ui_scale
    column = layout.column(align=True)
    column.scale_y = 0.8
    # Widths of the default theme: margins and icon, and a letter.
    for line in textwrap.wrap(text, max(int((width - 80) / 6.5), 20)):
        column.label(text=line, icon=icon)
        icon = "BLANK1"


_CLASSES = (DEMC_PT_panel, DEMC_PT_options)


def register():
    """Adds the panel."""
    for panel in _CLASSES:
        bpy.utils.register_class(panel)


def unregister():
    """Takes it away."""
    for panel in reversed(_CLASSES):
        bpy.utils.unregister_class(panel)
