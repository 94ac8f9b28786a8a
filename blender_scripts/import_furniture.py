"""Makes an assets folder for generate_scenes.py out of Sweet Home 3D furniture libraries (.sh3f).

    python import_furniture.py --out DIR LIBRARY.sh3f ...

Debian's package sweethome3d-furniture holds five such libraries with 820 models of the Blend Swap community,
Scopia, Kator Legaz and Reallusion (CC0 or CC-BY 3.0). Each model becomes DIR/models/NAME.glb in the size its
catalogue states, standing on z = 0 and looking to -Y; models.tsv tells category, size, author and licence.
Models that are there are skipped, those that cannot be read are named and left out.
"""

import argparse
import csv
import logging
import os
import re
import sys
import tempfile
import zipfile

import bpy
from mathutils import Matrix, Vector

sys.path.insert(0, os.path.dirname(os.path.abspath(bpy.path.abspath(__file__))))

from demc_blender import command_line as cl
from demc_scenes.assets import shrink
from demc_scenes.materials import principled_of

_MOST_TRIANGLES = 250_000
_PROP_SIZE = 0.6  # metres; smaller furniture stands on furniture
_CATEGORIES = {"Characters": "figure", "Vehicles": "vehicle"}
_PLANTS = re.compile(r"plant|tree|palm|flower|bush|hedge|ficus|cactus|bamboo|pine|maple|cypress|fern|lily|acacia|beech|poplar|bonsai")
_Y_UP = Matrix(((1, 0, 0, 0), (0, 0, -1, 0), (0, 1, 0, 0), (0, 0, 0, 1)))  # the libraries' axes to Blender's
_NEEDED = ("id", "name", "width", "depth", "height")  # of a model's entry in a catalogue
_HEADER = ("name", "category", "size_m", "source", "author", "licence")


def parse(arguments):
    """The command line."""
    parser = argparse.ArgumentParser(prog="import_furniture.py", description="Make an assets folder of Sweet Home 3D furniture.")
    parser.add_argument("--out", required=True, metavar="DIR", help="assets folder to fill")
    parser.add_argument("libraries", type=cl.file, nargs="+", metavar="LIBRARY", help=".sh3f files")
    return parser.parse_args(arguments)


def catalogue(archive):
    """The library's own properties and its models' (a dictionary each)."""
    text = archive.read("PluginFurnitureCatalog.properties").decode("latin-1")
    library, models = {}, {}
    for key, value in re.findall(r"^([\w#]+)=(.*?)\s*$", text, re.MULTILINE):
        name, _, index = key.partition("#")
        (models.setdefault(int(index), {}) if index else library)[name] = value
    return library, [models[i] for i in sorted(models) if "model" in models[i]]


def name_and_category(model):
    """A file name, unique in all libraries, and the category that the generator goes by."""
    maker, _, plain = model["id"].partition("#")
    name = re.sub(r"\W+", "_", f"{maker}_{plain}".lower()).strip("_")
    words = f"{plain} {model['name']}".lower()
    if _PLANTS.search(words):
        return name, "plant"
    largest = max(dimensions(model))
    return name, _CATEGORIES.get(model.get("category"), "furniture" if largest > _PROP_SIZE else "prop")


def dimensions(model):
    """Width, depth and height in metres."""
    return [float(model[k]) / 100 for k in ("width", "depth", "height")]


def import_model(folder, model):
    """Loads a model alone into the scene, in its size and place."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    path = os.path.join(folder, model["model"].lstrip("/"))
    bpy.ops.wm.obj_import(filepath=path, forward_axis="Y", up_axis="Z")
    meshes = [o for o in bpy.data.objects if o.type == "MESH"]
    triangles = sum(len(p.vertices) - 2 for o in meshes for p in o.data.polygons)
    if not 0 < triangles <= _MOST_TRIANGLES:
        raise ValueError(f"{triangles} triangles")
    turned = [float(v) for v in model.get("modelRotation", "1 0 0 0 1 0 0 0 1").split()]
    rotation = Matrix([turned[0:3], turned[3:6], turned[6:9]]).to_4x4()
    for obj in meshes:
        obj.data.transform(_Y_UP @ rotation @ obj.matrix_world)
        obj.matrix_world = Matrix()
    corners = [v.co for o in meshes for v in o.data.vertices]
    low, high = (Vector(f(c[i] for c in corners) for i in range(3)) for f in (min, max))
    scale = Matrix.Diagonal([d / max(s, 1e-6) for d, s in zip(dimensions(model), high - low)]).to_4x4()
    base = Vector(((low.x + high.x) / 2, (low.y + high.y) / 2, low.z))
    for obj in meshes:
        obj.data.transform(scale @ Matrix.Translation(-base))
        obj.data.update()


def mend_materials():
    """What OBJ files cannot say: clear parts are glass, and textures are no larger than needed."""
    for image in bpy.data.images:
        shrink(image)
    for material in bpy.data.materials:
        shader = principled_of(material)
        if shader is None:
            continue
        alpha = shader.inputs["Alpha"]
        if not alpha.is_linked and alpha.default_value < 0.7:
            alpha.default_value = 1.0
            shader.inputs["Transmission Weight"].default_value = 1.0
            shader.inputs["Roughness"].default_value = 0.02
            if not shader.inputs["Base Color"].is_linked:
                tint = shader.inputs["Base Color"].default_value
                shader.inputs["Base Color"].default_value = [0.6 + 0.4 * c for c in tint[:3]] + [1.0]


def main():
    """Entry point of the script."""
    options = parse(cl.script_arguments())
    cl.quiet_stdout()
    logging.disable(logging.INFO)  # the glTF exporter tells every step
    models = os.path.join(options.out, "models")
    cl.make_folder(models)
    rows, failed = [], 0
    for path in options.libraries:
        with zipfile.ZipFile(path) as archive, tempfile.TemporaryDirectory() as folder:
            archive.extractall(folder)
            library, entries = catalogue(archive)
            source = library.get("name", os.path.splitext(os.path.basename(path))[0])
            licence = library.get("license")
            if licence is None:
                print(f"{path}: its catalogue names no licence")
            for model in entries:
                name = model["model"]
                try:
                    missing = [key for key in _NEEDED if key not in model]
                    if missing:
                        raise ValueError(f"its entry in the catalogue of {path} has no {', '.join(missing)}")
                    name, category = name_and_category(model)
                    target = os.path.join(models, f"{name}.glb")
                    if not os.path.exists(target):
                        import_model(folder, model)
                        mend_materials()
                        bpy.ops.export_scene.gltf(filepath=f"{target}.part.glb")
                        os.replace(f"{target}.part.glb", target)
                except Exception as error:  # one bad model must not cost the others
                    failed += 1
                    print(f"{name}: left out, {cl.reason(error)}")
                    continue
                rows.append((name, category, round(max(dimensions(model)), 3), source, model.get("creator", ""), licence or "not named"))
    with open(os.path.join(options.out, "models.tsv"), "w", encoding="utf-8", newline="") as file:
        csv.writer(file, delimiter="\t", lineterminator="\n", quoting=csv.QUOTE_NONE, quotechar=None).writerows([_HEADER, *rows])
    print(f"{len(rows)} models in {models}, {failed} left out")
    cl.finish(failed)


if __name__ == "__main__":
    main()
