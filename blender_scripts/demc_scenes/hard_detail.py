"""Small scenes in which detail, the lens or the range of values is what denoisers find hard; see `hard`.

Each function builds its scene on an empty stage, `hard` saying whether the trouble is on.
"""

import math

import numpy as np

from . import hard_parts as parts
from . import materials as m
from . import printed, shapes, studio, views


def hair(stage, hard):
    """A furry ball and head, or shaven ones."""
    parts.floor(stage, parts.checker(0.3))
    parts.wall(stage, parts.matt(parts.GREY), 1.5)
    for shape, x in ((shapes.sphere(0.38, 4), -0.6), (shapes.monkey(0.85), 0.55)):
        stage.add(shape, parts.matt((0.35, 0.2, 0.1)), (x, 0, 0.05), 0.2)
        if hard:
            n = m.Nodes("fur")
            node = n.new("ShaderNodeBsdfHairPrincipled")
            node.inputs["Color"].default_value = (0.45, 0.25, 0.1, 1.0)
            settings = studio.grow(stage, shape, 6000, 0.16, n.finish(node.outputs[0]), 0.3)
            settings.root_radius, settings.tip_radius, settings.radius_scale = 1.0, 0.2, 0.006
    parts.softbox(stage, 80)
    parts.world(stage, 0.3)
    parts.view(stage)


def leaf():
    """A leaf card's material: green within an ellipse of UV 0..1, nothing beyond it."""
    n = m.Nodes("leaf")
    at = n.new("ShaderNodeSeparateXYZ")
    n.set(at.inputs[0], n.uv(1.0))
    across = n.math("POWER", n.math("DIVIDE", n.math("SUBTRACT", at.outputs[0], 0.5), 0.28), 2.0)
    along = n.math("POWER", n.math("DIVIDE", n.math("SUBTRACT", at.outputs[1], 0.5), 0.5), 2.0)
    inside = n.math("LESS_THAN", n.math("ADD", across, along), 1.0)
    vein = n.math("LESS_THAN", n.math("ABSOLUTE", n.math("SUBTRACT", at.outputs[0], 0.5)), 0.02)
    return n.principled(Base_Color=n.mix(vein, parts.GREEN, (0.5, 0.6, 0.2)), Roughness=0.5, Alpha=inside)


def foliage(stage, hard):
    """Bushes of leaf cards in the sun, or green balls."""
    parts.floor(stage, parts.grained(15))
    green = leaf() if hard else parts.matt(parts.GREEN)
    for x, y in ((-0.7, 0.0), (0.7, 0.3)):
        bush = shapes.leaves(stage.rng, 450, 0.62, 0.16)
        stage.add(bush, green, (x, y, 0.62)) if hard else stage.add(shapes.sphere(0.62, 5), green, (x, y, 0))
    parts.sun(stage, 4.0, -40, 45, 1.0)
    parts.world(stage, 0.5, (0.7, 0.85, 1.0))
    parts.view(stage, target=(0, 0, 0.5))


def bump(stage, hard):
    """A wall and shapes with dented normals, or smooth ones, under even light."""
    n = m.Nodes("dented")
    cells = n.shader("ShaderNodeTexVoronoi", Vector=n.place(1.0), Scale=14.0)
    normal = dict(Normal=n.bump(cells, 0.6, 0.08)) if hard else {}
    dented = n.principled(Base_Color=(0.6, 0.55, 0.5), Roughness=0.8, Specular_IOR_Level=0.1, **normal)
    parts.floor(stage, dented)
    parts.wall(stage, dented, 1.0)
    stage.add(shapes.sphere(0.4, 5), dented, (-0.6, 0.1, 0))
    stage.add(shapes.box((0.6, 0.6, 0.7), 0.02, (0, 0, 0.35)), dented, (0.6, 0.1, 0), 0.5)
    parts.world(stage, 0.6)
    parts.view(stage)


