"""Writes a .blend with what an export must not pass over in silence, to the path given.

Two scenes, `Main` (active) and `Other`, 64x36 pixels each: a cube that moves, seen by a camera. What is
hard about them comes by name, as further arguments: stereo, border, step, aspect, blur, texture, library, animated
(what an export sets), catcher (of shadows), marked (cameras by markers alone), driven (by a script), linked (to props.blend,
which is there), between (saved at frame 2.5), simulated (rigid bodies, not baked).
"""

import os
import sys

import bpy

path, wanted = sys.argv[1], set(sys.argv[2:])
bpy.ops.wm.read_factory_settings(use_empty=True)
main = bpy.context.scene
main.name = "Main"
scenes = [main] + ([bpy.data.scenes.new("Other")] if "two" in wanted else [])
cube = bpy.data.meshes.new("cube")
cube.from_pydata([(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)], [], [(0, 1, 2, 3)])
for scene in scenes:
    card = bpy.data.objects.new("card", cube)
    card.keyframe_insert("location", frame=1)
    card.location.x = 2
    card.keyframe_insert("location", frame=9)
    lamp = bpy.data.objects.new("lamp", bpy.data.lights.new("lamp", "SUN"))
    camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    camera.location.z = 6
    for thing in (card, lamp, camera):
        scene.collection.objects.link(thing)
    scene.camera = camera
    render = scene.render
    render.engine = "CYCLES"
    render.resolution_x, render.resolution_y, render.resolution_percentage = 64, 36, 100
    scene.frame_start, scene.frame_end = 1, 5
    render.use_multiview = "stereo" in wanted
    render.use_motion_blur = "blur" in wanted
    scene.frame_step = 2 if "step" in wanted else 1
    if "aspect" in wanted:
        render.pixel_aspect_y = 2.0
    if "border" in wanted:
        render.use_border = render.use_crop_to_border = True
        render.border_min_x, render.border_max_x = 0.25, 0.75
        render.border_min_y, render.border_max_y = 0.5, 1.0
scenes[-1].render.resolution_x = 64 if len(scenes) == 1 else 32
if "texture" in wanted:
    material = bpy.data.materials.new("painted")
    if material.node_tree is None:
        material.use_nodes = True
    image = bpy.data.images.new("paint", 4, 4)
    image.source, image.filepath = "FILE", os.path.join(os.path.dirname(path), "lost_paint.png")
    material.node_tree.nodes.new("ShaderNodeTexImage").image = image
    cube.materials.append(material)
if wanted & {"library", "linked"}:
    library = os.path.join(os.path.dirname(path), "props.blend" if "linked" in wanted else "lost_library.blend")
    prop = bpy.data.meshes.new("prop")
    bpy.data.libraries.write(library, {prop})
    bpy.data.meshes.remove(prop)
    with bpy.data.libraries.load(library, link=True) as (there, here):
        here.meshes = ["prop"]
    main.collection.objects.link(bpy.data.objects.new("prop", here.meshes[0]))
    if "library" in wanted:
        os.remove(library)
if "animated" in wanted:
    main.cycles.driver_add("seed").driver.expression = "frame"
    for frame, samples in ((1, 1), (9, 7)):
        main.cycles.samples = samples
        main.cycles.keyframe_insert("samples", frame=frame)
    main.cycles.time_limit = 1e-3
    main.cycles.keyframe_insert("time_limit", frame=1)
if "catcher" in wanted:
    card.is_shadow_catcher = main.render.film_transparent = True
    main.view_layers[0].cycles.use_pass_shadow_catcher = True
    small = bpy.data.objects.new("small", cube)
    small.location.z, small.scale = 1.0, (0.3, 0.3, 0.3)
    main.collection.objects.link(small)
    lamp.rotation_euler.x = 0.5
if "marked" in wanted:
    marker = main.timeline_markers.new("shot", frame=1)
    marker.camera, main.camera = camera, None
if "driven" in wanted:
    card.driver_add("scale", 0).driver.expression = "len(bpy.data.objects)"
if "between" in wanted:
    main.frame_set(2, subframe=0.5)
if "simulated" in wanted:
    bpy.ops.rigidbody.world_add()
    main.rigidbody_world.collection = bpy.data.collections.new("bodies")
    main.rigidbody_world.collection.objects.link(card)
bpy.ops.wm.save_as_mainfile(filepath=path)
# bpy 4.5 waits for ever at its end to free a driver of Python's.
os._exit(0)
