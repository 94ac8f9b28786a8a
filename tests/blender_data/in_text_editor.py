"""Runs a script with --help as Blender's text editor does: in_text_editor.py SCRIPT FOLDER."""

import atexit
import os
import sys

import bpy


def end():
    # The script's own end comes within an operator, in which bpy 4.5 waits for ever to take itself apart.
    sys.stdout.flush()
    os._exit(0)


script, folder = sys.argv[1:]
bpy.ops.wm.save_as_mainfile(filepath=f"{folder}/shot.blend")
text = bpy.data.texts.load(script)
sys.argv = ["export_passes.py", "--help"]
atexit.register(end)
with bpy.context.temp_override(edit_text=text):
    bpy.ops.text.run_script()
