"""Small scenes in which the light is what denoisers find hard; see `hard` for the list.

Each function builds its scene on an empty stage, `hard` saying whether the trouble is on.
"""

import math

from . import hard_parts as parts
from . import materials as m
from . import shapes


def glass_ball(stage, hard):
    """A ball over a textured floor, of glass or matt."""
    parts.floor(stage, parts.checker(0.15))
    parts.wall(stage, parts.grained(30), 1.5)
    stage.add(shapes.sphere(0.6, 6), parts.glass() if hard else parts.matt(parts.RED))
    parts.softbox(stage, 60)
    parts.world(stage, 0.3)
    parts.view(stage, target=(0, 0, 0.5))


def mirror(stage, hard):
    """A standing board, a mirror or matt, that faces the camera and a poster behind it."""
    parts.floor(stage, parts.checker(0.25))
    parts.wall(stage, parts.matt(parts.GREY))
    silver = m.Nodes("silver").principled(Base_Color=(0.92, 0.92, 0.92), Metallic=1.0, Roughness=0.0)
    board = shapes.box((2.4, 0.04, 1.3), 0, (0, 0, 0.7))
    stage.add(board, silver if hard else parts.matt((0.6, 0.6, 0.6)), (0, 0.9, 0), 0.12)
    stage.add(shapes.sphere(0.22, 5), parts.matt(parts.RED), (-0.6, 0.2, 0))
    stage.add(shapes.monkey(0.5), parts.matt(parts.GREEN), (0.6, 0.1, 0), -0.5)
    stage.add(shapes.box((5, 0.04, 2.5), 0, (0, 0, 1.25)), parts.checker(0.2, (0.8, 0.4, 0.1)), (0, -4.5, 0))
    parts.softbox(stage, 90, at=(2.2, -2.0, 3.0))
    parts.world(stage, 0.25)
    parts.view(stage, target=(0, 0, 0.6))


def caustic(stage, hard):
    """A glass ball and a ring of brass with light behind them; the control follows no caustics."""
    parts.floor(stage, parts.matt((0.6, 0.6, 0.58)))
    brass = m.Nodes("brass").principled(Base_Color=(0.9, 0.65, 0.3), Metallic=1.0, Roughness=0.05)
    stage.add(shapes.sphere(0.35, 6), parts.glass(), (-0.5, 0, 0))
    ring = shapes.lathe([(0.33, 0), (0.35, 0), (0.35, 0.1), (0.33, 0.1), (0.33, 0)], 96)
    stage.add(ring, brass, (0.65, -0.1, 0))
    parts.softbox(stage, 90, at=(0.6, 2.2, 2.0), size=0.35, aim=(0, 0, 0))
    parts.world(stage, 0.05)
    parts.view(stage, at=(0, -2.6, 1.6), target=(0, -0.15, 0.1))
    cycles = stage.scene.cycles
    cycles.caustics_refractive = cycles.caustics_reflective = hard


def thin_shadow(stage, hard):
    """A bare floor in the sun, under a lattice of wires that is out of the frame."""
    parts.floor(stage, parts.matt((0.6, 0.58, 0.55)))
    stage.add(shapes.sphere(0.25, 5), parts.matt(parts.RED), (0.7, 0.3, 0))
    if hard:
        wires = [((6, 0.02, 0.02), (0, 0.11 * i, 2.2)) for i in range(-25, 26)]
        wires += [((0.02, 6, 0.02), (0.17 * i, 0, 2.2)) for i in range(-17, 18)]
        stage.add(shapes.boxes(wires), parts.matt((0.05, 0.05, 0.05)), turn=0.35)
    parts.sun(stage, 2.5, 60, 70, 0.3)
    parts.world(stage, 0.25, (0.6, 0.75, 1.0))
    parts.view(stage, at=(0, -2.4, 1.5), target=(0, 0.1, 0))


