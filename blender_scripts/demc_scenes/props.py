"""Things that furnish a scene: models of the library where there are any, made ones otherwise."""

import math

from mathutils import Vector

from . import materials as m
from . import palette, shapes


def small(stage, at, largest=0.5):
    """One thing for a table top, standing at `at`. Returns its objects."""
    rng = stage.rng
    models = stage.library.with_role("prop", "plant", "lamp", "figure", smallest=0.03, largest=largest)
    if models and rng.random() < 0.55:
        group = stage.model(rng.choice(models))
        if group:
            group.place(at, rng.uniform(0, 2 * math.pi))
            return group.objects
    return made(stage, at)


def made(stage, at, size=1.0):
    """One procedural table-top thing."""
    rng, library = stage.rng, stage.library
    turn = rng.uniform(0, 2 * math.pi)
    kind = rng.choice(("vessel", "vessel", "bottle", "books", "box", "sphere", "monkey", "torus", "gem", "card", "candle", "text", "fruit"))
    if kind == "books":
        return book_stack(stage, at, turn)
    if kind == "candle":
        return candle(stage, at)
    if kind == "fruit":
        return fruit(stage, at)
    material = palette.anything(rng, library)
    if kind == "vessel":
        obj = shapes.vessel(rng, rng.uniform(0.06, 0.3) * size)
        material = rng.choice((m.glass, m.glass, m.plastic, m.metal))(rng) if rng.random() < 0.7 else material
    elif kind == "bottle":
        obj, material = shapes.bottle(rng, rng.uniform(0.18, 0.35) * size), m.glass(rng)
    elif kind == "box":
        obj = shapes.box([rng.uniform(0.05, 0.25) * size for _ in range(3)], 0.004)
        obj.location.z = obj.dimensions.z / 2
    elif kind == "sphere":
        obj = shapes.sphere(rng.uniform(0.02, 0.1) * size)
    elif kind == "monkey":
        obj = shapes.monkey(rng.uniform(0.1, 0.25) * size)
    elif kind == "torus":
        obj = shapes.torus(rng.uniform(0.04, 0.1) * size, rng.uniform(0.01, 0.03) * size)
    elif kind == "gem":
        obj = shapes.gem(rng, rng.uniform(0.05, 0.15) * size)
        material = m.glass(rng) if rng.random() < 0.6 else material
    elif kind == "card":
        return framed(stage, (at[0], at[1], at[2]), rng.uniform(0.1, 0.25), rng.uniform(0.1, 0.25), turn)
    else:
        words = "".join(rng.choice("ABCDEFGHKLMNPRSTUVXYZ0123456789 ") for _ in range(rng.randint(2, 8)))
        obj = shapes.text(words, rng.uniform(0.05, 0.15) * size, 0.01 * size)
    return [stage.add(obj, material, at, turn)]


def book_stack(stage, at, turn):
    """Lying books, each its own cover; pages show at three sides."""
    rng, out, z = stage.rng, [], at[2]
    pages = m.paint(rng, (0.85, 0.95))
    for _ in range(rng.randint(1, 6)):
        w, d, h = rng.uniform(0.12, 0.22), rng.uniform(0.16, 0.3), rng.uniform(0.012, 0.05)
        angle = turn + rng.uniform(-0.2, 0.2)
        cover = shapes.boxes((((w, d, 0.003), (0, 0, 0.0015)), ((w, d, 0.003), (0, 0, h - 0.0015)), ((0.003, d, h), (-w / 2, 0, h / 2))))
        out.append(stage.add(cover, m.plastic(rng) if rng.random() < 0.7 else palette.choose(rng, stage.library, "print"), (at[0], at[1], z), angle))
        out.append(stage.add(shapes.box((w * 0.96, d * 0.97, h - 0.006), 0, (0, 0, h / 2)), pages, (at[0], at[1], z), angle))
        z += h
    return out


def candle(stage, at):
    """Wax with a flame that lights its surroundings."""
    rng = stage.rng
    height, radius = rng.uniform(0.04, 0.2), rng.uniform(0.015, 0.04)
    out = [stage.add(shapes.lathe([(0, 0), (radius, 0), (radius, height), (0, height * 0.97)]), m.subsurface(rng), at)]
    flame = shapes.lathe(shapes.curved([(0.001, 0), (0.006, 0.01), (0.001, 0.03)]), 16)
    out.append(stage.add(flame, m.light(rng, rng.uniform(100, 400), (1, 0.5, 0.15)), (at[0], at[1], at[2] + height + 0.01)))
    return out