def page(stage, printed_on):
    """An upright page of small print, a stroke of which is a pixel wide, or an empty one."""
    # This seed prints dark letters on white.
    sheet = printed.page(np.random.default_rng(24))[:110, :120]
    if not printed_on:
        sheet = np.broadcast_to(sheet.mean((0, 1)), sheet.shape)
    n = m.Nodes("page")
    base = m.image(n, printed.stored("page", sheet), n.uv(1.0))
    base.interpolation = "Closest"
    paper = n.principled(Base_Color=base.outputs[0], Roughness=0.8)
    stage.add(shapes.plane(1.42, 1.3, unit_uv=True), paper, (-0.35, 0, 0.06))
    parts.softbox(stage, 45, at=(1.6, -1.6, 2.4), size=0.3)
    parts.world(stage, 0.15)
    parts.view(stage, at=(0, -2.6, 0.9), target=(0, 0, 0.7))


def text(stage, hard):
    """A printed page and a fine-grained wall, or an empty page and a bare wall."""
    parts.floor(stage, parts.matt((0.3, 0.25, 0.2)))
    parts.wall(stage, parts.grained(90) if hard else parts.matt((0.5, 0.45, 0.4)), 0.6)
    page(stage, hard)


def text_through_glass(stage, hard):
    """A printed page behind a frosted pane, or without the pane."""
    parts.floor(stage, parts.matt((0.3, 0.25, 0.2)))
    parts.wall(stage, parts.matt((0.5, 0.45, 0.4)), 0.6)
    page(stage, True)
    if hard:
        stage.add(shapes.box((1.5, 0.01, 1.4), 0, (-0.2, 0, 0.7)), parts.glass(0.3), (0, -0.03, 0))


def snow(stage, hard):
    """A dusk with falling flakes, or without."""
    parts.floor(stage, parts.matt((0.5, 0.5, 0.55)))
    parts.wall(stage, parts.matt((0.05, 0.07, 0.1)), 3.0)
    stage.add(shapes.box((0.9, 0.9, 1.0), 0.02, (0, 0, 0.5)), parts.grained(12), (0.6, 1.0, 0), 0.4)
    stage.add(shapes.monkey(0.9), parts.matt(parts.RED), (-0.7, 0.6, 0))
    if hard:
        draw = stage.rng.uniform
        flakes = [((0.013,) * 3, (draw(-1.6, 1.6), draw(-1.8, 2.0), draw(0.05, 2.4))) for _ in range(700)]
        stage.add(shapes.boxes(flakes), parts.matt((0.95, 0.95, 0.95)))
    parts.softbox(stage, 120, at=(2.2, -1.5, 2.8), size=0.3)
    parts.world(stage, 0.12, (0.5, 0.7, 1.0))
    parts.view(stage, target=(0, 0, 0.6))


def depth_of_field(stage, hard):
    """Balls and small lamps from near to far, through a wide aperture or a pinhole."""
    parts.floor(stage, parts.checker(0.2))
    parts.wall(stage, parts.matt((0.08, 0.09, 0.12)), 5.0)
    for i, tint in enumerate((parts.RED, parts.GREEN, parts.BLUE, parts.GREY)):
        stage.add(shapes.sphere(0.25, 5), parts.matt(tint), (-0.6 + 0.5 * i, -1.6 + 1.1 * i, 0))
    for i in range(14):
        at = (stage.rng.uniform(-2, 2), 4.0, stage.rng.uniform(0.5, 2.0))
        stage.add(shapes.sphere(0.04, 2), parts.glow(40, m.color(stage.rng, (0.2, 0.8), (0.9, 1.0))), at)
    parts.softbox(stage, 70)
    parts.world(stage, 0.2)
    camera = parts.view(stage, at=(0, -3.0, 0.9), target=(0, 0, 0.4), lens=45)
    camera.data.dof.use_dof = hard
    camera.data.dof.focus_distance, camera.data.dof.aperture_fstop = 2.5, 0.25


def motion_blur(stage, hard):
    """A ball that flies by and a wheel that turns, with the shutter open for the whole frame or for none."""
    parts.floor(stage, parts.checker(0.3))
    parts.wall(stage, parts.grained(20), 1.5)
    ball = stage.add(shapes.sphere(0.3, 5), parts.checker(0.1, parts.RED), (-0.6, 0, 0.25))
    spokes = [((1.0, 0.06, 0.1), (0, 0, 0)), ((0.1, 0.05, 1.0), (0, 0, 0))]
    wheel = stage.add(shapes.boxes(spokes), parts.matt(parts.BLUE))
    wheel.location = (0.75, 0, 0.65)
    for frame, side in ((0, -1), (2, 1)):
        ball.location.x = -0.6 + 0.5 * side
        wheel.rotation_euler.y = 0.6 + 0.7 * side
        ball.keyframe_insert("location", frame=frame)
        wheel.keyframe_insert("rotation_euler", frame=frame)
    stage.scene.render.use_motion_blur = hard
    stage.scene.render.motion_blur_shutter = 1.0
    parts.softbox(stage, 60)
    parts.world(stage, 0.3)
    parts.view(stage)


