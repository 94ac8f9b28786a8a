"""Runs the export where Blender 5 cannot write: pixels that are not square, in one part a pass.

Arguments: the scripts' folder, then those of the export.
"""

import sys

sys.path.insert(0, sys.argv.pop(1))
import export_passes
from demc_blender import rendering

set_output = rendering.set_output


def in_one_part_a_pass(edits, scene, full_float):
    set_output(edits, scene, full_float)
    scene.render.image_settings.use_exr_interleave = False


rendering.set_output = in_one_part_a_pass
export_passes.main()
