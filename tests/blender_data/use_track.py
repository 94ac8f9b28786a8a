"""Prints what a scene of a track holds: use_track.py YARD.blend"""

import sys

import bpy

bpy.ops.wm.open_mainfile(filepath=sys.argv[-1], load_ui=False)
for obj in sorted(bpy.context.scene.objects, key=lambda o: o.name):
    if obj.type == "MESH":
        corners = [obj.matrix_world @ v.co for p in obj.data.polygons for v in (obj.data.vertices[i] for i in p.vertices)]
        bounds = " ".join(f"{f(c[i] for c in corners):.1f}" for f in (min, max) for i in range(3))
        colour = tuple(round(v, 2) for v in obj.data.color_attributes[0].data[0].color)
        print(f"MESH {len(obj.data.polygons)} {bounds} {colour} {[i.name for i in bpy.data.images if i.packed_file]}")
    elif obj.type == "LIGHT":
        print(f"LIGHT {obj.data.type} {tuple(round(v, 1) for v in obj.location)} {tuple(round(v, 2) for v in obj.data.color)}")
print("CAMERAS", sum(o.type == "CAMERA" for o in bpy.context.scene.objects))