def film_alpha(stage, hard):
    """Leaf cards, a ring and a pane over a transparent film, or before the world."""
    stage.add(shapes.leaves(stage.rng, 160, 0.55, 0.2), leaf(), (-0.6, 0, 0.6))
    stage.add(shapes.torus(0.35, 0.03), parts.matt(parts.RED), (0.6, -0.1, 0.1), 0.5).rotation_euler.x = 1.0
    pane = parts.matt(parts.BLUE, Alpha=0.5)
    stage.add(shapes.box((0.6, 0.02, 0.6), 0, (0, 0, 0.3)), pane, (0.75, 0.3, 0.4), 0.3)
    parts.softbox(stage, 60)
    parts.world(stage, 0.3)
    parts.view(stage, target=(0, 0, 0.5))
    stage.scene.render.film_transparent = hard


def wide_filter(stage, hard):
    """The still life through a pixel filter four pixels wide, or through the usual one."""
    parts.still_life(stage)
    stage.scene.cycles.filter_width = 4.0 if hard else 1.5


def very_dark(stage, hard):
    """The still life with the film exposed so that its mean is near 0.001, or as usual."""
    parts.still_life(stage)
    stage.scene.cycles.film_exposure = 0.004 if hard else 1.0


def very_bright(stage, hard):
    """The still life with a mean near 1000, or as usual: ten times by the film, all that Blender allows, and
    the rest by its lamps."""
    parts.still_life(stage, 400 if hard else 1)
    stage.scene.cycles.film_exposure = 10.0 if hard else 1.0


def half_overflow(stage, hard):
    """The still life with a lamp that is seen: brighter than a half float can hold, or not."""
    parts.still_life(stage)
    warm = (1, 0.9, 0.75)
    stage.add(shapes.sphere(0.08, 4), parts.glow(20, warm), (-0.15, 0.2, 0.95))
    # The shell is for the camera's eyes only: as a light of that strength it would burn out the frame.
    shell = stage.add(shapes.sphere(0.09, 4), parts.glow(2e5 if hard else 20, warm), (-0.15, 0.2, 0.94))
    shell.active_material.cycles.emission_sampling = "NONE"
    for ray in ("diffuse", "glossy", "transmission", "volume_scatter", "shadow"):
        setattr(shell, f"visible_{ray}", False)


def panorama(stage, hard):
    """A room all around, with a ball and its poster across the seam behind the camera, or beside it."""
    stage.add(shapes.boxes([((5, 5, 0.1), (0, 0, -0.05)), ((5, 5, 0.1), (0, 0, 2.85))]), parts.checker(0.5))
    walls = [((5, 0.1, 2.8), (0, side * 2.5, 1.4)) for side in (-1, 1)]
    walls += [((0.1, 5, 2.8), (side * 2.5, 0, 1.4)) for side in (-1, 1)]
    stage.add(shapes.boxes(walls), parts.matt((0.5, 0.48, 0.44)))
    stage.add(shapes.monkey(0.8), parts.matt(parts.GREEN), (0.2, 1.6, 0))
    # The camera looks along +Y; the seam is where -Y is.
    angle = -math.pi / 2 if hard else 0.0
    at = lambda distance: (distance * math.cos(angle), distance * math.sin(angle), 0)
    stage.add(shapes.sphere(0.5, 5), parts.matt(parts.RED), at(1.3))
    stage.add(shapes.box((1.6, 0.04, 2.2), 0, (0, 0, 1.1)), parts.checker(0.2), at(2.2), angle + math.pi / 2)
    parts.softbox(stage, 60, at=(0.8, 0.4, 2.6), size=0.6, aim=(0, 0, 0))
    parts.world(stage, 0.0)
    views.all_around(stage, parts.view(stage, at=(0, 0, 1.4), target=(0, 1, 1.4)))
