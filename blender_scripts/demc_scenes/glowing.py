"""What shines by itself and is seen: screens, signs, lamps and light boxes in dim places, and the stars."""

import math

from mathutils import Vector

from . import materials as m
from . import outside, palette, printed, props, shapes
from .stage import darkness, environment


def shown(stage, picture_share=0.5):
    """An image for a screen: a picture of the library where there is one, or something made."""
    rng, pictures = stage.rng, stage.library.pictures
    return rng.choice(pictures) if pictures and rng.random() < picture_share else printed.image(rng)


def monitor(stage, at, turn, width):
    """A screen in its frame, on a foot; it shows a picture or a program."""
    rng = stage.rng
    height, bar, foot = (
        width * rng.uniform(0.5, 0.7),
        width * rng.uniform(0.01, 0.04),
        width * rng.uniform(0.05, 0.25),
    )
    body = [
        ((width + 2 * bar, 0.02, height + 2 * bar), (0, 0.015, foot + height / 2)),
        ((width * 0.4, 0.12, 0.01), (0, 0.03, 0.005)),
        ((width * 0.08, 0.02, foot), (0, 0.04, foot / 2)),
    ]
    stage.add(shapes.boxes(body, 0.003), m.plastic(rng), at, turn)
    pane = shapes.plane(width, height, unit_uv=True)
    pane.location = (0, 0.003, foot)
    stage.add(pane, rng.choice((m.screen, m.screen, m.glowing_picture))(rng, shown(stage)), at, turn)
    stage.interest.append(Vector(at) + Vector((0, 0, foot + height / 2)))


def sign(stage, at, turn):
    """Letters that glow, on a board, or a light box."""
    rng = stage.rng
    if rng.random() < 0.5:
        box = shapes.plane(rng.uniform(0.2, 0.6), rng.uniform(0.15, 0.4), unit_uv=True)
        stage.add(box, m.glowing_picture(rng, shown(stage, 0.2)), at, turn)
        return
    words = rng.choice(("OPEN", "BAR", "EXIT", "CAFE", "24H", "KINO", "TAXI", "ON AIR"))
    size = rng.uniform(0.1, 0.3)
    board = shapes.box((size * 3.4, 0.02, size * 1.4), 0.003, (size * 1.2, 0.03, size * 0.35))
    stage.add(board, palette.choose(rng, stage.library, "metal"), at, turn)
    stage.add(
        shapes.text(words, size, 0.01),
        m.light(rng, rng.uniform(2, 20), m.color(rng, (0.4, 1.0), (0.8, 1.0))),
        at,
        turn,
    )


def strip(stage, start, end):
    """A strip of light-emitting diodes: a row of small emitters."""
    rng = stage.rng
    glow = m.light(rng, rng.uniform(10, 80), m.color(rng, (0.0, 1.0), (0.8, 1.0)))
    count = rng.randint(12, 40)
    dots = [((0.006, 0.006, 0.004), Vector(start).lerp(Vector(end), (i + 0.5) / count)) for i in range(count)]
    stage.add(shapes.boxes(dots), glow)


def desk(stage):
    """A desk at night: screens, signs, strips and lamps that are seen, and what they light."""
    rng, lib = stage.rng, stage.library
    stage.add(shapes.box((6, 6, 0.1), 0, (0, 0, -0.05)), palette.choose(rng, lib, "furniture"))
    stage.add(shapes.box((6, 0.2, 3), 0, (0, 0.9, 1.5)), palette.walls(rng, lib))
    for _ in range(rng.randint(2, 4)):
        at = (rng.uniform(-0.8, 0.8), rng.uniform(0.1, 0.6), 0)
        monitor(stage, at, rng.uniform(-0.5, 0.5), rng.uniform(0.25, 0.7))
    for _ in range(rng.randint(0, 2)):
        sign(stage, (rng.uniform(-1.0, 0.7), 0.76, rng.uniform(0.4, 1.0)), 0.0)
    for _ in range(rng.randint(0, 2)):
        z = rng.uniform(0.02, 1.2)
        strip(stage, (-rng.uniform(0.3, 1.2), 0.78, z), (rng.uniform(0.3, 1.2), 0.78, z))
    lamps = lib.with_role("lamp", largest=0.8)
    for _ in range(rng.randint(4, 10)):
        at = (rng.uniform(-0.9, 0.9), rng.uniform(-0.5, 0.3), 0)
        props.small(stage, at, 0.4)
    for _ in range(rng.randint(1, 3)):
        at = (rng.uniform(-0.9, 0.9), rng.uniform(-0.2, 0.5), 0)
        if lamps and rng.random() < 0.4:
            group = stage.model(rng.choice(lamps)).place(at, rng.uniform(0, 6.28))
            stage.lamp(
                "POINT",
                (at[0], at[1] - 0.02, group.size.z * 0.8),
                rng.uniform(1, 10),
                (1, 0.75, 0.5),
                shadow_soft_size=0.03,
            )
        elif rng.random() < 0.5:
            props.candle(stage, at)
        else:  # a bare bulb in a glass
            r = rng.uniform(0.02, 0.05)
            stage.add(shapes.sphere(r * 1.6, 4), m.glass(rng, True), at)
            stage.add(shapes.sphere(r, 3), m.light(rng, rng.uniform(5, 60)), (at[0], at[1], r * 0.6))
        stage.interest.append(Vector(at) + Vector((0, 0, 0.1)))
    if rng.random() < 0.6:
        darkness(stage, rng.uniform(0.01, 0.15))
    else:
        environment(stage, ("indoor", "room", "lounge", "night"), rng.uniform(0.05, 0.4))


