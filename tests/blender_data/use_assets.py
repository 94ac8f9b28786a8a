"""Says what generate_scenes.py finds in assets folders: use_assets.py SCRIPTS FOLDER..."""

import random
import sys

sys.path.insert(0, sys.argv[1])

import bpy
from demc_blender import command_line as cl
from demc_scenes.assets import Library
from demc_scenes.materials import principled_of
from demc_scenes.stage import Stage

cl.quiet_stdout()
library = Library(sys.argv[2:])
bpy.ops.wm.read_factory_settings(use_empty=True)
for model in library.models:
    group = Stage(random.Random(1), library).model(model)
    size, base = " ".join(f"{v:.2f}" for v in group.size), f"{group.low.z:.2f}"
    # From the lowest part to the highest.
    parts = sorted(group.objects, key=lambda o: sum((o.matrix_world @ v.co).z for v in o.data.vertices))
    shaders = [principled_of(part.material_slots[0].material) for part in parts]
    looks = ("clear" if s.inputs["Transmission Weight"].default_value > 0.9 else "solid" for s in shaders)
    print(f"MODEL {model.name} {model.role} {size} from {base}: {' '.join(looks)}")
for kind, sets in library.textures.items():
    print(f"TEXTURE {kind} {len(sets)} {max(bpy.data.images.load(sets[0]['color']).size)}")
