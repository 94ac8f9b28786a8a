"""Makes .blend scenes for generate_scenes.py --blend out of SuperTuxKart's tracks.

    python import_tracks.py --out DIR [--hdri DIR] DATA

Debian's supertuxkart-data (mostly CC-BY-SA) holds some 40 tracks under DATA/tracks, modelled by artists:
villages, temples, forests, caves, castles. Each becomes DIR/NAME.blend: its meshes, what it takes from
DATA/library, its lights and sun, an environment of --hdri that suits its hour, and cameras where karts drive.
Tracks that are there are skipped, those that cannot be read are named and left out.
"""

import argparse
import math
import os
import random
import struct
import sys
import xml.etree.ElementTree as ElementTree

import bpy
import numpy as np
from mathutils import Color, Euler, Matrix, Vector

sys.path.insert(0, os.path.dirname(os.path.abspath(bpy.path.abspath(__file__))))

from demc_blender import command_line as cl
from demc_scenes.assets import Library, shrink
from demc_scenes.blends import distance_ahead
from demc_scenes.materials import Nodes

_CAMERAS = 24
# Shaders of what is no surface: glows, and air that shimmers. (Water is called "displace" as well.)
_UNSEEN = ("additive",)
# What a word in a texture's name says of its gloss: roughness and metalness.
_GLOSS = ((("water", "ice", "glass", "ocean", "lake"), 0.05, 0.0), (("metal", "steel", "iron", "gold", "copper", "chrome"), 0.25, 1.0),
          (("tile", "marble", "floor", "wood", "parquet", "door", "paint"), 0.3, 0.0))
_ROUGH = 0.7


def parse(arguments):
    """The command line."""
    parser = argparse.ArgumentParser(prog="import_tracks.py", description="Make .blend scenes of SuperTuxKart's tracks.")
    parser.add_argument("--out", required=True, metavar="DIR", help="folder for the scenes")
    parser.add_argument("--hdri", metavar="DIR", help="assets folder whose hdri/ lights the tracks (default: the track's own ambient light)")
    parser.add_argument("data", type=cl.folder, metavar="DATA", help="the game's data folder")
    return parser.parse_args(arguments)


class Reader:
    """Little-endian values of a file, one after the other."""

    def __init__(self, path):
        with open(path, "rb") as file:
            self.data = file.read()
        self.at = 0

    def take(self, form):
        values = struct.unpack_from("<" + form, self.data, self.at)
        self.at += struct.calcsize("<" + form)
        return values if len(values) > 1 else values[0]

    def text(self):
        """A string behind its length."""
        length = self.take("B")
        self.at += length
        return self.data[self.at - length:self.at].decode("utf-8", "replace")


class Spm:
    """A mesh file, version 1: `textures`, names of one or two per material, and arrays per vertex in
    Blender's axes."""

    def __init__(self, path):
        reader = Reader(path)
        magic, kind, holds = reader.take("2s2B")
        if magic != b"SP" or kind >> 3 != 1:
            raise ValueError(f"{path} is no mesh of version 1")
        self.normals, colours, tangents, skinned = holds & 1, holds >> 1 & 1, holds >> 2 & 1, kind & 7 == 1
        reader.at += 24  # the bounds
        self.textures = [(reader.text(), reader.text()) for _ in range(reader.take("H"))]
        vertices, faces, of_face = [], [], []
        for _ in range(reader.take("H")):
            for _ in range(reader.take("H")):
                count, indices, material = reader.take("IiH")
                first = len(vertices)
                uvs = sum(bool(name) for name in self.textures[material])
                for _ in range(count):
                    vertices.append(self._vertex(reader, colours, tangents, skinned, uvs))
                form = "I" if count > 65535 else "H" if count > 255 else "B"
                triangles = np.frombuffer(reader.data, "<" + form.replace("I", "u4").replace("H", "u2").replace("B", "u1"), indices, reader.at)
                reader.at += triangles.nbytes
                # Mirrored with the axes.
                faces.append(triangles.reshape(-1, 3)[:, ::-1].astype(np.int32) + first)
                of_face += [material] * len(faces[-1])
            if kind & 7 == 0:
                reader.at += 24  # bounds of the sector
        self.vertices = np.array(vertices, np.float32).reshape(-1, 13)
        self.faces = np.concatenate(faces) if faces else np.zeros((0, 3), np.int32)
        self.of_face = np.array(of_face, np.int32)

    def _vertex(self, reader, colours, tangents, skinned, uvs):
        """Place, normal, colour and two texture coordinates: 13 numbers."""
        x, y, z = reader.take("3f")
        normal, colour, uv = (0.0, 0.0, 1.0), (1.0, 1.0, 1.0), [0.0] * 4
        if self.normals:
            packed = reader.take("I")
            a, b, c = (((packed >> shift & 1023) ^ 512) - 512 for shift in (0, 10, 20))
            normal = (a / 511, c / 511, b / 511)
        if colours and reader.take("B") != 128:  # 128: white, and no more said
            colour = tuple(v / 255 for v in reader.take("3B"))
        if uvs:
            for n in range(uvs):
                uv[2 * n:2 * n + 2] = reader.take("2e")
            if tangents and self.normals:
                reader.at += 4
        if skinned:
            reader.at += 16
        return (x, z, y, *normal, *colour, uv[0], 1 - uv[1], uv[2], 1 - uv[3])


