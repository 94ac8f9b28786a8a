"""Out of doors: streets by day and night, gardens and woods, fog, and the lights of the night."""

import math

import bpy
from mathutils import Vector, noise

from . import materials as m
from . import palette, props, shapes
from .stage import darkness, environment
from .studio import grow


DAY = ("sunny", "sky", "sun", "garden", "forest", "dawn", "city")


def sun(stage, low=False):
    """Environment and sun of a day."""
    rng = stage.rng
    environment(stage, DAY, rng.uniform(0.5, 1.5), ("night", "moon"))
    if rng.random() < 0.6:
        angle, height = rng.uniform(0, 6.28), math.radians(rng.uniform(5, 20) if low else rng.uniform(15, 65))
        sun_lamp(stage, angle, height)


def sun_lamp(stage, angle, height):
    """A sun at an azimuth and a height in radians; returns the direction toward it."""
    rng = stage.rng
    toward = Vector((math.cos(angle) * math.cos(height), math.sin(angle) * math.cos(height), math.sin(height)))
    stage.lamp("SUN", (0, 0, 30), rng.uniform(2, 8), rng.choice(((1, 0.95, 0.88), (1, 0.75, 0.5))), aim=Vector((0, 0, 30)) - toward, angle=math.radians(rng.uniform(0.3, 2)))
    return toward


def facade(stage, at, turn, night):
    """A building front with rows of windows, some lit."""
    rng, lib = stage.rng, stage.library
    w, h, d = rng.uniform(8, 18), rng.uniform(6, 20), 6.0
    stage.add(shapes.box((w, d, h), 0, (0, d / 2, h / 2)), palette.choose(rng, lib, "facade", 0.2), at, turn)
    columns, rows = int(w / rng.uniform(1.8, 3)), int(h / rng.uniform(2.6, 3.4))
    ww, wh = w / columns * rng.uniform(0.4, 0.7), h / rows * rng.uniform(0.4, 0.65)
    frame = m.paint(rng, (0.05, 0.9))
    dark = m.plastic(rng) if rng.random() < 0.3 else m.Nodes("window").principled(Base_Color=(0.02, 0.025, 0.03), Roughness=0.03, Coat_Weight=1.0)
    lit = m.light(rng, rng.uniform(2, 10) if night else 1.0)
    panes, glowing, frames = [], [], []
    for i in range(columns):
        for j in range(rows):
            x, z = (i + 0.5) * w / columns - w / 2, (j + 0.45) * h / rows + 0.3
            (glowing if night and rng.random() < 0.4 else panes).append(((ww, 0.02, wh), (x, -0.01, z)))
            frames += [((ww + 0.16, 0.12, 0.08), (x, -0.05, z + s * wh / 2)) for s in (-1, 1)]
            frames += [((0.08, 0.12, wh), (x + s * ww / 2, -0.05, z)) for s in (-1, 1)] + [((0.05, 0.06, wh), (x, -0.03, z))]
            if rng.random() < 0.1:  # balcony rails
                frames += [((0.02, 0.02, 0.9), (x - ww / 2 + ww * k / 8, -0.6, z - wh / 2 + 0.4)) for k in range(9)]
                frames += [((ww + 0.1, 0.6, 0.08), (x, -0.3, z - wh / 2)), ((ww, 0.04, 0.04), (x, -0.6, z - wh / 2 + 0.85))]
    for parts, material in ((panes, dark), (glowing, lit), (frames, frame)):
        if parts:
            stage.add(shapes.boxes(parts), material, at, turn)


def wet(stage, material):
    """Puddles: patches of a surface turn smooth and dark."""
    shader = m.principled_of(material)
    if shader is None:
        return material
    n = m.Nodes.on(material.node_tree)
    patches = n.ramp(n.noise(n.place(1.0), stage.rng.uniform(0.2, 0.8), 4), (0.45, 1.0), (0.55, 0.05))
    old = shader.inputs["Roughness"]
    n.set(old, n.math("MULTIPLY", old.links[0].from_socket if old.is_linked else old.default_value, patches))
    return material


