"""demc in Blender: Render Properties > demc denoises renders, folders and frame ranges.

Nothing of demc runs inside Blender: a worker process does (`worker.py`), so that it can be cancelled at any
moment and a failure of it costs no work that is not saved. `jobs.py` starts and follows it; operators,
handlers and scripts all go through the same jobs.
"""

from . import handlers, jobs, operators, panel, settings

_PARTS = (settings, operators, panel, handlers)


def register():
    """Called by Blender when the extension is enabled."""
    for part in _PARTS:
        part.register()


def unregister():
    """Called when it is disabled, and when Blender ends: nothing of it stays, no worker either."""
    ran = jobs.is_running()
    jobs.abandon()
    if ran:
        panel.show_progress(None, "")
    for part in reversed(_PARTS):
        part.unregister()
