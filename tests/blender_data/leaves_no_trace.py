"""Runs the export on the open scene, whose files have colours of their own, and lists every property, node or slot
that it left changed.

Arguments: the scripts' folder, the .blend, and those of the export.
"""

import sys

import bpy

scripts, blend, *arguments = sys.argv[1:]
sys.path.insert(0, scripts)
import export_passes

bpy.ops.wm.open_mainfile(filepath=blend)
scene = bpy.context.scene
settings = scene.render.image_settings
if hasattr(settings, "media_type"):
    settings.media_type = "IMAGE"
settings.file_format, settings.color_depth = "OPEN_EXR", "32"
settings.color_management = "OVERRIDE"
settings.linear_colorspace_settings.name = "ACEScg"
settings.view_settings.view_transform, settings.view_settings.exposure = "Standard", 1.5
scene.frame_set(2, subframe=0.5)


def snapshot():
    found = {}
    owners = [scene, scene.render, scene.cycles, settings]
    owners += [settings.view_settings, settings.display_settings, settings.linear_colorspace_settings]
    owners += [o for layer in scene.view_layers for o in (layer, layer.cycles)]
    for number, owner in enumerate(owners):
        for prop in owner.bl_rna.properties:
            if prop.type in {"BOOLEAN", "INT", "FLOAT", "STRING", "ENUM"}:
                value = getattr(owner, prop.identifier)
                found[number, prop.identifier] = tuple(value) if getattr(prop, "is_array", False) else value
    for tree in [m.node_tree for m in bpy.data.materials] + list(bpy.data.node_groups):
        found["tree", tree.name, id(tree)] = sorted(n.name for n in tree.nodes), len(tree.links)
    for group in bpy.data.node_groups:
        found["interface", group.name] = [item.name for item in group.interface.items_tree]
    for obj in scene.objects:
        found["slots", obj.name] = [slot.material and slot.material.name for slot in obj.material_slots]
    found["aovs"] = [aov.name for layer in scene.view_layers for aov in layer.aovs]
    found["materials"] = [m.name for m in bpy.data.materials]
    return {key: value for key, value in found.items() if key[0] != "tree"}, \
        sorted(str(v) for k, v in found.items() if k[0] == "tree")


before = snapshot()
options = export_passes.parse(["unused.blend", "--ref-spp", "1", "--spp", "1", *arguments])
options.scene = None  # the open one
assert export_passes.export(options) == 0
after = snapshot()
changed = [key for key in before[0] if before[0][key] != after[0].get(key)]
print("changed:", changed, "" if before[1] == after[1] else "and node trees")
