"""Renders a small frame with every light pass and two light groups: path, samples, and "film" for a
transparent film.

A textured floor, a glossy ball, a glass ball, a glowing cube and fog in the far corner, before a sky or
before nothing.
"""

import os
import sys

import bpy

path, samples, film = sys.argv[1], int(sys.argv[2]), sys.argv[3:] == ["film"]
bpy.ops.wm.read_factory_settings(use_empty=True)
scene = bpy.context.scene


def material(name, kind, **inputs):
    made = bpy.data.materials.new(name)
    if made.node_tree is None:
        made.use_nodes = True
    made.node_tree.nodes.clear()
    shader = made.node_tree.nodes.new(kind)
    for key, value in inputs.items():
        shader.inputs[key.replace("_", " ")].default_value = value
    output = made.node_tree.nodes.new("ShaderNodeOutputMaterial")
    socket = "Volume" if kind == "ShaderNodeVolumeScatter" else "Surface"
    made.node_tree.links.new(shader.outputs[0], output.inputs[socket])
    return made, shader


def put(what, place, surface, **options):
    getattr(bpy.ops.mesh, f"primitive_{what}_add")(location=place, **options)
    bpy.context.object.data.materials.append(surface)
    return bpy.context.object


floor, shader = material("floor", "ShaderNodeBsdfDiffuse")
checker = floor.node_tree.nodes.new("ShaderNodeTexChecker")
checker.inputs["Scale"].default_value = 9
checker.inputs["Color1"].default_value = (0.8, 0.3, 0.1, 1)
checker.inputs["Color2"].default_value = (0.05, 0.1, 0.6, 1)
floor.node_tree.links.new(checker.outputs[0], shader.inputs["Color"])
put("plane", (0, 0, 0), floor, size=3.2 if film else 12)
put("uv_sphere", (-0.8, 0, 0.5), material("gloss", "ShaderNodeBsdfGlossy", Roughness=0.3)[0], radius=0.5)
put("uv_sphere", (0.6, -0.3, 0.5), material("glass", "ShaderNodeBsdfGlass")[0], radius=0.5)
lamp = put("cube", (0.4, 1.2, 0.3), material("lamp", "ShaderNodeEmission", Strength=3.0)[0], size=0.4)
put("cube", (-1, 1.2, 0.4), material("fog", "ShaderNodeVolumeScatter", Density=2.0)[0], size=0.8)

sun = bpy.data.objects.new("sun", bpy.data.lights.new("sun", "AREA"))
sun.data.energy, sun.data.size, sun.location = 120.0, 0.6, (1.5, -2.0, 3.0)
sun.rotation_euler = (0.6, 0.35, 0)
camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
camera.location, camera.rotation_euler = (0, -4.2, 2.2), (1.15, 0, 0)
for obj in (sun, camera):
    scene.collection.objects.link(obj)
scene.camera = camera
world = bpy.data.worlds.new("world")
if world.node_tree is None:
    world.use_nodes = True
world.node_tree.nodes.clear()
sky = world.node_tree.nodes.new("ShaderNodeBackground")
sky.inputs["Color"].default_value = (0.3, 0.5, 0.9, 1)
output = world.node_tree.nodes.new("ShaderNodeOutputWorld")
world.node_tree.links.new(sky.outputs[0], output.inputs[0])
scene.world = world

layer = scene.view_layers[0]
for kind in ("diffuse", "glossy", "transmission"):
    for part in ("direct", "indirect", "color"):
        setattr(layer, f"use_pass_{kind}_{part}", True)
layer.use_pass_emit = layer.use_pass_environment = True
layer.cycles.use_pass_volume_direct = layer.cycles.use_pass_volume_indirect = True
layer.cycles.denoising_store_passes = True
for group in ("Key", "Rest"):
    layer.lightgroups.add(name=group)
sun.lightgroup = "Key"
lamp.lightgroup = world.lightgroup = "Rest"

scene.render.engine = "CYCLES"
scene.render.film_transparent = film
scene.cycles.samples, scene.cycles.use_adaptive_sampling, scene.cycles.use_denoising = samples, False, False
scene.cycles.sample_clamp_indirect = 0
scene.render.resolution_x, scene.render.resolution_y, scene.render.resolution_percentage = 96, 72, 100
settings = scene.render.image_settings
if hasattr(settings, "media_type"):
    settings.media_type = "MULTI_LAYER_IMAGE"
settings.file_format, settings.color_depth = "OPEN_EXR_MULTILAYER", "32"
scene.render.filepath = path
bpy.ops.render.render(write_still=True)
sys.stdout.flush()
os._exit(0 if os.path.exists(path) else 1)
