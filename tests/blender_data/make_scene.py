"""Writes a small .blend to the path given, with what is hard about the position AOV.

Seen from straight above, in world units (x right, y up, 8 x 6 units in the frame):
- a floor at z = 0 with a strong checker texture, so that a wrong texture shows;
- lower left: a cube without any material, its top at z = 1;
- lower right: a black card at z = 1 whose Principled alpha is 0.2 (a clear leaf: the floor is seen);
- upper right: a black card at z = 1 that mixes in transparency inside a node group, 0.9 opaque;
- upper left: the same group, 0.3 opaque, at z = 2.
Black, because Cycles then sends every path on through the clear cards.
"""

import math
import sys

import bpy

bpy.ops.wm.read_factory_settings(use_empty=True)
scene = bpy.context.scene


def material(name):
    made = bpy.data.materials.new(name)
    if made.node_tree is None:
        made.use_nodes = True
    made.node_tree.nodes.clear()
    return made, made.node_tree, made.node_tree.nodes.new("ShaderNodeOutputMaterial")


def card(x, y, z, size, surface):
    bpy.ops.mesh.primitive_plane_add(size=size, location=(x, y, z))
    if surface:
        bpy.context.object.data.materials.append(surface)


floor, tree, output = material("floor")
image = bpy.data.images.new("checker", 16, 16, float_buffer=False)
image.pixels = [v for y in range(16) for x in range(16)
                for v in ((0.9, 0.1, 0.1, 1) if (x // 2 + y // 2) % 2 else (0.1, 0.2, 0.9, 1))]
image.pack()
texture = tree.nodes.new("ShaderNodeTexImage")
texture.image, texture.interpolation = image, "Closest"
shader = tree.nodes.new("ShaderNodeBsdfPrincipled")
tree.links.new(texture.outputs["Color"], shader.inputs["Base Color"])
tree.links.new(shader.outputs[0], output.inputs["Surface"])
card(0, 0, 0, 10, floor)

bpy.ops.mesh.primitive_cube_add(size=1, location=(-2, -1.5, 0.5))

clear, tree, output = material("clear leaf")
shader = tree.nodes.new("ShaderNodeBsdfPrincipled")
shader.inputs["Alpha"].default_value = 0.2
shader.inputs["Base Color"].default_value = (0, 0, 0, 1)
shader.inputs["Specular IOR Level"].default_value = 0
tree.links.new(shader.outputs[0], output.inputs["Surface"])
card(2, -1.5, 1, 1.5, clear)

group = bpy.data.node_groups.new("cutout", "ShaderNodeTree")
group.interface.new_socket("Opacity", in_out="INPUT", socket_type="NodeSocketFloat")
group.interface.new_socket("Shader", in_out="OUTPUT", socket_type="NodeSocketShader")
start, end = group.nodes.new("NodeGroupInput"), group.nodes.new("NodeGroupOutput")
mix = group.nodes.new("ShaderNodeMixShader")
group.links.new(start.outputs[0], mix.inputs[0])
group.links.new(group.nodes.new("ShaderNodeBsdfTransparent").outputs[0], mix.inputs[1])
black = group.nodes.new("ShaderNodeBsdfDiffuse")
black.inputs["Color"].default_value = (0, 0, 0, 1)
group.links.new(black.outputs[0], mix.inputs[2])
group.links.new(mix.outputs[0], end.inputs[0])
for name, opacity, place in (("mostly solid", 0.9, (2, 1.5, 1)), ("mostly clear", 0.3, (-2, 1.5, 2))):
    cut, tree, output = material(name)
    node = tree.nodes.new("ShaderNodeGroup")
    node.node_tree = group
    node.inputs[0].default_value = opacity
    tree.links.new(node.outputs[0], output.inputs["Surface"])
    card(*place, 1.5, cut)

sun = bpy.data.objects.new("sun", bpy.data.lights.new("sun", "SUN"))
sun.data.energy, sun.rotation_euler = 3.0, (0.4, 0.3, 0)
camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
camera.location, camera.data.type, camera.data.ortho_scale = (0, 0, 10), "ORTHO", 8
for obj in (sun, camera):
    scene.collection.objects.link(obj)
scene.camera = camera
world = bpy.data.worlds.new("world")
scene.world = world
# Settings that an export must override, and must put back.
scene.render.engine = "CYCLES"
scene.render.resolution_x, scene.render.resolution_y, scene.render.resolution_percentage = 200, 150, 50
scene.render.image_settings.file_format = "PNG"
scene.render.image_settings.color_depth = "16"
scene.render.use_persistent_data = True
scene.cycles.use_denoising = True
scene.cycles.samples = 7
scene.view_layers[0].name = "Main"
scene.view_layers.new("Second").use = False
assert math.isclose(camera.location.z, 10)
bpy.ops.wm.save_as_mainfile(filepath=sys.argv[1])
