"""The cases in which denoisers are known to fail: a small scene each, and why they fail there.

    build("caustic", hard=True)    the case
    build("caustic", hard=False)   its control: the same scene with the trouble off
"""

import random

import bpy

from . import hard_detail as detail
from . import hard_light as light
from .assets import Library
from .stage import Stage

# Name -> why denoisers fail there; the builder has the same name.
CASES = {
    "glass_ball": "Light through glass and off it is seen at once, and guides hold one of them, or noise.",
    "mirror": "What is mirrored has edges of its own, which guides show only where a mirror is smooth.",
    "caustic": "Few paths find light that glass and metal gather: its bright dots are taken for fireflies.",
    "thin_shadow": "Shadows as thin as a pixel are in no guide, and are blurred away as noise.",
    "many_lights": "Each sample sees one lamp of many: noise of all colours over many soft shadows.",
    "light_gap": "Light comes by a gap that few paths find: most samples are black, and some very bright.",
    "fog": "Haze brings noise into guides as into light, and hides edges that guides still show.",
    "fog_beam": "Beams in haze have edges where no surface is, and guides know nothing of them.",
    "hair": "Strands are thinner than a pixel: guides are as noisy as the light.",
    "foliage": "Each pixel holds edges of several leaves, which guides average, noise and all.",
    "subsurface": "Light from below a surface is smooth where guides have edges, and its noise is coloured.",
    "depth_of_field": "Guides of what is out of focus are noisy, and discs of light have sharp rims.",
    "motion_blur": "Guides mix what moves with what is behind it, and are noisy themselves.",
    "bump": "Normals are full of detail that even light hardly shows: it is printed onto the result.",
    "text": "Strokes of letters are a pixel wide, and are lost where noise is as strong as ink.",
    "text_through_glass": "Frosted glass hides the print from the guides but not from the eye.",
    "emissive": "Patterns that shine are free of noise amid noise, and light their surroundings.",
    "stars": "Lights smaller than a pixel look like fireflies, and are removed.",
    "snow": "Small bright flakes look like fireflies, in the light and in the guides.",
    "glints": "Ripples mirror the sun for a pixel or less: sparkle that is real and looks like fireflies.",
    "film_alpha": "Colour fades with alpha at edges: what bleeds there is a fringe once composited.",
    "wide_filter": "Edges of light and guides are four pixels wide, and come out too sharp or with steps.",
    "very_dark": "Constants that suit values near 1 swamp an image whose mean is near 0.001.",
    "very_bright": "Values near 1000 are outside of what networks were trained on.",
    "half_overflow": "A lamp beyond 65504 is cut in a half float, and what is left of it spills around.",
    "panorama": "Left and right edges meet: denoised apart they leave a seam in what lies across.",
}


def build(name, hard):
    """Empties Blender and builds a case or its control; returns the stage, ready but for render settings."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    stage = Stage(random.Random(f"hard {name}"), Library([]))
    scene = stage.scene
    scene.render.engine = "CYCLES"
    cycles = scene.cycles
    cycles.device = "CPU"
    cycles.max_bounces, cycles.diffuse_bounces, cycles.glossy_bounces = 10, 4, 4
    cycles.transmission_bounces, cycles.transparent_max_bounces, cycles.volume_bounces = 8, 12, 1
    # Clamping hides some of the troubles, and what it takes away the reference lacks as well.
    cycles.sample_clamp_direct = cycles.sample_clamp_indirect = 0.0
    cycles.pixel_filter_type, cycles.filter_width = "BLACKMAN_HARRIS", 1.5
    getattr(light if hasattr(light, name) else detail, name)(stage, hard)
    scene.frame_set(1)
    return stage