def street(stage, night=None):
    """A road between houses, with vehicles, lamps and people."""
    rng, lib = stage.rng, stage.library
    night = rng.random() < 0.35 if night is None else night
    half = rng.uniform(3, 5)
    road = palette.choose(rng, lib, "road", 0.1)
    stage.add(shapes.box((80, 2 * half, 0.1), 0, (0, 0, -0.05)), wet(stage, road) if rng.random() < 0.4 else road)
    walk = palette.choose(rng, lib, "road", 0.1)
    for side in (-1, 1):
        stage.add(shapes.box((80, 3.0, 0.24), 0.02, (0, side * (half + 1.5), 0)), walk)
    stripes = [((1.6, 0.14, 0.004), (x * 3.2, 0, 0.001)) for x in range(-12, 13)]
    stage.add(shapes.boxes(stripes), m.paint(rng, (0.7, 0.95)))
    houses = lib.with_role("building", smallest=9, largest=32)
    for side in (-1, 1):
        x = -30.0
        while x < 30:
            if houses and rng.random() < 0.3:
                group = stage.model(rng.choice(houses))
                reach = max(group.size.x, group.size.y)
                group.place((x + reach / 2, side * (half + 3.2 + reach / 2), 0), rng.choice((0, 1.5708, 3.1416, -1.5708)))
                x += reach + rng.uniform(0, 3)
            else:
                facade(stage, (x + 9, side * (half + 3), 0), 0 if side > 0 else math.pi, night)
                x += rng.uniform(14, 20)
    things = lib.with_role("building", "prop", "figure", "plant", "vehicle", smallest=0.5, largest=13)
    for _ in range(rng.randint(8, 22)):
        side, x = rng.choice((-1, 1)), rng.uniform(-16, 16)
        if things and rng.random() < 0.7:
            model = rng.choice(things)
            group = stage.model(model)
            y = side * (half - 1.4) if model.role == "vehicle" else side * (half + rng.uniform(0.5, 2.4))
            along = math.pi / 2 if model.role == "vehicle" and group.size.y > group.size.x else rng.uniform(0, 6.28) if model.role != "vehicle" else 0
            group.place((x, y, 0.0 if model.role == "vehicle" else 0.12), along)
            stage.interest.append(Vector((x, y, group.size.z * 0.5)))
        else:
            crate = shapes.box([rng.uniform(0.3, 1.0) for _ in range(3)], 0.02, (0, 0, 0.3))
            stage.add(crate, palette.anything(rng, lib), (x, side * (half + rng.uniform(0.5, 2.4)), 0.12), rng.uniform(0, 6))
    if night:
        darkness(stage, rng.uniform(0.01, 0.1)) if rng.random() < 0.5 else environment(stage, ("night", "moon"), rng.uniform(0.3, 1.5))
        for x in range(-24, 25, 8):
            stage.lamp("SPOT", (x, (half + 0.3) * (1 if x % 16 else -1), 5.5), rng.uniform(300, 900), (1, 0.7, 0.4), aim=(x, 0, 0), spot_size=2.2, shadow_soft_size=0.15)
        for _ in range(rng.randint(0, 5)):
            neon(stage, (rng.uniform(-12, 12), rng.choice((-1, 1)) * (half + 2.9), rng.uniform(2.5, 5)))
    else:
        sun(stage)
    return half


def neon(stage, at):
    """A glowing sign: letters or a bent tube."""
    rng = stage.rng
    glow = m.light(rng, rng.uniform(5, 40), m.color(rng, (0.6, 1.0), (0.8, 1.0)))
    if rng.random() < 0.5:
        words = rng.choice(("OPEN", "BAR", "HOTEL", "CAFE", "24H", "KINO"))
        stage.add(shapes.text(words, 0.7, 0.03), glow, at, math.pi if at[1] < 0 else 0)
    else:
        points = [(at[0] + rng.gauss(0, 0.5), at[1], at[2] + rng.gauss(0, 0.4)) for _ in range(7)]
        stage.add(shapes.tube(points, 0.02), glow)


def height_field(rng, amount):
    """A smooth random ground."""
    shift = Vector((rng.uniform(0, 100), rng.uniform(0, 100), 0))
    return lambda x, y: amount * noise.fractal(Vector((x, y, 0)) * 0.12 + shift, 1.0, 2.0, 4) - amount * noise.fractal(shift, 1.0, 2.0, 4)


def outdoor(stage):
    """A garden or wood by day."""
    land = planted(stage)
    sun(stage, stage.rng.random() < 0.3)
    return land


