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

# Name -> (builder, why denoisers fail there).
CASES = {
    "glass_ball": (light.glass_ball, "Guides show the glass or what is behind it, the light both and reflections too."),
    "mirror": (light.mirror, "What is mirrored has detail that the mirror's own albedo and normal lack."),
    "caustic": (light.caustic, "Few paths find the light; their bright dots are taken for fireflies."),
    "thin_shadow": (light.thin_shadow, "Shadows as thin as a pixel are in no guide, and are blurred away as noise."),
    "many_lights": (light.many_lights, "Each sample sees one lamp of many: noise of all colours, and many soft shadows."),
    "light_gap": (light.light_gap, "Light comes through a gap that few paths find: most samples are black, some bright."),
    "fog": (light.fog, "Haze scatters before surfaces that guides describe: their edges are printed onto it."),
    "fog_beam": (light.fog_beam, "Beams in haze have edges where nothing is: guides are flat there."),
    "hair": (detail.hair, "Strands thinner than a pixel make guides as noisy as the light."),
    "foliage": (detail.foliage, "Every pixel holds edges of several leaves, and guides average them."),
    "subsurface": (light.subsurface, "Light within wax is noisy and smooth at once, and seams of guides cut it."),
    "depth_of_field": (detail.depth_of_field, "Guides of blurred things are noisy, and discs of light have sharp rims."),
    "motion_blur": (detail.motion_blur, "Guides mix the thing that moves with what is behind it, with noise of their own."),
    "bump": (detail.bump, "Normals are full of detail that even light hardly shows: it is printed onto the result."),
    "text": (detail.text, "Letters of one pixel's stroke are lost where noise is as strong as ink."),
    "text_through_glass": (detail.text_through_glass, "Frosted glass hides the print from guides, not from the eye."),
    "emissive": (light.emissive, "Patterns that shine are clean beside noise, and their albedo tells nothing of them."),
    "stars": (light.stars, "Lights smaller than a pixel look like fireflies and are removed."),
    "snow": (detail.snow, "Small bright flakes in the air look like fireflies in light and guides."),
    "glints": (light.glints, "Ripples mirror the sun for a pixel or less: real sparkle that looks like fireflies."),
    "film_alpha": (detail.film_alpha, "Colour fades with alpha at edges: haloes and fringes show once it is composited."),
    "wide_filter": (detail.wide_filter, "Edges of light and guides are four pixels wide and are made too sharp."),
    "very_dark": (detail.very_dark, "Constants that suit values near 1 swamp an image near 0.001."),
    "very_bright": (detail.very_bright, "Values near 1000 leave the range in which networks were trained."),
    "half_overflow": (detail.half_overflow, "A lamp beyond 65504 is infinite or cut in a half float, and spills around."),
    "panorama": (detail.panorama, "The left and right edges meet: denoised apart they leave a seam in what lies across."),
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
    CASES[name][0](stage, hard)
    scene.frame_set(1)
    return stage