def starry(stage, level):
    """A sky of stars, most of them smaller than a pixel, with a band where they are dense."""
    rng = stage.rng
    darkness(stage, 1.0)
    tree = stage.scene.world.node_tree
    background = next(n for n in tree.nodes if n.bl_idname == "ShaderNodeBackground")
    n = m.Nodes.on(tree)
    direction = n.new("ShaderNodeTexCoord").outputs["Generated"]
    total = None
    for scale, radius, bright in ((rng.uniform(60, 120), 0.1, 1.0), (rng.uniform(150, 300), 0.16, 0.25)):
        cells = n.new("ShaderNodeTexVoronoi")
        n.set(cells.inputs["Vector"], direction)
        n.set(cells.inputs["Scale"], scale)
        disc = n.math("LESS_THAN", cells.outputs["Distance"], radius * rng.uniform(0.7, 1.5))
        # The cell's own colour tells how bright its star is: few are, as in the sky.
        power = n.math("POWER", cells.outputs["Color"], rng.uniform(8, 25))
        star = n.math("MULTIPLY", n.math("MULTIPLY", disc, power), bright * 40)
        total = star if total is None else n.math("ADD", total, star)
    band = n.ramp(
        n.noise(direction, rng.uniform(1.5, 4), 8, 0.6), (0.45, 0.0), (0.75, rng.uniform(0.01, 0.5))
    )
    haze = n.mix(band, m.color(rng, (0.3, 0.8), (0.0, 0.02)), m.color(rng, (0.0, 0.4), (0.02, 0.08)))
    n.set(background.inputs["Color"], n.mix(1.0, haze, total, "ADD"))
    background.inputs["Strength"].default_value = level


def night_sky(stage):
    """Stars over a land with trees and a lit camp, or over rocks and globes in space under a hard sun."""
    rng, lib = stage.rng, stage.library
    if rng.random() < 0.5:
        outside.planted(stage)
        for target in rng.sample(stage.interest, min(len(stage.interest), 3)):
            stage.lamp(
                "POINT",
                Vector(target) + Vector((0, 0, rng.uniform(0.3, 1.5))),
                rng.uniform(5, 80),
                (1, 0.65, 0.35),
                shadow_soft_size=0.05,
            )
        outside.sun_lamp(stage, rng.uniform(0, 6.28), math.radians(rng.uniform(20, 60)))  # the moon
    else:
        rocks = lib.with_role("nature")
        for _ in range(rng.randint(8, 20)):
            at = Vector([rng.gauss(0, 1.2) for _ in range(3)])
            if rocks and rng.random() < 0.4:
                stage.model(rng.choice(rocks)).place(at, rng.uniform(0, 6.28), rng.uniform(0.2, 0.8))
            else:
                make = rng.choice(
                    (
                        lambda: shapes.sphere(rng.uniform(0.05, 0.6), 5),
                        lambda: shapes.gem(rng, rng.uniform(0.1, 0.5)),
                        lambda: shapes.torus(0.4, 0.03),
                    )
                )
                stage.add(
                    make(),
                    rng.choice(
                        (
                            lambda: palette.choose(rng, lib, "stone"),
                            lambda: m.embossed(rng, 0.2),
                            lambda: palette.anything(rng, lib),
                        )
                    )(),
                    at,
                    rng.uniform(0, 6.28),
                )
            stage.interest.append(at)
        outside.sun_lamp(stage, rng.uniform(0, 6.28), math.radians(rng.uniform(5, 50)))
    starry(stage, rng.uniform(0.3, 1.5))
    stage.least_covered = 0.15
