"""Joins the references of a development set from made-up parts whose noise is known; prints what comes out.

Arguments: the scripts' folder, a folder for the set. Every part is a grey of 0.5 with noise of a standard
deviation of 0.1, and the render at Blender's defaults of one of 0.05; one pixel is brighter than half floats can be.
"""

import os
import sys

import numpy as np

sys.path.insert(0, sys.argv[1])
import development_set as development
from demc_blender import exr

folder = sys.argv[2]
os.makedirs(os.path.join(folder, "parts"))
table, view, draw = development.Table(folder), development.VIEWS[0], np.random.default_rng(1)


def render(file, spread, spp, seed):
    planes = {f"ViewLayer.Combined.{c}": draw.normal(0.5, spread, (60, 80)).astype("f4") for c in "RGB"}
    for plane in planes.values():
        plane[0, 0] = 1e6
    write = exr.write_float if spp == development._PART_MOST else exr.write_half
    write(os.path.join(folder, file), planes)
    table.record(view, file, spp, seed, 10.0)


def show(file):
    planes = exr.read(os.path.join(folder, file))
    row = table.rows()[file]
    values = np.stack([planes[f"ViewLayer.Combined.{c}"].ravel() for c in "RGB"])
    spread, sun = np.std(values[:, 1:]), values[0, 0]
    print("REFERENCE", file, row["noise_seed"], row["seconds"], row["noise"], f"{spread ** 2 / 0.251:.3g}", sun)


render(view.noisy(4, 0), 0.3, 4, 0)
for which in "ab":
    render(view.part(which), 0.1, 512, which)
development.join(table, view, "ab")
show(view.reference)
for which in "cd":
    render(view.part(which), 0.1, 512, which)
render(view.noisy(4096, 0), 0.05, 4096, 0)
development.join(table, view, "abcd")
show(view.reference)
show(view.adaptive_reference)