def fruit(stage, at):
    """A bowl of round things."""
    rng, out = stage.rng, []
    for _ in range(rng.randint(3, 9)):
        r = rng.uniform(0.025, 0.045)
        spot = (at[0] + rng.uniform(-0.1, 0.1), at[1] + rng.uniform(-0.1, 0.1), at[2] + rng.choice((0, 0, r * 1.4)))
        out.append(stage.add(shapes.sphere(r), rng.choice((m.plastic, m.subsurface))(rng), spot))
    return out


def framed(stage, at, width, height, turn=0.0):
    """A picture, print or mirror in a frame, facing -Y before the turn; `at` is the base centre."""
    rng, library = stage.rng, stage.library
    bar = min(width, height) * rng.uniform(0.03, 0.1)
    frame = shapes.boxes((((width + 2 * bar, 0.02, bar), (0, 0.01, -bar / 2)), ((width + 2 * bar, 0.02, bar), (0, 0.01, height + bar / 2)),
                          ((bar, 0.02, height), (-width / 2 - bar / 2, 0.01, height / 2)), ((bar, 0.02, height), (width / 2 + bar / 2, 0.01, height / 2))), 0.003)
    at = (at[0], at[1], at[2] + bar)
    images = library.pictures + [s["color"] for s in library.texture_sets("print")]
    roll = rng.random()
    if roll < 0.2:
        surface = m.mirror(rng)
    elif images:
        surface = (m.screen if roll > 0.93 else m.picture)(rng, rng.choice(images))
    else:
        surface = rng.choice((m.marble, m.tiles, m.fabric))(rng)
    out = [stage.add(frame, palette.choose(rng, library, "furniture"), at, turn)]
    shown = shapes.plane(width, height, unit_uv=True)
    shown.location.y = 0.012
    out.append(stage.add(shown, surface, at, turn))
    return out


def scatter_on(stage, top, count, largest=0.5):
    """Puts small things on an object's upper surface, where a ray from above meets it."""
    rng = stage.rng
    low, high = top.low, top.high
    placed = []
    for _ in range(count * 3):
        if len(placed) >= count:
            break
        x, y = rng.uniform(low.x, high.x), rng.uniform(low.y, high.y)
        if any((x - a) ** 2 + (y - b) ** 2 < 0.03 for a, b in placed):
            continue
        z = stage.drop(x, y, high.z + 0.3)
        if z is None or z < high.z - 0.6 or z > high.z + 0.01:
            continue
        small(stage, (x, y, z), largest)
        placed.append((x, y))
        stage.interest.append(Vector((x, y, z + 0.1)))
    return len(placed)


def table(stage, at, turn, low=False):
    """A made table."""
    rng, library = stage.rng, stage.library
    w, d, h = rng.uniform(0.7, 1.8), rng.uniform(0.5, 0.9), rng.uniform(0.35, 0.5) if low else rng.uniform(0.7, 0.78)
    t, leg = rng.uniform(0.02, 0.05), rng.uniform(0.03, 0.08)
    top = shapes.box((w, d, t), 0.006, (0, 0, h - t / 2))
    wood = palette.choose(rng, library, "furniture")
    legs = shapes.boxes([((leg, leg, h - t), (sx * (w / 2 - leg), sy * (d / 2 - leg), (h - t) / 2)) for sx in (-1, 1) for sy in (-1, 1)], 0.004)
    top_material = m.glass(rng, True) if rng.random() < 0.15 else wood
    return [stage.add(top, top_material, at, turn), stage.add(legs, wood if rng.random() < 0.6 else m.metal(rng), at, turn)]


def chair(stage, at, turn):
    """A made chair: seat, back, legs."""
    rng, library = stage.rng, stage.library
    w, h = rng.uniform(0.4, 0.48), rng.uniform(0.42, 0.47)
    wood = palette.choose(rng, library, "furniture")
    frame = shapes.boxes([((0.035, 0.035, h), (sx * (w / 2 - 0.02), sy * (w / 2 - 0.02), h / 2)) for sx in (-1, 1) for sy in (-1, 1)]
                         + [((0.035, 0.03, 0.45), (sx * (w / 2 - 0.02), w / 2 - 0.02, h + 0.22)) for sx in (-1, 1)]
                         + [((w, 0.02, 0.07), (0, w / 2 - 0.02, h + 0.1 + 0.12 * i)) for i in range(3)], 0.004)
    seat = shapes.box((w, w, 0.05), 0.02, (0, 0, h))
    return [stage.add(frame, wood, at, turn), stage.add(seat, palette.choose(rng, library, "fabric"), at, turn)]


