"""Writes a furniture library of Sweet Home 3D and a folder of images: make_furniture.py FOLDER.

The library holds a table, drawn upside down, with a glass top, a model whose file is empty, and one of
unknown depth.
"""

import sys
import zipfile
from pathlib import Path

import bpy

folder = Path(sys.argv[1])
CATALOGUE = """id=test
name=Test library
license=CC0
id#1=Test maker#lowTable
name#1=Low table
category#1=Living room
model#1=/test/table.obj
width#1=120
depth#1=60
height#1=45
modelRotation#1=1 0 0 0 -1 0 0 0 -1
creator#1=Somebody
id#2=Test maker#nothing
name#2=Nothing
model#2=/test/nothing.obj
width#2=10
depth#2=10
height#2=10
id#3=Test maker#flat
name#3=Flat
model#3=/test/flat.obj
width#3=10
height#3=10
"""


def box(low, high):
    """Vertices and faces of a box, as OBJ text."""
    corners = [(x, y, z) for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])]
    faces = ("1 2 4 3", "5 7 8 6", "1 5 6 2", "3 4 8 7", "1 3 7 5", "2 6 8 4")
    return corners, faces


top, foot = box((0, 0, 9), (12, 6, 10)), box((5, 2, 0), (7, 4, 9))
text = "mtllib table.mtl\n"
for i, (material, (corners, faces)) in enumerate((("glass", top), ("oak", foot))):
    # Up is towards -Y in the file, which the rotation of the catalogue undoes.
    text += f"o part{i}\n" + "".join(f"v {x} {-z} {y}\n" for x, y, z in corners) + f"usemtl {material}\n"
    text += "".join("f " + " ".join(str(int(v) + 8 * i) for v in face.split()) + "\n" for face in faces)
MATERIALS = "newmtl glass\nKd 0.8 0.9 0.8\nd 0.2\nillum 2\nnewmtl oak\nKd 0.4 0.2 0.1\nNs 20\nillum 2\n"
with zipfile.ZipFile(folder / "library.sh3f", "w") as archive:
    archive.writestr("PluginFurnitureCatalog.properties", CATALOGUE)
    archive.writestr("test/table.obj", text)
    archive.writestr("test/table.mtl", MATERIALS)
    archive.writestr("test/nothing.obj", "")

images = folder / "images"
images.mkdir()
for name, size in (("old_brick.png", 1024), ("brick_normal.png", 128), ("brick_tiny.png", 16), ("portrait.png", 128)):
    image = bpy.data.images.new(name, size, size)
    image.file_format = "PNG"
    image.save(filepath=str(images / name))
(images / "brick_broken.jpg").write_bytes(b"no image")
