"""Exports the open scene, whose files have colours of their own, and says which settings are not as they were:
leaves_settings.py SCRIPTS BLEND ARGUMENT..."""

import sys

import bpy

scripts, blend, *arguments = sys.argv[1:]
sys.argv[1:] = []
sys.path.insert(0, scripts)

import export_passes

bpy.ops.wm.open_mainfile(filepath=blend)
scene = bpy.context.scene
images = scene.render.image_settings
if hasattr(images, "media_type"):
    images.media_type = "MULTI_LAYER_IMAGE"
images.file_format = "OPEN_EXR_MULTILAYER"
images.color_management = "OVERRIDE"
images.linear_colorspace_settings.name = "ACEScg"
images.view_settings.view_transform, images.view_settings.exposure = "Standard", 1.5


def state():
    """All that is said of how images are written."""
    owners = (images, images.view_settings, images.display_settings, images.linear_colorspace_settings)
    kinds = ("ENUM", "INT", "BOOLEAN", "FLOAT", "STRING")
    return {(owner.bl_rna.identifier, p.identifier): getattr(owner, p.identifier)
            for owner in owners for p in owner.bl_rna.properties if p.type in kinds and not getattr(p, "is_array", False)}


before = state()
options = export_passes.parse([blend, *arguments])
options.scene = None
failed = export_passes.export(options)
print("failed:", failed, "changed:", [(name, value, state()[name]) for name, value in before.items() if state()[name] != value])
