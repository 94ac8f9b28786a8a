"""Objects on a table or a sweep: studio shots, glass and caustics, hair and fur, skin and wax."""

import math

import bpy
from mathutils import Vector

from . import materials as m
from . import palette, props, shapes
from .stage import darkness, environment


def sweep(stage, material, size=4.0):
    """A backdrop that curves up behind the objects."""
    profile = [(-size, 0.0), (size * 0.3, 0.0)] + [
        (size * 0.3 + math.sin(a) * 0.5, 0.5 - math.cos(a) * 0.5) for a in (math.pi / 2 * i / 8 for i in range(1, 9))] + [(size * 0.3 + 0.5, size)]
    steps = [((y0, z0), (y1, z1)) for (y0, z0), (y1, z1) in zip(profile, profile[1:])]
    mesh = bpy.data.meshes.new("sweep")
    points = [(x, y, z) for y, z in profile for x in (-size, size)]
    mesh.from_pydata(points, [], [(2 * i, 2 * i + 1, 2 * i + 3, 2 * i + 2) for i in range(len(steps))])
    uv = mesh.uv_layers.new()
    length = [0.0]
    for (y0, z0), (y1, z1) in steps:
        length.append(length[-1] + math.hypot(y1 - y0, z1 - z0))
    for loop in mesh.loops:
        uv.data[loop.index].uv = (points[loop.vertex_index][0], length[loop.vertex_index // 2])
    mesh.polygons.foreach_set("use_smooth", [True] * len(mesh.polygons))
    return stage.add(bpy.data.objects.new("sweep", mesh), material)


def softboxes(stage, center, count, energy):
    """Area lights around the objects, as in a photographer's studio."""
    rng = stage.rng
    for _ in range(count):
        angle, r = rng.uniform(0, 2 * math.pi), rng.uniform(0.8, 2.0)
        at = Vector(center) + Vector((r * math.cos(angle), r * math.sin(angle), rng.uniform(0.4, 1.8)))
        stage.lamp("AREA", at, energy * rng.uniform(0.3, 1.5), rng.choice(((1, 1, 1), (1, 0.85, 0.7), (0.75, 0.85, 1), m.color(rng, (0.2, 0.8), (0.7, 1)))),
                   aim=center, shape="RECTANGLE", size=rng.uniform(0.05, 0.9), size_y=rng.uniform(0.05, 0.9))


def base_light(stage, dark_chance=0.3):
    """Softboxes, an environment, or both."""
    rng = stage.rng
    if rng.random() < dark_chance:
        darkness(stage, rng.uniform(0, 0.05))
        softboxes(stage, (0, 0, 0.1), rng.randint(1, 3), 25)
        return
    environment(stage, ("studio", "indoor", "room", "warehouse", "lounge"), rng.uniform(0.3, 1.5))
    if rng.random() < 0.5:
        softboxes(stage, (0, 0, 0.1), rng.randint(1, 2), 15)


def cluster(stage, count, spread, maker):
    """Things around the origin that do not stand in each other, made by `maker(at)`."""
    rng, spots = stage.rng, []
    for _ in range(count * 8):
        if len(spots) >= count:
            break
        spot = (rng.gauss(0, spread), rng.gauss(0, spread), 0.0)
        if all((spot[0] - a[0]) ** 2 + (spot[1] - a[1]) ** 2 > 0.02 for a in spots):
            spots.append(spot)
            maker(spot)
            stage.interest.append(Vector(spot) + Vector((0, 0, 0.08)))


def ground(stage):
    """Backdrop or table top, where there is to be one."""
    rng, lib = stage.rng, stage.library
    if not stage.backdrop:
        return
    material = m.paint(rng, (0.05, 0.95)) if rng.random() < 0.35 else palette.choose(rng, lib, rng.choice(("floor", "furniture", "fabric", "stone", "metal")))
    sweep(stage, material)


def studio(stage):
    """Products and props in every material, well lit."""
    ground(stage)
    cluster(stage, stage.rng.randint(4, 14), 0.22, lambda at: props.small(stage, at, 0.5))
    base_light(stage)


def shaderballs(stage):
    """A grid of balls, heads and knots, each another material: many materials in one view."""
    rng, lib = stage.rng, stage.library
    ground(stage)
    step = rng.uniform(0.18, 0.3)
    for i in range(-2, 3):
        for j in range(-2, 3):
            shape = rng.choice((lambda: shapes.sphere(0.08, 5), lambda: shapes.monkey(0.18), lambda: shapes.torus(0.06, 0.025),
                                lambda: shapes.box((0.12,) * 3, 0.01, (0, 0, 0.06)), lambda: shapes.vessel(rng, 0.15)))()
            at = (i * step + rng.gauss(0, 0.02), j * step + rng.gauss(0, 0.02), 0)
            stage.add(shape, palette.anything(rng, lib), at, rng.uniform(0, 6.28))
            stage.interest.append(Vector(at) + Vector((0, 0, 0.08)))
    base_light(stage)


def glass(stage):
    """Glass, liquids, gems, mirrors and hard lights: caustics and fireflies."""
    rng, lib = stage.rng, stage.library
    ground(stage)

    def thing(at):
        roll = rng.random()
        material = m.glass(rng) if rng.random() < 0.8 else rng.choice((m.mirror, m.metal))(rng)
        if roll < 0.35:
            height = rng.uniform(0.08, 0.25)
            stage.add(shapes.vessel(rng, height), material, at)
            if rng.random() < 0.5:  # something inside
                stage.add(shapes.sphere(height * 0.12, 3), palette.anything(rng, lib), (at[0], at[1], 0.006))
        elif roll < 0.55:
            stage.add(shapes.bottle(rng, rng.uniform(0.15, 0.35)), material, at)
        elif roll < 0.7:
            stage.add(shapes.gem(rng, rng.uniform(0.05, 0.15)), material, at, rng.uniform(0, 6))
        elif roll < 0.82:
            stage.add(shapes.sphere(rng.uniform(0.03, 0.1), 5), material, at)
        elif roll < 0.9:
            stage.add(shapes.box([rng.uniform(0.02, 0.15) for _ in range(3)], 0.004, (0, 0, 0.075)), material, at, rng.uniform(0, 6))
        else:
            props.small(stage, at, 0.3)

    cluster(stage, rng.randint(5, 14), 0.2, thing)
    if rng.random() < 0.3:  # water in a tray: ripples throw caustics on its floor
        water = shapes.terrain(1.2, 96, lambda x, y: 0.03 + 0.004 * (math.sin(23 * x + 9 * y) + math.sin(31 * y - 13 * x) + math.sin(47 * x)))
        stage.add(water, m.glass(rng, True))
    base_light(stage, 0.5)
    for _ in range(rng.randint(1, 2)):
        angle = rng.uniform(0, 6.28)
        at = (math.cos(angle) * 1.2, math.sin(angle) * 1.2, rng.uniform(0.6, 1.6))
        stage.lamp("SPOT", at, rng.uniform(20, 120), aim=(0, 0, 0.05), spot_size=0.6, shadow_soft_size=rng.uniform(0.005, 0.05))
    stage.scene.cycles.blur_glossy = rng.choice((0.0, 0.0, 1.0))


def embossed(stage):
    """Shapes and walls of one colour each, whose detail is all in their normals, under grazing light."""
    rng = stage.rng
    sweep(stage, m.embossed(rng, rng.uniform(0.05, 0.4)))
    wall = shapes.box((2.4, 0.06, 1.4), 0.005, (0, 0, 0.7))
    stage.add(
        wall,
        m.embossed(rng, rng.uniform(0.08, 0.5)),
        (rng.uniform(-0.3, 0.3), rng.uniform(0.5, 0.9), 0),
        rng.uniform(-0.4, 0.4),
    )

    def thing(at):
        make = rng.choice(
            (
                lambda: shapes.sphere(rng.uniform(0.06, 0.14), 5),
                lambda: shapes.monkey(rng.uniform(0.18, 0.3)),
                lambda: shapes.torus(0.08, 0.035),
                lambda: shapes.vessel(rng, rng.uniform(0.1, 0.3)),
                lambda: shapes.box([rng.uniform(0.1, 0.2) for _ in range(3)], 0.01, (0, 0, 0.1)),
            )
        )
        stage.add(make(), m.embossed(rng, rng.uniform(0.01, 0.08)), at, rng.uniform(0, 6.28))

    cluster(stage, rng.randint(4, 10), 0.28, thing)
    if rng.random() < 0.6:  # nearly along the wall
        darkness(stage, rng.uniform(0.02, 0.3))
        side = rng.choice((-1, 1))
        stage.lamp(
            "SPOT",
            (side * 2.0, rng.uniform(0.2, 0.45), rng.uniform(0.3, 1.2)),
            rng.uniform(100, 300),
            aim=(0, 0.3, 0.3),
            spot_size=1.2,
            shadow_soft_size=rng.uniform(0.01, 0.1),
        )
    else:
        base_light(stage)


def pool(stage):
    """Water over tiles, or rings and glasses in a hard light: caustics everywhere."""
    rng, lib = stage.rng, stage.library
    width, depth = rng.uniform(0.8, 2.0), rng.uniform(0.15, 0.5)
    tiled = m.tiles(rng) if rng.random() < 0.6 else palette.choose(rng, lib, "floor")
    walls = [((width, 0.1, depth), (0, side * width / 2, depth / 2)) for side in (-1, 1)]
    walls += [((0.1, width, depth), (side * width / 2, 0, depth / 2)) for side in (-1, 1)]
    stage.add(shapes.boxes([((width, width, 0.05), (0, 0, -0.02)), *walls], 0.005), tiled)
    stage.add(shapes.box((8, 8, 0.1), 0, (0, 0, -0.12)), palette.choose(rng, lib, "stone"))

    def thing(at):
        make = rng.choice(
            (
                lambda: shapes.sphere(rng.uniform(0.03, 0.12), 5),
                lambda: shapes.torus(0.07, 0.02),
                lambda: shapes.gem(rng, 0.12),
                lambda: shapes.vessel(rng, rng.uniform(0.1, 0.3)),
            )
        )
        stage.add(
            make(),
            rng.choice((m.glass, m.metal, m.plastic, lambda r: palette.anything(r, lib)))(rng),
            at,
            rng.uniform(0, 6.28),
        )

    cluster(stage, rng.randint(3, 9), width * 0.2, thing)
    if rng.random() < 0.7:
        level = depth * rng.uniform(0.4, 0.85)
        waves = [(rng.uniform(4, 40), rng.uniform(-30, 30), rng.uniform(0, 6.28)) for _ in range(5)]
        surface = shapes.terrain(
            width - 0.1,
            160,
            lambda x, y: level
            + sum(0.03 / (8 + abs(a) + abs(b)) * math.sin(a * x + b * y + c) for a, b, c in waves),
        )
        stage.add(surface, m.glass(rng, True))
    environment(stage, ("studio", "indoor", "sunny", "sky"), rng.uniform(0.2, 1.0))
    angle = rng.uniform(0, 6.28)
    stage.lamp(
        "SPOT",
        (2 * math.cos(angle), 2 * math.sin(angle), rng.uniform(1.5, 3)),
        rng.uniform(100, 500),
        aim=(0, 0, 0),
        spot_size=0.9,
        shadow_soft_size=rng.uniform(0.02, 0.15),
    )
    stage.scene.cycles.blur_glossy = rng.choice((0.0, 1.0))


def hair_material(rng):
    """Cycles' hair model, natural or dyed."""
    n = m.Nodes("hair")
    node = n.new("ShaderNodeBsdfHairPrincipled")
    if rng.random() < 0.7 and "Melanin" in node.inputs:
        node.parametrization = "MELANIN"
        node.inputs["Melanin"].default_value = rng.uniform(0.05, 1.0)
        node.inputs["Melanin Redness"].default_value = rng.uniform(0, 1)
    else:
        node.inputs["Color"].default_value = (*m.color(rng, (0.2, 0.9), (0.3, 0.9)), 1)
    node.inputs["Roughness"].default_value = rng.uniform(0.15, 0.5)
    node.inputs["Random Roughness"].default_value = 0.2
    return n.finish(node.outputs[0])


def grow(stage, obj, count, length, material, clump=0.0):
    """Particle hair on an object."""
    rng = stage.rng
    obj.data.materials.append(material)
    modifier = obj.modifiers.new("hair", "PARTICLE_SYSTEM")
    settings = modifier.particle_system.settings
    modifier.particle_system.seed = rng.randrange(1 << 16)
    settings.type = "HAIR"
    settings.count, settings.hair_length = max(count // 8, 50), length
    settings.hair_step = 4
    settings.display_step = settings.render_step = 4
    settings.child_type = "INTERPOLATED"
    settings.rendered_child_count = settings.child_percent = 8
    settings.clump_factor = clump
    settings.roughness_1, settings.roughness_2 = rng.uniform(0, 0.03) * length * 10, rng.uniform(0, 0.05) * length * 10
    settings.root_radius, settings.tip_radius = rng.uniform(0.3, 1.0), 0.1
    settings.radius_scale = 0.002 * rng.uniform(0.3, 1.0)
    settings.material = len(obj.data.materials)
    settings.tangent_factor = rng.uniform(0, 0.3) * length
    settings.brownian_factor = rng.uniform(0, 0.05)
    return settings


def hair(stage):
    """Fur balls, furry heads, brushes, shaggy rugs."""
    rng, lib = stage.rng, stage.library
    ground(stage)
    if rng.random() < 0.4:
        rug = stage.add(shapes.terrain(1.6, 24, lambda x, y: 0.003), palette.choose(rng, lib, "fabric"))
        grow(stage, rug, rng.randint(20000, 60000), rng.uniform(0.02, 0.06), hair_material(rng), rng.uniform(0, 0.7))

    def furry(at):
        if rng.random() < 0.35:
            props.small(stage, at, 0.4)
            return
        obj = rng.choice((lambda: shapes.sphere(rng.uniform(0.06, 0.14), 3), lambda: shapes.monkey(rng.uniform(0.2, 0.3)), lambda: shapes.torus(0.08, 0.035)))()
        stage.add(obj, m.subsurface(rng, skin=True), at, rng.uniform(0, 6))
        grow(stage, obj, rng.randint(6000, 30000), rng.uniform(0.015, 0.09), hair_material(rng), rng.uniform(-0.2, 0.8))

    cluster(stage, rng.randint(2, 6), 0.25, furry)
    base_light(stage)


def skin(stage):
    """Heads and shapes of skin, wax, marble, jade: light under the surface."""
    rng, lib = stage.rng, stage.library
    ground(stage)
    figures = lib.with_role("figure", largest=2.5)

    def body(at):
        roll = rng.random()
        if figures and roll < 0.3:
            group = stage.model(rng.choice(figures))
            scale = rng.uniform(0.25, 0.5) / max(group.size)
            group.place(at, rng.uniform(0, 6), scale)
            if rng.random() < 0.6:
                for obj in group.objects:
                    for slot in obj.material_slots:
                        slot.link = "OBJECT"
                        slot.material = m.subsurface(rng, skin=rng.random() < 0.6)
        elif roll < 0.85:
            obj = shapes.monkey(rng.uniform(0.15, 0.35)) if rng.random() < 0.6 else shapes.sphere(rng.uniform(0.05, 0.12), 5)
            stage.add(obj, m.subsurface(rng, skin=rng.random() < 0.6), at, rng.uniform(0, 6))
            texture = bpy.data.textures.new("lumps", "CLOUDS")
            texture.noise_scale = rng.uniform(0.03, 0.2)
            lumps = obj.modifiers.new("lumps", "DISPLACE")
            lumps.texture, lumps.strength = texture, rng.uniform(0.0, 0.03)
        else:
            props.small(stage, at, 0.3)

    cluster(stage, rng.randint(2, 6), 0.22, body)
    base_light(stage)