def planted(stage):
    """Ground, grass, trees, rocks, a pond, a fence: a garden or wood without its light."""
    rng, lib = stage.rng, stage.library
    height = height_field(rng, rng.uniform(0.2, 1.2))
    land = stage.add(shapes.terrain(40, 120, height), palette.choose(rng, lib, "ground", 0.05))
    if rng.random() < 0.65:
        lawn = stage.add(shapes.terrain(9, 48, height), palette.choose(rng, lib, "ground", 0.05), (0, 0, 0.01))
        meadow(stage, lawn, (15000, 40000), (0.08, 0.3))
    plants = lib.with_role("plant")
    rocks = lib.with_role("nature")
    others = lib.with_role("figure", "chair", "vehicle", largest=3) + lib.with_role("building", smallest=2, largest=8)
    for _ in range(rng.randint(15, 45)):
        near = rng.random() < 0.4
        r, a = rng.uniform(0.5, 5) if near else rng.uniform(4, 18), rng.uniform(0, 6.28)
        x, y = r * math.cos(a), r * math.sin(a)
        at = (x, y, height(x, y) - 0.02)
        roll = rng.random()
        if plants and roll < 0.6:
            group = stage.model(rng.choice([p for p in plants if not near or p.size < 3] or plants))
            group.place(at, rng.uniform(0, 6.28), rng.uniform(0.7, 1.4) * (rng.uniform(1, 3) if group.size.z < 0.6 and not near else 1))
        elif rocks and roll < 0.75:
            stage.model(rng.choice(rocks)).place(at, rng.uniform(0, 6.28), rng.uniform(0.2, 1.5))
        elif others and roll < 0.82:
            stage.model(rng.choice(others)).place(at, rng.uniform(0, 6.28))
        elif roll < 0.92:
            bush(stage, at, rng.uniform(0.4, 2.5))
        else:
            tree(stage, at, rng.uniform(2.5, 7))
        if near:
            stage.interest.append(Vector(at) + Vector((0, 0, 0.4)))
    if rng.random() < 0.2:
        level = height(2, 2) + 0.05
        pond = shapes.terrain(10, 64, lambda x, y: level + 0.004 * math.sin(9 * x + 3 * y) + 0.003 * math.sin(14 * y - 6 * x))
        stage.add(pond, m.glass(rng, True), (2, 2, 0))
    if rng.random() < 0.3:
        planks = [((0.09, 0.02, 1.1), (i * 0.12 - 6, 0, 0.5)) for i in range(100)] + [((12, 0.03, 0.08), (0, 0.03, z)) for z in (0.25, 0.85)]
        stage.add(shapes.boxes(planks, 0.004), palette.choose(rng, lib, "furniture"), (0, 4, height(0, 4)), rng.uniform(-0.5, 0.5))
    return land


def thicket(stage):
    """Leaves and blades close by, one before the other, with the sun among them."""
    rng, lib = stage.rng, stage.library
    height = height_field(rng, rng.uniform(0.0, 0.4))
    land = stage.add(shapes.terrain(14, 90, height), palette.choose(rng, lib, "ground", 0.05))
    if rng.random() < 0.5:
        lawn = stage.add(
            shapes.terrain(5, 40, height), palette.choose(rng, lib, "ground", 0.05), (0, 0, 0.01)
        )
        meadow(stage, lawn, (10000, 30000), (0.1, 0.4))
    plants = lib.with_role("plant", largest=4)
    for _ in range(rng.randint(14, 34)):
        r, a = rng.uniform(0.0, 3.5), rng.uniform(0, 6.28)
        x, y = r * math.cos(a), r * math.sin(a)
        at = (x, y, height(x, y))
        if plants and rng.random() < 0.35:
            group = stage.model(rng.choice(plants))
            group.place(at, rng.uniform(0, 6.28), rng.uniform(0.6, 1.6) / max(group.size))
        else:
            bush(
                stage,
                (x, y, at[2] + rng.choice((0.0, 0.0, rng.uniform(0.2, 1.2)))),
                rng.uniform(0.3, 1.3),
                rng.random() < 0.4,
            )
        if r < 2.5:
            stage.interest.append(Vector(at) + Vector((0, 0, 0.4)))
    environment(stage, DAY, rng.uniform(0.4, 1.3), ("night", "moon"))
    sun_lamp(stage, rng.uniform(0, 6.28), math.radians(rng.uniform(8, 55)))
    return land


def meadow(stage, ground, blades, length):
    """Grass on a ground that is its own; blades and their length are ranges."""
    rng = stage.rng
    n = m.Nodes("grass")
    tint = rng.choice(((0.08, 0.2, 0.03), (0.2, 0.25, 0.06), (0.3, 0.25, 0.1)))
    shade = n.mix(n.new("ShaderNodeHairInfo").outputs["Random"], tint, tuple(c * 2 for c in tint))
    mix = n.new("ShaderNodeMixShader")
    mix.inputs[0].default_value = 0.35
    n.set(mix.inputs[1], n.shader("ShaderNodeBsdfDiffuse", Color=shade))
    n.set(mix.inputs[2], n.shader("ShaderNodeBsdfTranslucent", Color=shade))
    settings = grow(
        stage,
        ground,
        rng.randint(*blades),
        rng.uniform(*length),
        n.finish(mix.outputs[0]),
        rng.uniform(0, 0.4),
    )
    settings.radius_scale = 0.009


