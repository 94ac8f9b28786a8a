"""Writes a game's data folder with two tracks: make_track.py DIR. One is a courtyard of two walls, the
other's mesh is damaged."""

import os
import struct
import sys

import bpy
import numpy as np

WALLS = [((-20, 0, 20), (20, 0, 20), (20, 8, 20), (-20, 8, 20)), ((-20, 0, -20), (20, 0, -20), (20, 8, -20), (-20, 8, -20)),
         ((-20, 0, -20), (20, 0, -20), (20, 0, 20), (-20, 0, 20))]


def spm(textures, quads):
    """A mesh file of quadrangles in the game's axes, Y up, one material each: normals, and colours for the
    first corner alone."""
    data = b"SP" + bytes([1 << 3, 0b011]) + struct.pack("<6f", *[0.0] * 6) + struct.pack("<H", len(textures))
    data += b"".join(bytes([len(name)]) + name.encode() + b"\0" for name in textures)
    data += struct.pack("<HH", 1, len(quads))
    for material, quad in enumerate(quads):
        data += struct.pack("<IiH", 4, 6, material)
        for n, (corner, uv) in enumerate(zip(quad, ((0, 0), (1, 0), (1, 1), (0, 1)))):
            data += struct.pack("<3fI", *corner, 511 << 10)
            data += struct.pack("<4B", 0, 255, 128, 0) if n == 0 else b"\x80"
            data += struct.pack("<2e", *uv)
        data += struct.pack("<6B", 0, 1, 2, 0, 2, 3)
    return data + bytes(24)


def write(path, content):
    os.makedirs(os.path.dirname(path), exist_ok=True)
    with open(path, "wb") as file:
        file.write(content if isinstance(content, bytes) else content.encode())


data = sys.argv[-1]
yard, broken = (os.path.join(data, "tracks", name) for name in ("yard", "broken"))
write(os.path.join(yard, "yard_track.spm"), spm(["wall.png", "glow.png", "wall.png"], WALLS))
write(os.path.join(yard, "scene.xml"), """<scene>
  <track model="yard_track.spm" x="0" y="0" z="0">
    <static-object model="yard_track.spm" xyz="0 0 90" hpr="0 90 0" scale="1 2 1"/>
    <static-object model="yard_track.spm" xyz="0 0 0" interaction="physics-only"/>
  </track>
  <library name="lantern" id="a" xyz="3 1 4" hpr="0 0 0" scale="1 1 1"/>
  <sun xyz="10 20 0" sun-diffuse="255 200 100" ambient="90 90 90"/>
</scene>""")
write(os.path.join(yard, "materials.xml"), '<materials><material name="glow.png" shader="additive"/></materials>')
write(os.path.join(yard, "quads.xml"), '<quads><quad p0="-2 0 -2" p1="2 0 -2" p2="2 0 2" p3="-2 0 2"/><quad p0="0:3" p1="0:2" p2="2 0 6" p3="-2 0 6"/></quads>')
write(os.path.join(data, "library", "lantern", "node.xml"), '<scene><light xyz="0 2 0" distance="10" energy="2" color="255 0 0"/></scene>')
write(os.path.join(broken, "broken_track.spm"), b"no mesh")
write(os.path.join(broken, "scene.xml"), '<scene><track model="broken_track.spm"/></scene>')
image = bpy.data.images.new("wall", 64, 64)
image.pixels.foreach_set(np.tile(np.float32([0.8, 0.4, 0.2, 1.0]), 64 * 64))
image.filepath_raw, image.file_format = os.path.join(yard, "wall.png"), "PNG"
image.save()
