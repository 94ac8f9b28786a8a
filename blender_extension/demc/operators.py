"""The buttons. Each begins a job and follows it from a timer, so that Blender stays usable; in background
mode, where there are no timers, it waits."""

import bpy

from . import jobs, outcome, panel, passes, plans

_LOOK_SECONDS = 0.2


class _Denoise:
    """Begins the job that `plan` makes of the scene."""

    # Not REGISTER: Repeat Last would run `execute`, which waits, and Blender with it.
    bl_options = set()
    _timer = None
    _job = None
    # The timers that run: Blender does not tell an operator that it is unregistered.
    timers = []

    @classmethod
    def poll(cls, _context):
        if jobs.is_running():
            cls.poll_message_set("demc is at work: wait for it, or cancel it")
            return False
        return True

    def execute(self, context):
        if not self._begin(context):
            return {"CANCELLED"}
        self._job.wait()
        return self._end()

    def invoke(self, context, _event):
        if bpy.app.background:
            return self.execute(context)
        if not self._begin(context):
            return {"CANCELLED"}
        self._timer = context.window_manager.event_timer_add(_LOOK_SECONDS, window=context.window)
        self.timers.append(self._timer)
        context.window_manager.modal_handler_add(self)
        return {"RUNNING_MODAL"}

    def modal(self, context, event):
        if event.type == "ESC" and event.value == "PRESS":
            self._job.stop()
            return {"RUNNING_MODAL"}
        if event.type != "TIMER":
            return {"PASS_THROUGH"}
        runs = self._job.poll()
        panel.show_progress(self._job, "Esc")
        if runs:
            return {"PASS_THROUGH"}
        self._remove_timer(context)
        return self._end()

    def cancel(self, context):
        """Called where Blender takes the operator away: its window closes, or another file is opened."""
        self._remove_timer(context)
        self._job.kill()
        panel.show_progress(self._job, "Esc")

    def _remove_timer(self, context):
        self.timers.remove(self._timer)
        context.window_manager.event_timer_remove(self._timer)

    def _begin(self, context):
        try:
            self._job = type(self).plan(context.scene)
            jobs.begin(self._job)
        except jobs.JobError as error:
            self.report({"ERROR"}, str(error))
            return False
        return True

    def _end(self):
        outcome.take(self._job)
        for note in dict.fromkeys(self._job.notes):
            self.report({"INFO"}, note)
        self.report({"ERROR" if self._job.state == jobs.FAILED else "INFO"}, self._job.summary())
        return {"FINISHED" if self._job.state == jobs.DONE else "CANCELLED"}


class DEMC_OT_denoise_render(_Denoise, bpy.types.Operator):
    """Denoise the render that is shown, with its passes; the result becomes an image"""

    bl_idname, bl_label = "demc.denoise_render", "Denoise This Render"
    bl_options = {"UNDO"}
    plan = staticmethod(plans.of_render)

    @classmethod
    def poll(cls, context):
        # Blender would save what of it is there by then.
        if bpy.app.is_job_running("RENDER"):
            cls.poll_message_set("Blender is rendering: wait for it, or cancel it")
            return False
        return super().poll(context)


class DEMC_OT_denoise_folder(_Denoise, bpy.types.Operator):
    """Denoise all multilayer EXR files of the folder"""

    bl_idname, bl_label = "demc.denoise_folder", "Denoise This Folder"
    plan = staticmethod(plans.of_folder)


class DEMC_OT_denoise_range(_Denoise, bpy.types.Operator):
    """Denoise the frames of the animation that are rendered"""

    bl_idname, bl_label = "demc.denoise_range", "Denoise Frame Range"
    plan = staticmethod(plans.of_range)


class DEMC_OT_cancel(bpy.types.Operator):
    """Stop denoising. Files are whole or not there"""

    bl_idname, bl_label = "demc.cancel", "Cancel"

    @classmethod
    def poll(cls, _context):
        return jobs.is_running()

    def execute(self, _context):
        jobs.current().stop()
        return {"FINISHED"}


class DEMC_OT_prepare(bpy.types.Operator):
    """Turn on what demc needs of renders: passes, file format. Undo takes it back"""

    bl_idname, bl_label = "demc.prepare", "Prepare Passes"
    bl_options = {"REGISTER", "UNDO"}

    def execute(self, context):
        done = passes.prepare(context.scene)
        self.report({"INFO"}, ", ".join(done) if done else "all is as demc needs it")
        for lack in passes.missing(context.scene, frames=True):
            self.report({"WARNING"}, lack.text)
        return {"FINISHED"}


_CLASSES = (
    DEMC_OT_denoise_render, DEMC_OT_denoise_folder, DEMC_OT_denoise_range, DEMC_OT_cancel, DEMC_OT_prepare,
)


def register():
    """Adds the operators."""
    for operator in _CLASSES:
        bpy.utils.register_class(operator)


def unregister():
    """Takes them away, and their timers."""
    while _Denoise.timers:
        bpy.context.window_manager.event_timer_remove(_Denoise.timers.pop())
    for operator in reversed(_CLASSES):
        bpy.utils.unregister_class(operator)