def many_lights(stage, hard):
    """Things among 150 small lamps of all colours; the control has one."""
    parts.floor(stage, parts.matt(parts.GREY))
    parts.wall(stage, parts.matt(parts.GREY), 1.2)
    for x, tint in ((-0.8, parts.RED), (0.0, parts.GREEN), (0.8, parts.BLUE)):
        stage.add(shapes.monkey(0.6), parts.matt(tint), (x, 0.1, 0), x)
    for _ in range(150 if hard else 0):
        at = (stage.rng.uniform(-2, 2), stage.rng.uniform(-1.4, 1.1), stage.rng.uniform(0.03, 1.6))
        stage.lamp("POINT", at, 0.55, m.color(stage.rng, (0.3, 1.0), (0.8, 1.0)), shadow_soft_size=0.008)
    if not hard:
        parts.softbox(stage, 60)
    parts.world(stage, 0.02)
    parts.view(stage)


def light_gap(stage, hard):
    """A closed room beside a bright one, and a door between: ajar by a hand's breadth, or open."""
    gap = 0.1 if hard else 1.2
    room = [((4, 8, 0.1), (0, 2, -0.05)), ((4, 8, 0.1), (0, 2, 2.45)), ((0.1, 8, 2.4), (-2.05, 2, 1.2))]
    room += [((4, 0.1, 2.4), (0, y, 1.2)) for y in (-2.05, 6.05)] + [((0.1, 8, 2.4), (2.05, 2, 1.2))]
    room += [((2 - gap / 2, 0.1, 2.4), (x - gap / 4 * s, 1.0, 1.2)) for x, s in ((-1, 1), (1, -1))]
    stage.add(shapes.boxes(room), parts.matt((0.7, 0.68, 0.64)))
    stage.add(shapes.box((0.6, 0.6, 0.6), 0.02, (0, 0, 0.3)), parts.matt(parts.RED), (-0.9, 0.2, 0), 0.4)
    stage.add(shapes.monkey(0.7), parts.matt(parts.BLUE), (0.8, 0.3, 0), -0.3)
    parts.softbox(stage, 700 if hard else 110, at=(0.2, 2.6, 2.0), size=1.2, aim=(0, 0, 0.4))
    parts.world(stage, 0.0)
    parts.view(stage, at=(0, -1.95, 1.4), target=(0, 0.6, 0.8), lens=24)


def fog(stage, hard):
    """Balls one behind the other and lamps among them, in haze or in clear air."""
    parts.floor(stage, parts.checker(0.5))
    for i, tint in enumerate((parts.RED, parts.GREEN, parts.BLUE) * 2):
        at = (-1.2 + 0.9 * (i % 3) + 0.2 * i, -0.6 + 1.1 * i, 0)
        stage.add(shapes.sphere(0.4, 5), parts.matt(tint), at)
    for x, y in ((-0.9, 0.6), (1.4, 2.4)):
        stage.add(shapes.sphere(0.08, 3), parts.glow(60, (1, 0.8, 0.5)), (x, y, 1.0))
    if hard:
        parts.haze(stage, (15, 15, 5), (0, 3, 2.4), 0.14)
    parts.world(stage, 0.35, (0.8, 0.9, 1.0))
    parts.view(stage, at=(0, -3.5, 1.5), target=(0, 0.5, 0.6), lens=32)


def fog_beam(stage, hard):
    """A spot through slats, in haze or in clear air."""
    parts.floor(stage, parts.matt((0.4, 0.4, 0.4)))
    parts.wall(stage, parts.matt((0.15, 0.17, 0.2)), 1.6)
    stage.add(shapes.sphere(0.3, 5), parts.matt(parts.RED), (0.7, 0.2, 0))
    slats = [((0.12, 1.5, 0.02), (-1.5 + 0.22 * i, 0.2, 2.1)) for i in range(8)]
    stage.add(shapes.boxes(slats), parts.matt((0.1, 0.1, 0.1)))
    stage.lamp("SPOT", (-1.6, 0.2, 3.4), 1500, aim=(0.1, 0.2, 0), spot_size=0.9, shadow_soft_size=0.02)
    if hard:
        parts.haze(stage, (8, 3.1, 4), (0, 0, 2.01), 0.12)
    parts.world(stage, 0.02)
    parts.view(stage, at=(0, -3.6, 1.2), target=(0, 0, 0.9), lens=34)