def sofa(stage, at, turn):
    """A made sofa of rounded cushions."""
    rng, library = stage.rng, stage.library
    w, d = rng.uniform(1.4, 2.4), rng.uniform(0.8, 1.0)
    cloth = palette.choose(rng, library, "fabric")
    body = shapes.boxes((((w, d, 0.25), (0, 0, 0.2)), ((w, 0.2, 0.7), (0, d / 2 - 0.1, 0.45)),
                         ((0.18, d, 0.55), (-w / 2, 0, 0.35)), ((0.18, d, 0.55), (w / 2, 0, 0.35))), 0.05)
    out = [stage.add(body, cloth, at, turn)]
    seats = rng.randint(2, 3)
    for i in range(seats):
        cushion = shapes.box((w / seats - 0.1, d - 0.2, 0.16), 0.06, ((i + 0.5 - seats / 2) * (w - 0.18) / seats, -0.1, 0.41), 4)
        out.append(stage.add(cushion, cloth, at, turn))
    for _ in range(rng.randint(0, 4)):
        pillow = shapes.box((0.45, 0.15, 0.4), 0.07, (rng.uniform(-w / 2 + 0.3, w / 2 - 0.3), d / 2 - 0.32, 0.68), 4)
        pillow.rotation_euler.x = -0.3
        out.append(stage.add(pillow, palette.choose(rng, library, "fabric"), at, turn))
    return out


def shelf(stage, at, turn):
    """A made bookcase, filled with books and things."""
    rng, library = stage.rng, stage.library
    w, d, h, rows = rng.uniform(0.7, 1.6), rng.uniform(0.25, 0.4), rng.uniform(1.0, 2.1), rng.randint(3, 6)
    t = 0.025
    wood = palette.choose(rng, library, "furniture")
    parts = [((t, d, h), (sx * w / 2, 0, h / 2)) for sx in (-1, 1)] + [((w, t / 2, h), (0, d / 2, h / 2))]
    parts += [((w, d, t), (0, 0, t / 2 + (h - t) * i / rows)) for i in range(rows + 1)]
    out = [stage.add(shapes.boxes(parts, 0.002), wood, at, turn)]
    covers = [m.plastic(rng) for _ in range(5)] + [palette.choose(rng, library, "print") for _ in range(3)]
    for row in range(rows):
        z, x = t + (h - t) * row / rows, -w / 2 + 0.04
        while x < w / 2 - 0.06:
            thick, tall, deep = rng.uniform(0.015, 0.06), rng.uniform(0.55, 0.85) * h / rows, rng.uniform(0.6, 0.9) * d
            if rng.random() < 0.85:
                book = shapes.box((thick, deep, tall), 0.002, (x + thick / 2, d / 2 - deep / 2 - 0.03, z + tall / 2))
                out.append(stage.add(book, rng.choice(covers), at, turn))
            else:
                thick = rng.uniform(0.05, 0.25)
            x += thick + 0.002
    return out


def plant(stage, at, height):
    """A potted plant of leaf cards, with the library's leaf pictures where there are any."""
    rng, library = stage.rng, stage.library
    pot = shapes.vessel(rng, height * 0.3, 0.01)
    out = [stage.add(pot, rng.choice((m.plastic, m.rough_stone, m.metal))(rng), at)]
    sets = library.texture_sets("leaf")
    material = m.from_maps(rng, rng.choice(sets), 1.0, alpha=True) if sets else m.plastic(rng)
    crown = shapes.leaves(rng, rng.randint(60, 250), height * 0.35, height * rng.uniform(0.08, 0.25))
    out.append(stage.add(crown, material, (at[0], at[1], at[2] + height * 0.65)))
    return out


def standing_lamp(stage, at, energy):
    """A lamp with a shade that glows and a bulb inside."""
    rng = stage.rng
    height = rng.uniform(1.2, 1.8)
    pole = shapes.lathe([(0, 0), (0.15, 0), (0.15, 0.02), (0.012, 0.03), (0.012, height), (0, height)])
    shade_r = rng.uniform(0.14, 0.25)
    shade = shapes.lathe([(shade_r, height - 0.15), (shade_r * rng.uniform(0.5, 1.0), height + 0.12)])
    bulb = shapes.sphere(0.03, 2)
    return [stage.add(pole, m.metal(rng), at), stage.add(shade, m.translucent(rng), at),
            stage.add(bulb, m.light(rng, energy), (at[0], at[1], at[2] + height - 0.05))]


def cable(stage, start, end):
    """A cable lying or hanging between two points."""
    rng = stage.rng
    points = [Vector(start).lerp(Vector(end), i / 7) + Vector((rng.gauss(0, 0.05), rng.gauss(0, 0.05), -0.1 * math.sin(math.pi * i / 7))) for i in range(8)]
    for point in points:
        point.z = max(point.z, 0.006)
    return stage.add(shapes.tube(points, rng.uniform(0.003, 0.008)), m.plastic(rng))
