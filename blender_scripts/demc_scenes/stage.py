"""The scene being built: its random source, library, ground plan, and how things are put in it."""

import math
import random

import bpy
from mathutils import Matrix, Vector

from . import materials as m
from . import palette


class Stage:
    """An empty Cycles scene and the means to fill it."""

    def __init__(self, rng, library, aside=None):
        self.rng, self.library = rng, library
        self.aside = aside or random.Random("aside")  # for draws that came later, and leave others as they were
        self.scene = bpy.context.scene
        self.taken = []  # occupied rectangles of the ground plan: (x0, y0, x1, y1)
        self.tops = []  # objects with a surface to put things on
        self.interest = []  # points worth looking at
        self.backdrop = True  # whether things on a table have one
        self.defocus = 0.3  # share of cameras with depth of field
        self.least_covered = 0.4  # share of a crop that surfaces cover: the sky alone teaches nothing
        self.dark = False  # whether most of the frame may be black
        self.panorama = False  # whether the camera sees all around
        self._imported = {}

    def add(self, obj, material=None, at=(0, 0, 0), turn=0.0):
        """Links an object, gives it a material, a place and a turn about Z."""
        self.scene.collection.objects.link(obj)
        if material is not None:
            obj.data.materials.clear()
            obj.data.materials.append(material)
        matrix = Matrix.Translation(at) @ Matrix.Rotation(turn, 4, "Z")
        obj.matrix_world = matrix @ obj.matrix_basis
        return obj

    def model(self, model):
        """Imports a model once and returns a new copy standing at the origin."""
        if model.path not in self._imported:
            before = set(bpy.data.objects)
            try:
                bpy.ops.import_scene.gltf(filepath=model.path)
            except RuntimeError as error:
                raise ValueError(f"{model.path}: {error}; take it out of --assets") from error
            new = [o for o in bpy.data.objects if o not in before]
            for obj in new:
                if obj.type != "MESH":
                    bpy.data.objects.remove(obj)
            meshes = [o for o in bpy.data.objects if o not in before]
            for obj in meshes:
                matrix = obj.matrix_world.copy()
                obj.parent = None
                obj.matrix_world = matrix
            self._vary_materials(meshes)
            for obj in meshes:
                for collection in list(obj.users_collection):
                    collection.objects.unlink(obj)
            self._imported[model.path] = meshes
        parts = self._imported[model.path]
        if not parts:
            raise ValueError(f"{model.path} holds no mesh; take it out of --assets")
        copies = [part.copy() for part in parts]
        for copy in copies:
            self.scene.collection.objects.link(copy)
        return Group(copies)

    def files(self):
        """The files of everything that was put into the scene: models, textures, environments, pictures."""
        images = [
            bpy.path.abspath(image.filepath)
            for image in bpy.data.images
            if image.source == "FILE" and image.filepath
        ]
        return sorted({*self._imported, *images})

    def _vary_materials(self, meshes):
        """Now and then a part of a model gets another material, or another gloss."""
        rng = self.rng
        slots = [slot for obj in meshes for slot in obj.material_slots if slot.material]
        if slots and rng.random() < 0.2:
            rng.choice(slots).material = palette.anything(rng, self.library)
        for slot in slots:
            shader = m.principled_of(slot.material)
            if shader is None or rng.random() < 0.5:
                continue
            if not shader.inputs["Roughness"].is_linked:
                shader.inputs["Roughness"].default_value = rng.uniform(0.05, 0.9)
            if rng.random() < 0.25:
                shader.inputs["Coat Weight"].default_value = rng.uniform(0.3, 1.0)

    def free(self, box):
        """Whether a rectangle of the ground plan is empty."""
        x0, y0, x1, y1 = box
        return not any(x0 < b[2] and x1 > b[0] and y0 < b[3] and y1 > b[1] for b in self.taken)

    def drop(self, x, y, start):
        """Height of what lies below (x, y, start), None over nothing."""
        bpy.context.view_layer.update()
        hit, point, normal, *_ = self.scene.ray_cast(bpy.context.evaluated_depsgraph_get(), (x, y, start), (0, 0, -1))
        return point.z if hit and normal.z > 0.9 else None

    def clear_ray(self, origin, direction, distance):
        """Whether nothing stands within `distance`."""
        hit, *_ = self.scene.ray_cast(bpy.context.evaluated_depsgraph_get(), origin, direction, distance=distance)
        return not hit

    def lamp(self, kind, at, energy, color=(1, 1, 1), aim=None, **properties):
        """A Blender light; `aim` is the point it looks at."""
        data = bpy.data.lights.new(kind.lower(), kind)
        data.energy, data.color = energy, color
        for name, value in properties.items():
            setattr(data, name, value)
        obj = bpy.data.objects.new(kind.lower(), data)
        self.scene.collection.objects.link(obj)
        obj.location = at
        if aim is not None:
            obj.rotation_euler = (Vector(aim) - Vector(at)).to_track_quat("-Z", "Y").to_euler()
        return obj

    def camera(self, at, target, lens=None):
        """Places the scene's camera; depth of field and motion blur come from `lens_effects`."""
        scene = self.scene
        if scene.camera is None:
            scene.camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
            scene.collection.objects.link(scene.camera)
        camera = scene.camera
        camera.location = at
        camera.rotation_euler = (Vector(target) - Vector(at)).to_track_quat("-Z", "Y").to_euler()
        camera.data.lens = lens or self.rng.uniform(22, 50)
        camera.data.clip_start = 0.01
        return camera