def bush(stage, at, size, translucent=False):
    """Leaf cards on the ground."""
    rng, sets = stage.rng, [] if translucent else stage.library.texture_sets("leaf")
    green = m.from_maps(rng, rng.choice(sets), 1.0, alpha=True) if sets else m.translucent(rng, (rng.uniform(0.05, 0.3), rng.uniform(0.2, 0.4), 0.05))
    stage.add(shapes.leaves(rng, rng.randint(300, 1200), size * 0.5, size * rng.uniform(0.06, 0.2)), green, (at[0], at[1], at[2] + size * 0.35))


def tree(stage, at, height):
    """A made tree: trunk, branches, crowns of leaf cards."""
    rng, lib = stage.rng, stage.library
    bark = palette.choose(rng, lib, "bark")
    base = Vector(at)
    points = [base + Vector((rng.gauss(0, 0.05) * k, rng.gauss(0, 0.05) * k, height * 0.12 * k)) for k in range(6)]
    stage.add(shapes.tube(points, height * 0.02), bark)
    for _ in range(rng.randint(4, 8)):
        start = points[rng.randint(2, 5)]
        end = start + Vector((rng.gauss(0, 1), rng.gauss(0, 1), rng.uniform(0.3, 1.0))) * height * 0.15
        stage.add(shapes.tube([start, start.lerp(end, 0.4) + Vector((0, 0, 0.05)), end], height * 0.008), bark)
        bush(stage, end - Vector((0, 0, height * 0.08)), height * 0.35)


def many_lights(stage):
    """A dark table, room corner or yard under tens of small lights."""
    rng, lib = stage.rng, stage.library
    stage.add(shapes.box((8, 8, 0.1), 0, (0, 0, -0.05)), palette.choose(rng, lib, rng.choice(("floor", "road"))))
    for side, turn in (((0, 2.0, 0), 0.0), ((2.0, 0, 0), -math.pi / 2), ((-2.2, 0, 0), math.pi / 2)):
        stage.add(shapes.box((8, 0.2, 3), 0, (0, 0.1, 1.5)), palette.walls(rng, lib), side, turn)
    for _ in range(rng.randint(8, 20)):
        at = (rng.uniform(-1.5, 1.5), rng.uniform(-1.0, 1.7), 0)
        props.small(stage, at, 1.2)
        stage.interest.append(Vector(at) + Vector((0, 0, 0.2)))
    glows = [m.light(rng, rng.uniform(20, 200), None if rng.random() < 0.5 else m.color(rng, (0.5, 1.0), (0.8, 1.0))) for _ in range(5)]
    for _ in range(rng.randint(2, 6)):  # strings of bulbs
        a, b = (Vector((rng.uniform(-2, 2), rng.uniform(-1, 1.9), rng.uniform(1.0, 2.6))) for _ in range(2))
        count = rng.randint(8, 24)
        for i in range(count):
            p = a.lerp(b, i / (count - 1)) - Vector((0, 0, 0.4 * math.sin(math.pi * i / (count - 1))))
            stage.add(shapes.sphere(rng.uniform(0.008, 0.02), 2), rng.choice(glows), p)
    for _ in range(rng.randint(0, 4)):
        neon(stage, (rng.uniform(-1.5, 1.5), 1.9, rng.uniform(0.8, 2.0)))
    for _ in range(rng.randint(2, 8)):
        props.candle(stage, (rng.uniform(-1.5, 1.5), rng.uniform(-1, 1.6), 0))
    darkness(stage, rng.uniform(0, 0.02))