def subsurface(stage, hard):
    """A head and a ball of wax with light behind them; the control's are matt."""
    parts.floor(stage, parts.checker(0.3))
    parts.wall(stage, parts.matt((0.3, 0.32, 0.35)), 2.2)
    wax = dict(Subsurface_Weight=1.0, Subsurface_Radius=(1.0, 0.4, 0.2), Subsurface_Scale=0.12)
    material = parts.matt((0.85, 0.65, 0.5), **(wax if hard else {}))
    stage.add(shapes.monkey(1.0), material, (-0.4, 0, 0), 0.2)
    stage.add(shapes.sphere(0.3, 5), material, (0.75, -0.2, 0))
    parts.softbox(stage, 90, at=(1.0, 1.6, 1.8), size=0.4)
    parts.softbox(stage, 12, at=(-1.8, -1.8, 1.6))
    parts.world(stage, 0.08)
    parts.view(stage)


def emissive(stage, hard):
    """Chequered panels and a sign in a dark room that shine; the control's are printed, and lit."""
    parts.floor(stage, parts.matt((0.4, 0.4, 0.4)))
    parts.wall(stage, parts.matt((0.3, 0.3, 0.32)), 1.2)
    for x, tint in ((-0.95, (1.0, 0.35, 0.1)), (0.95, (0.15, 0.5, 1.0))):
        n = m.Nodes("panel")
        tone = parts.squares(n, 0.07, tint, (0.01, 0.01, 0.02))
        emission = dict(Emission_Color=tone, Emission_Strength=1.5, Base_Color=(0, 0, 0))
        panel = n.principled(Roughness=0.8, **(emission if hard else dict(Base_Color=tone)))
        stage.add(shapes.box((0.9, 0.05, 0.9), 0, (0, 0, 0.5)), panel, (x, 0.6, 0), -0.2 * x)
    letters = shapes.text("OPEN", 0.32, 0.02)
    green = parts.glow(3, (0.2, 1.0, 0.5)) if hard else parts.matt((0.2, 0.8, 0.4))
    stage.add(letters, green, (-0.42, 0.5, 1.05))
    stage.add(shapes.sphere(0.25, 5), parts.matt((0.7, 0.7, 0.7)), (0, -0.1, 0))
    if not hard:
        parts.softbox(stage, 60)
    parts.world(stage, 0.01 if hard else 0.2)
    parts.view(stage, target=(0, 0, 0.55))


def stars(stage, hard):
    """A night sky over dark hills, with stars or without."""
    hills = shapes.terrain(30, 90, lambda x, y: 0.5 * math.sin(0.7 * x + 1) * math.cos(0.5 * y) - 0.3)
    stage.add(hills, parts.grained(8))
    if hard:
        for strength, count, side in ((8, 300, 0.02), (40, 80, 0.025), (250, 15, 0.03)):
            draw = stage.rng.uniform
            spots = [((side,) * 3, (draw(-9, 9), 12.0, draw(0.3, 9.0))) for _ in range(count)]
            stage.add(shapes.boxes(spots), parts.glow(strength, (0.9, 0.95, 1.0)))
    parts.sun(stage, 0.25, -60, 35, 0.6)  # the moon
    parts.world(stage, 0.02, (0.3, 0.45, 1.0))
    parts.view(stage, at=(0, -6, 1.0), target=(0, 4, 2.4), lens=38)


def glints(stage, hard):
    """Water under a low sun, rippled or calm."""
    draw = stage.rng.uniform
    waves = [(draw(-14, 14), draw(6, 40), draw(0, 6.28)) for _ in range(6)]

    def height(x, y):
        return sum(0.09 / (abs(a) + b) * math.sin(a * x + b * y + c) for a, b, c in waves)

    water = m.Nodes("water").principled(Base_Color=(0.01, 0.04, 0.05), Roughness=0.06, IOR=1.33)
    stage.add(shapes.terrain(9, 360, height) if hard else shapes.terrain(9, 4, lambda x, y: 0.0), water)
    stage.add(shapes.box((9, 0.5, 0.5), 0.1), parts.grained(20), (0, 4.4, 0.1))
    stage.add(shapes.sphere(0.5, 5), parts.matt(parts.RED), (-0.9, 0.6, -0.3))
    parts.sun(stage, 2.0, 80, 24, 0.6)
    parts.world(stage, 0.35, (0.55, 0.75, 1.0))
    parts.view(stage, at=(0, -3.4, 1.3), target=(0, 0.8, 0.1))