class Group:
    """Copies of a model's objects that move as one."""

    def __init__(self, objects):
        self.objects = objects
        bpy.context.view_layer.update()
        corners = [o.matrix_world @ Vector(c) for o in objects for c in o.bound_box]
        self.low = Vector((min(c[i] for c in corners) for i in range(3)))
        self.high = Vector((max(c[i] for c in corners) for i in range(3)))

    @property
    def size(self):
        return self.high - self.low

    def transform(self, matrix):
        for obj in self.objects:
            obj.matrix_world = matrix @ obj.matrix_world

    def place(self, at, turn=0.0, scale=1.0):
        """Stands the group's base centre at a point."""
        base = Vector(((self.low.x + self.high.x) / 2, (self.low.y + self.high.y) / 2, self.low.z))
        self.transform(Matrix.Translation(at) @ Matrix.Rotation(turn, 4, "Z") @ Matrix.Scale(scale, 4) @ Matrix.Translation(-base))
        return self

    def remove(self):
        for obj in self.objects:
            bpy.data.objects.remove(obj)


def environment(stage, words, strength, without=()):
    """An HDRI of the library turned at random, or a sky, as the world."""
    rng, scene = stage.rng, stage.scene
    world = scene.world or bpy.data.worlds.new("world")
    scene.world = world
    if world.node_tree is None:
        world.use_nodes = True
    tree = world.node_tree
    tree.nodes.clear()
    output = tree.nodes.new("ShaderNodeOutputWorld")
    background = tree.nodes.new("ShaderNodeBackground")
    background.inputs["Strength"].default_value = strength
    tree.links.new(background.outputs[0], output.inputs["Surface"])
    found = stage.library.environments_like(*words, without=without)
    # Where it is not to be night, now and then a sky that is computed, with its sun.
    if not found or "night" in without and stage.aside.random() < 0.2:
        _sky(rng, tree, background, strength)
        return world
    texture = tree.nodes.new("ShaderNodeTexEnvironment")
    texture.image = bpy.data.images.load(rng.choice(found), check_existing=True)
    mapping = tree.nodes.new("ShaderNodeMapping")
    mapping.inputs["Rotation"].default_value = (0, 0, rng.uniform(0, 2 * math.pi))
    tree.links.new(tree.nodes.new("ShaderNodeTexCoord").outputs["Generated"], mapping.inputs[0])
    tree.links.new(mapping.outputs[0], texture.inputs[0])
    tree.links.new(texture.outputs[0], background.inputs["Color"])
    return world


def _sky(rng, tree, background, strength):
    sky = tree.nodes.new("ShaderNodeTexSky")
    kinds = [item.identifier for item in sky.bl_rna.properties["sky_type"].enum_items]
    sky.sky_type = "NISHITA" if "NISHITA" in kinds else "MULTIPLE_SCATTERING"
    sky.sun_elevation = math.radians(rng.uniform(4, 60))
    sky.sun_rotation = rng.uniform(0, 2 * math.pi)
    sky.sun_disc = rng.random() < 0.6
    background.inputs["Strength"].default_value = strength * 0.15
    tree.links.new(sky.outputs[0], background.inputs["Color"])


def darkness(stage, level=0.0):
    """A world of one dim colour: night, or a closed room."""
    scene = stage.scene
    world = scene.world or bpy.data.worlds.new("world")
    scene.world = world
    if world.node_tree is None:
        world.use_nodes = True
    tree = world.node_tree
    tree.nodes.clear()
    output = tree.nodes.new("ShaderNodeOutputWorld")
    background = tree.nodes.new("ShaderNodeBackground")
    background.inputs["Color"].default_value = (*m.color(stage.rng, (0.2, 0.7), (0.4, 0.8)), 1)
    background.inputs["Strength"].default_value = level
    tree.links.new(background.outputs[0], output.inputs["Surface"])