def glints(stage):
    """A low sun mirrored in small things: wet ground, ripples, chrome, flakes of metal, cars."""
    rng, lib = stage.rng, stage.library
    way = rng.choice(("wet", "water", "metal"))
    if way == "water":
        level = rng.uniform(0.02, 0.1)
        waves = [(rng.uniform(2, 40), rng.uniform(2, 40), rng.uniform(0, 6.28)) for _ in range(7)]
        # The steeper a wave is the shorter it is; all are far too small for a pixel to show one whole glint.
        lake = shapes.terrain(
            12, 300, lambda x, y: sum(0.02 / (a + b) * math.sin(a * x + b * y + c) for a, b, c in waves)
        )
        stage.add(
            lake,
            m.Nodes("water").principled(
                Base_Color=(0.01, 0.03, 0.03), Roughness=rng.uniform(0.0, 0.1), IOR=1.33
            ),
            (0, 0, level),
        )
        stage.add(shapes.terrain(40, 60, height_field(rng, 0.3)), palette.choose(rng, lib, "ground"))
    else:
        ground = (
            m.embossed(rng, rng.uniform(0.05, 0.3))
            if way == "metal"
            else wet(stage, palette.choose(rng, lib, "road"))
        )
        stage.add(shapes.box((40, 40, 0.1), 0, (0, 0, -0.05)), ground)
    things = lib.with_role("vehicle", "figure", "building", smallest=0.4, largest=7)
    for _ in range(rng.randint(6, 16)):
        at = (rng.gauss(0, 2.0), rng.gauss(0, 2.0), 0.0)
        if things and rng.random() < 0.4:
            stage.model(rng.choice(things)).place(at, rng.uniform(0, 6.28))
        else:
            make = rng.choice(
                (
                    lambda: shapes.sphere(rng.uniform(0.1, 0.5), 5),
                    lambda: shapes.monkey(rng.uniform(0.4, 1.2)),
                    lambda: shapes.torus(0.4, 0.1),
                    lambda: shapes.gem(rng, 0.5),
                    lambda: shapes.vessel(rng, rng.uniform(0.4, 1.2), 0.01),
                )
            )
            stage.add(
                make(),
                rng.choice((m.metal, m.metal, m.glass, m.plastic, lambda r: m.embossed(r, 0.1)))(rng),
                at,
                rng.uniform(0, 6.28),
            )
        stage.interest.append(Vector(at) + Vector((0, 0, 0.3)))
    environment(stage, DAY, rng.uniform(0.2, 0.8), ("night", "moon"))
    sun_lamp(stage, rng.uniform(0, 6.28), math.radians(rng.uniform(4, 25)))


def backdrop(stage):
    """Figures, vehicles and things before a photographed place that fills half the frame."""
    rng, lib = stage.rng, stage.library
    things = lib.with_role("figure", "vehicle", "plant", "nature", "chair", "prop", smallest=0.3, largest=6)
    for _ in range(rng.randint(3, 8)):
        at = (rng.gauss(0, 1.5), rng.gauss(0, 1.5), 0.0)
        if things and rng.random() < 0.8:
            group = stage.model(rng.choice(things)).place(at, rng.uniform(0, 6.28))
            stage.interest.append(Vector(at) + Vector((0, 0, group.size.z * rng.uniform(0.5, 1.0))))
        else:
            stage.add(
                shapes.monkey(rng.uniform(0.5, 1.2)), palette.anything(rng, lib), at, rng.uniform(0, 6.28)
            )
            stage.interest.append(Vector(at) + Vector((0, 0, 0.6)))
    if rng.random() < 0.5:
        stage.add(
            shapes.box((6, 6, 0.1), 0.02, (0, 0, -0.05)),
            palette.choose(rng, lib, rng.choice(("floor", "road", "ground"))),
        )
    environment(stage, ("",), rng.uniform(0.5, 2.0))
    if rng.random() < 0.3:
        sun_lamp(stage, rng.uniform(0, 6.28), math.radians(rng.uniform(15, 60)))
    stage.least_covered = 0.2


def add_fog(stage, size, center, density):
    """A box of haze around the scene, even or in drifts."""
    rng = stage.rng
    n = m.Nodes("fog")
    amount = density
    if rng.random() < 0.35:
        amount = n.math("MULTIPLY", n.ramp(n.noise(n.place(1.0), rng.uniform(0.3, 1.0), 3), (0.4, 0.0), (0.7, 1.0)), density * 2)
    n.set(n.output.inputs["Volume"], n.shader("ShaderNodeVolumePrincipled", Color=(0.9, 0.92, 0.95), Density=amount, Anisotropy=rng.uniform(0, 0.7)))
    stage.add(shapes.box(size, 0, center), n.material)
    stage.scene.cycles.volume_bounces = rng.choice((0, 1, 2))


def spots_in_fog(stage, count, reach, height, strength=1.0):
    """Beams that show in the haze."""
    rng = stage.rng
    for _ in range(count):
        at = (rng.uniform(-reach, reach), rng.uniform(-reach, reach), height * rng.uniform(0.7, 1.0))
        stage.lamp(
            "SPOT",
            at,
            strength * rng.uniform(20, 100) * height * height,
            m.color(rng, (0, 0.6), (0.8, 1)),
            aim=(rng.uniform(-1, 1), rng.uniform(-1, 1), 0),
            spot_size=rng.uniform(0.3, 0.9),
            shadow_soft_size=0.03,
        )
