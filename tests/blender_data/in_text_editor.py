"""Runs a script with --help as Blender's text editor does: in_text_editor.py SCRIPT FOLDER."""

import sys

import bpy

script, folder = sys.argv[1:]
bpy.ops.wm.save_as_mainfile(filepath=f"{folder}/shot.blend")
text = bpy.data.texts.load(script)
sys.argv = ["export_passes.py", "--help"]
with bpy.context.temp_override(edit_text=text):
    bpy.ops.text.run_script()