class Track:
    """A track under construction in the open scene."""

    def __init__(self, data, name, library):
        self.data, self.folder, self.library = data, os.path.join(data, "tracks", name), library
        self.rng = random.Random(f"track {name}")
        self.scene = bpy.context.scene
        self.meshes, self.materials = {}, {}
        self.described = [(os.path.join(data, "textures"), described(os.path.join(data, "textures")))]
        self.nearest = {}  # the finest model of each group of levels of detail
        self.root = ElementTree.parse(os.path.join(self.folder, "scene.xml")).getroot()

    def build(self):
        """Everything the track shows."""
        self.add_scene(self.root, self.folder, Matrix())
        self.add_sun(self.root.find("sun"))
        if not any(o.type == "MESH" for o in self.scene.objects):
            raise ValueError(f"{self.folder} shows nothing")
        self.add_cameras()

    def add_scene(self, root, folder, base):
        """The objects and lights that a scene.xml or node.xml tells of."""
        self.described.append((folder, described(folder)))
        for group in root.iter("group"):
            models = sorted(group, key=lambda e: float(e.get("lod_distance", "0")))
            if models:
                self.nearest[group.get("name")] = models[0].get("model")
        for element in root.iter():
            if element.get("interaction") == "physics-only" or "Reverse" in element.get("if", "").replace("NotReverse", ""):
                continue
            if element.tag == "track":
                self.add_model(folder, element.get("model"), base @ Matrix.Translation([float(element.get(axis, "0")) for axis in "xzy"]))
            elif element.tag in ("static-object", "object"):
                grouped = element.get("lod_group")
                if grouped and not element.get("lod_instance"):
                    continue  # what instances of the group are made of
                self.add_model(folder, self.nearest.get(grouped) if grouped else element.get("model"), base @ placed(element))
            elif element.tag == "library":
                self.add_library(element.get("name", ""), base @ placed(element))
            elif element.tag == "light":
                self.add_light(element, base)
        self.described.pop()

    def add_library(self, name, base):
        folder = os.path.join(self.data, "library", name)
        path = os.path.join(folder, "node.xml")
        if name.startswith("gfx_") or not os.path.exists(path):
            return
        self.add_scene(ElementTree.parse(path).getroot(), folder, base)

    def add_model(self, folder, name, matrix):
        """An object of a mesh file, which all objects of that file share."""
        path = os.path.join(folder, name or "")
        if not path.endswith(".spm") or not os.path.exists(path):
            return
        if path not in self.meshes:
            self.meshes[path] = self.mesh(path)
        if self.meshes[path] is not None:
            obj = bpy.data.objects.new(os.path.splitext(name)[0], self.meshes[path])
            obj.matrix_world = matrix
            self.scene.collection.objects.link(obj)

    def mesh(self, path):
        """The mesh of a file without what nobody sees, None where that leaves nothing."""
        spm = Spm(path)
        materials = [self.material(*names) for names in spm.textures]
        seen = np.array([m is not None for m in materials], bool)[spm.of_face] if len(spm.of_face) else np.zeros(0, bool)
        seen &= (spm.faces != np.roll(spm.faces, 1, 1)).all(1)  # slivers of two corners crash Blender
        faces, of_face = spm.faces[seen], spm.of_face[seen]
        if not len(faces):
            return None
        mesh = bpy.data.meshes.new(os.path.basename(path))
        mesh.from_pydata(spm.vertices[:, :3], [], faces)
        for material in materials:
            mesh.materials.append(material)
        mesh.polygons.foreach_set("material_index", of_face)
        corners = faces.ravel()
        for n in range(2):
            layer = mesh.uv_layers.new(name=f"uv{n}")
            layer.data.foreach_set("uv", spm.vertices[corners, 9 + 2 * n:11 + 2 * n].ravel())
        colours = mesh.color_attributes.new("colour", "FLOAT_COLOR", "POINT")
        colours.data.foreach_set("color", np.concatenate([spm.vertices[:, 6:9], np.ones((len(spm.vertices), 1))], 1).astype(np.float32).ravel())
        mesh.polygons.foreach_set("use_smooth", np.ones(len(faces), bool))
        mesh.update()
        if spm.normals:
            mesh.normals_split_custom_set_from_vertices(spm.vertices[:, 3:6])
        return mesh

    def material(self, name, decal):
        """The material of a texture and what is stuck on it; None for what is no surface."""
        look, folder = self.look(name)
        if look.get("shader") in _UNSEEN:
            return None
        key = (folder, name, decal)
        if key not in self.materials:
            self.materials[key] = self.new_material(name, decal, look)
        return self.materials[key]

    def look(self, name):
        """What the nearest materials.xml says of a texture, and the folder of that."""
        for folder, looks in reversed(self.described):
            if name in looks:
                return looks[name], folder
        return {}, self.described[-1][0]

    def new_material(self, name, decal, look):
        nodes = Nodes(name or "plain")
        colour, alpha = (0.6, 0.6, 0.6), 1.0
        texture = self.texture(nodes, name, "uv0")
        if texture is not None:
            colour = texture.outputs[0]
            if look.get("shader") in ("alphatest", "alphablend", "grass"):
                mask = self.texture(nodes, look.get("mask", ""), "uv0")
                alpha = texture.outputs[1] if mask is None else mask.outputs[0]
        sticker = self.texture(nodes, decal, "uv1")
        if sticker is not None:
            colour = nodes.mix(sticker.outputs[1], colour, sticker.outputs[0])
        colour = nodes.mix(1.0, colour, nodes.new("ShaderNodeVertexColor", layer_name="colour").outputs[0], "MULTIPLY")
        plain = name.lower()
        roughness, metallic = next((values for words, *values in _GLOSS if any(word in plain for word in words)), (_ROUGH, 0.0))
        inputs = {"Base_Color": colour, "Alpha": alpha, "Metallic": metallic, "Roughness": min(1.0, roughness * math.exp(self.rng.gauss(0, 0.3)))}
        if look.get("shader") == "unlit":
            inputs.update(Emission_Color=colour, Emission_Strength=3.0)
        relief = self.texture(nodes, look.get("normal-map", ""), "uv0", data=True)
        if relief is not None:
            inputs["Normal"] = nodes.shader("ShaderNodeNormalMap", Color=relief.outputs[0], Strength=1.0)
        nodes.set(nodes.output.inputs[0], nodes.shader("ShaderNodeBsdfPrincipled", **inputs))
        return nodes.material

    def texture(self, nodes, name, uv, data=False):
        """A texture's node, None where there is no such image."""
        image = self.image(name, data) if name else None
        if image is None:
            return None
        node = nodes.new("ShaderNodeTexImage", image=image)
        nodes.set(node.inputs[0], nodes.new("ShaderNodeUVMap", uv_map=uv).outputs[0])
        return node

    def image(self, name, data):
        """An image of the innermost folder that has it."""
        for folder, _ in reversed(self.described):
            path = os.path.join(folder, name)
            if os.path.exists(path):
                image = bpy.data.images.load(path, check_existing=True)
                if image.packed_file is None:
                    if 0 in image.size:
                        bpy.data.images.remove(image)
                        return None
                    shrink(image)
                    image.pack()
                if data:
                    image.colorspace_settings.name = "Non-Color"
                return image
        return None

    def add_light(self, element, base):
        data = bpy.data.lights.new("lamp", "POINT")
        # The game's lights end at a distance: as bright there as a lamp of this power is.
        data.energy = 5.0 * float(element.get("energy", "1")) * float(element.get("distance", "10"))
        data.color = colour_of(element.get("color"))
        data.shadow_soft_size = self.rng.uniform(0.05, 0.4)
        lamp = bpy.data.objects.new("lamp", data)
        lamp.location = (base @ placed(element)).translation
        self.scene.collection.objects.link(lamp)

    def add_sun(self, element):
        """The sun, and the environment that suits it."""
        colour = colour_of(element.get("sun-diffuse") if element is not None else None)
        ambient = colour_of(element.get("ambient") if element is not None else None)
        night = max(colour) < 0.5 or colour.b > 1.5 * colour.r
        data = bpy.data.lights.new("sun", "SUN")
        data.color, data.energy = colour, self.rng.uniform(0.2, 0.6) if night else self.rng.uniform(2, 5)
        data.angle = math.radians(self.rng.uniform(0.3, 4))
        sun = bpy.data.objects.new("sun", data)
        place = vector_of(element.get("xyz")) if element is not None else Vector((1, 1, 2))
        sun.rotation_euler = place.to_track_quat("Z", "Y").to_euler()
        self.scene.collection.objects.link(sun)
        world = bpy.data.worlds.new("world")
        if world.node_tree is None:  # before Blender 5
            world.use_nodes = True
        self.scene.world = world
        background = world.node_tree.nodes["Background"]
        background.inputs["Color"].default_value = (*ambient, 1)
        background.inputs["Strength"].default_value = 0.3 if night else 1.0
        words = ("night",) if night else ("sunny", "sky", "forest", "dawn", "sunset", "mountain")
        environments = self.library.environments_like(*words, without=() if night else ("night", "indoor", "room"))
        if environments:
            texture = world.node_tree.nodes.new("ShaderNodeTexEnvironment")
            texture.image = bpy.data.images.load(self.rng.choice(environments), check_existing=True)
            texture.image.pack()
            world.node_tree.links.new(texture.outputs[0], background.inputs["Color"])

    def add_cameras(self):
        """Cameras over the road, or over where karts start, looking to any side where something stands."""
        places = self.driven() or [vector_of(f"{e.get('x', 0)} {e.get('y', 0)} {e.get('z', 0)}") for e in self.root.iter("start")]
        if not places:
            raise ValueError(f"{self.folder} tells no place to look from")
        bpy.context.view_layer.update()
        for n in range(_CAMERAS):
            place = places[n * len(places) // _CAMERAS]
            for _ in range(20):
                at = place + Vector((self.rng.gauss(0, 2), self.rng.gauss(0, 2), self.rng.uniform(0.7, 4)))
                turn = Euler((math.radians(90 + self.rng.gauss(-1, 7)), 0, self.rng.uniform(0, 2 * math.pi)))
                ahead = distance_ahead(self.scene, at, turn.to_matrix() @ Vector((0, 0, -1)))
                if ahead is not None and 5 < ahead < 50:
                    break
            else:
                continue
            data = bpy.data.cameras.new("camera")
            data.lens = self.rng.uniform(22, 50)
            data.clip_start, data.clip_end = 0.05, 5000
            camera = bpy.data.objects.new("camera", data)
            camera.location = at
            camera.rotation_euler = turn
            self.scene.collection.objects.link(camera)
            self.scene.camera = self.scene.camera or camera
        if self.scene.camera is None:
            raise ValueError(f"{self.folder} has nothing to see from where karts drive")

    def driven(self):
        """Middles of the quadrangles that karts drive over."""
        path = os.path.join(self.folder, "quads.xml")
        if not os.path.exists(path):
            return []
        corners, middles = [], []
        for quad in ElementTree.parse(path).getroot().iter("quad"):
            points = [quad.get(f"p{n}", "") for n in range(4)]
            corners.append([corners[int(p.split(":")[0])][int(p.split(":")[1])] if ":" in p else vector_of(p) for p in points])
            middles.append(sum(corners[-1], Vector()) / 4)
        return middles


def described(folder):
    """Texture -> attributes, of a folder's materials.xml."""
    path = os.path.join(folder, "materials.xml")
    if not os.path.exists(path):
        return {}
    return {element.get("name"): element.attrib for element in ElementTree.parse(path).getroot().iter("material")}


def vector_of(text):
    """"x y z" of the game, whose y is up, in Blender's axes."""
    x, y, z = (float(v) for v in (text or "0 0 0").split())
    return Vector((x, z, y))


def colour_of(text):
    """"r g b" up to 255 as the linear colour it stands for; white without."""
    return Color([float(v) / 255 for v in (text or "255 255 255").split()]).from_srgb_to_scene_linear()


def placed(element):
    """An element's place, turn and size as a matrix."""
    turn = [math.radians(-v) for v in vector_of(element.get("hpr"))]
    rotation = Euler((turn[0], turn[1], turn[2]), "XZY").to_matrix().to_4x4()
    size = vector_of(element.get("scale") or "1 1 1")
    return Matrix.Translation(vector_of(element.get("xyz"))) @ rotation @ Matrix.Diagonal((*size, 1))


def main():
    """Entry point of the script."""
    options = parse(cl.script_arguments())
    cl.quiet_stdout()
    library = Library([options.hdri] if options.hdri else [])
    cl.make_folder(options.out)
    failed = made = 0
    for name in sorted(os.listdir(os.path.join(options.data, "tracks"))):
        target = os.path.join(os.path.abspath(options.out), f"{name}.blend")
        if not os.path.exists(os.path.join(options.data, "tracks", name, "scene.xml")) or os.path.exists(target):
            continue
        try:
            bpy.ops.wm.read_factory_settings(use_empty=True)
            bpy.context.scene.render.engine = "CYCLES"
            Track(options.data, name, library).build()
            bpy.ops.wm.save_as_mainfile(filepath=target, compress=True)
            made += 1
            print(f"{name}: {len(bpy.data.objects)} objects, {len(bpy.data.materials)} materials")
        except Exception as error:  # one bad track must not cost the others
            failed += 1
            if os.environ.get("DEMC_TRACEBACK"):
                raise
            print(f"{name}: left out, {cl.reason(error)}")
    print(f"{made} tracks in {options.out}, {failed} left out")
    cl.finish(failed)


if __name__ == "__main__":
    main()
