"""Builds one scene of every kind without assets and places its camera; prints `kind meshes`.

Argument: the scripts' folder.
"""

import random
import sys

import bpy

sys.path.insert(0, sys.argv[1])
from demc_scenes.assets import Library
from demc_scenes.kinds import KINDS
from demc_scenes.stage import Stage

for kind, (build, _) in KINDS.items():
    bpy.ops.wm.read_factory_settings(use_empty=True)
    camera = None
    place = build(Stage(random.Random(f"test {kind}"), Library()))
    for _ in range(3):
        camera = camera or place()
    assert camera is not None, f"{kind}: no place for a camera"
    print("KIND", kind, sum(o.type == "MESH" for o in bpy.context.scene.objects))
