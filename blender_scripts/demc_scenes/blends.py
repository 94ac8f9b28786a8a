"""Training views of finished .blend scenes: the artist's camera, moved, turned and relit."""

import math
import os

import bpy
from mathutils import Euler, Vector

from . import views


def find_blends(folder, taken=()):
    """Name -> path of every .blend under a folder, by name. Two of one name are refused, and names that are
    taken: which one a seed draws would be chance."""
    found = {}
    for root, folders, files in os.walk(folder):
        folders.sort()
        for file in sorted(files):
            name, extension = os.path.splitext(file)
            if extension != ".blend":
                continue
            path = os.path.join(root, file)
            if name in found:
                raise ValueError(f"{found[name]} and {path} have one name: rename one of them (--blend)")
            if name in taken:
                raise ValueError(f"{path}: {name} is also a kind of made scenes: rename the file (--blend)")
            found[name] = path
    if not found:
        raise ValueError(f"{folder}: no .blend below it (--blend)")
    return dict(sorted(found.items()))


def open_blend(stage, path):
    """Opens a scene and returns a function that places its camera, one of several where there are, at random
    near where it was."""
    bpy.ops.wm.open_mainfile(filepath=path, load_ui=False)
    stage.scene = scene = bpy.context.scene
    scene.timeline_markers.clear()  # a camera bound to one would take the place of that chosen here
    rng = stage.rng
    cameras = sorted((o for o in scene.objects if o.type == "CAMERA"), key=lambda o: o.name)
    if len(cameras) > 1:
        scene.camera = rng.choice(cameras)
    elif cameras and scene.camera is None:
        scene.camera = cameras[0]
    if scene.camera is None:
        raise ValueError(f"{path} has no camera")
    if not any(layer.use for layer in scene.view_layers):
        raise ValueError(f"{path}: all its view layers are off")
    relight(rng, scene)
    camera = scene.camera
    home = camera.matrix_world.copy()
    lens = camera.data.lens
    camera.animation_data_clear()
    camera.constraints.clear()
    camera.parent = None
    focus = distance_ahead(scene, home.translation, home.to_quaternion() @ Vector((0, 0, -1)))

    def place():
        reach = focus or 5.0
        for _ in range(40):
            shift = Vector([rng.gauss(0, reach * 0.15) for _ in range(3)])
            camera.matrix_world = home
            camera.data.lens = lens * math.exp(rng.gauss(0, 0.25))
            # Turned by a part of the angle of view, so that the subject seldom leaves the frame.
            angle = camera.data.angle
            turn = Euler((rng.gauss(0, 0.12 * angle), rng.gauss(0, 0.02), rng.gauss(0, 0.3 * angle)))
            camera.location = home.translation + shift
            camera.rotation_mode = "QUATERNION"
            rotation = home.to_quaternion()
            world_turn = Euler((0, 0, turn.z)).to_quaternion()
            camera.rotation_quaternion = world_turn @ rotation @ Euler((turn.x, 0, turn.y)).to_quaternion()
            ahead = camera.rotation_quaternion @ Vector((0, 0, -1))
            hit = distance_ahead(scene, camera.location, ahead)
            if focus and (hit is None or hit > 4 * focus):
                continue
            if views.sees_ahead(stage, camera.location, ahead, reach * 0.12):
                return camera
        return None
    return place


def distance_ahead(scene, origin, direction):
    """Distance to what lies ahead, None for the sky."""
    hit, point, *_ = scene.ray_cast(bpy.context.evaluated_depsgraph_get(), origin, direction)
    return (point - origin).length if hit else None


def relight(rng, scene):
    """Turns the environment and shifts the strength of lights, within what still suits the scene."""
    for light in bpy.data.lights:
        light.energy *= math.exp(rng.gauss(0, 0.4))
    world = scene.world
    if world is None or world.node_tree is None:
        return
    for node in world.node_tree.nodes:
        if node.bl_idname == "ShaderNodeBackground" and not node.inputs["Strength"].is_linked:
            node.inputs["Strength"].default_value *= math.exp(rng.gauss(0, 0.3))
        if node.bl_idname == "ShaderNodeTexEnvironment" and not node.inputs["Vector"].is_linked:
            mapping = world.node_tree.nodes.new("ShaderNodeMapping")
            mapping.inputs["Rotation"].default_value = (0, 0, rng.uniform(0, 2 * math.pi))
            place = world.node_tree.nodes.new("ShaderNodeTexCoord")
            world.node_tree.links.new(place.outputs["Generated"], mapping.inputs[0])
            world.node_tree.links.new(mapping.outputs[0], node.inputs["Vector"])
