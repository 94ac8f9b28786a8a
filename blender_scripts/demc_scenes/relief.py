"""Detail that normals alone show: mouldings, panelling, boards, fins and rails, of one colour with what they
are on.

Parts are (size, centre) boxes of a wall that runs along +X with its face at y = 0, seen from positive y, and
rises along +Z.
"""

import math

from mathutils import Vector

from . import materials as m
from . import palette, shapes


def moved(parts, x, y, z, side=1):
    """Parts elsewhere, with `side` -1 seen from negative y."""
    return [(size, (cx + x, side * cy + y, cz + z)) for size, (cx, cy, cz) in parts]


def frame(x0, x1, z0, z1, width, depth):
    """Four strips around a rectangle."""
    y, x, z = depth / 2, (x0 + x1) / 2, (z0 + z1) / 2
    return [((x1 - x0, depth, width), (x, y, z0 + width / 2)), ((x1 - x0, depth, width), (x, y, z1 - width / 2)),
            ((width, depth, z1 - z0 - 2 * width), (x0 + width / 2, y, z)),
            ((width, depth, z1 - z0 - 2 * width), (x1 - width / 2, y, z))]


def moulding(rng, x0, x1, z0, z1):
    """Frames one inside the other, each of its own height, as planed from one profile."""
    parts = []
    for _ in range(rng.randint(1, 4)):
        width = rng.uniform(0.008, 0.03)
        if min(x1 - x0, z1 - z0) < 4 * width:
            break
        parts += frame(x0, x1, z0, z1, width, rng.uniform(0.006, 0.03))
        step = width + rng.choice((0.0, rng.uniform(0.005, 0.06)))
        x0, x1, z0, z1 = x0 + step, x1 - step, z0 + step, z1 - step
    return parts


def panels(rng, x0, x1, height):
    """Moulded panels side by side, in one to three rows."""
    rows = sorted(rng.uniform(0.25, 0.75) * height for _ in range(rng.choice((0, 1, 1, 2))))
    count = max(1, round((x1 - x0) / rng.uniform(0.35, 1.3)))
    gap, parts = rng.uniform(0.04, 0.15), []
    for low, high in zip([0.12, *rows], [*rows, height - 0.12]):
        if high - low < 0.2:
            continue
        for i in range(count):
            a, b = (x0 + (x1 - x0) * k / count for k in (i, i + 1))
            if b - a > 3 * gap:
                parts += moulding(rng, a + gap, b - gap, low + gap / 2, high - gap / 2)
    return parts + [((x1 - x0, 0.025, 0.04), ((x0 + x1) / 2, 0.012, z)) for z in rows]


def boards(rng, x0, x1, height):
    """Boards with grooves between them, upright or lying, up to a rail or the ceiling."""
    top = height if rng.random() < 0.5 else rng.uniform(0.8, 1.5)
    pitch, groove, depth = rng.uniform(0.05, 0.18), rng.uniform(0.004, 0.015), rng.uniform(0.008, 0.02)
    if rng.random() < 0.6:
        count = max(1, int((x1 - x0) / pitch))
        size = ((x1 - x0) / count - groove, depth, top)
        parts = [(size, (x0 + (x1 - x0) * (i + 0.5) / count, depth / 2, top / 2)) for i in range(count)]
    else:
        count = max(1, int(top / pitch))
        size = (x1 - x0, depth, top / count - groove)
        parts = [(size, ((x0 + x1) / 2, depth / 2, top * (i + 0.5) / count)) for i in range(count)]
    return parts + [((x1 - x0, 2.5 * depth, 0.05), ((x0 + x1) / 2, depth * 1.25, top - 0.02))]


def battens(rng, x0, x1, height):
    """Upright laths with as much wall between them."""
    pitch = rng.uniform(0.03, 0.3)
    width, depth = pitch * rng.uniform(0.2, 0.6), rng.uniform(0.01, 0.04)
    return [((width, depth, height), (x0 + pitch * (i + 0.5), depth / 2, height / 2)) for i in range(int((x1 - x0) / pitch))]


def cornice(rng, length, height):
    """Steps between wall and ceiling."""
    parts, z, depth = [], height, rng.uniform(0.06, 0.2)
    while depth > 0.012 and len(parts) < 8:
        step = rng.uniform(0.01, 0.05)
        parts.append(((length, depth, step), (length / 2, depth / 2, z - step / 2)))
        z, depth = z - step, depth - rng.uniform(0.008, 0.05)
    return parts


def radiator(rng, x, width, height):
    """Fins or tubes side by side, and the rails that join them."""
    pitch, depth = rng.uniform(0.03, 0.07), rng.uniform(0.05, 0.1)
    count = max(3, int(width / pitch))
    parts = [((pitch * 0.5, depth, height), (x + (i - (count - 1) / 2) * pitch, 0.05 + depth / 2, 0.12 + height / 2)) for i in range(count)]
    return parts + [((count * pitch, depth * 0.4, 0.03), (x, 0.05 + depth / 2, 0.12 + height * k)) for k in (0.06, 0.94)]


def door(rng, x, height):
    """A leaf with moulded fields in a frame of several steps."""
    width = rng.uniform(0.75, 1.0)
    x0, x1 = x - width / 2, x + width / 2
    parts = [((width, 0.03, height), (x, 0.015, height / 2))]
    for k in range(rng.randint(1, 3)):
        reach = 0.03 * (k + 1)
        parts += frame(x0 - reach, x1 + reach, -0.1, height + reach, 0.03, 0.05 - 0.012 * k)
    columns, rows = rng.randint(1, 2), rng.randint(1, 5)
    for i in range(columns):
        for j in range(rows):
            field = (x0 + 0.1 + (width - 0.2) * i / columns, x0 + 0.1 + (width - 0.2) * (i + 1) / columns - 0.04,
                     0.15 + (height - 0.25) * j / rows, 0.15 + (height - 0.25) * (j + 1) / rows - 0.06)
            parts += moved(moulding(rng, *field), 0, 0.03, 0)
    return parts + [((0.12, 0.06, 0.02), (x1 - 0.1, 0.06, 1.0))]


def coffers(rng, width, depth, height):
    """Beams that cross under a ceiling."""
    nx, ny, size = rng.randint(2, 8), rng.randint(2, 8), rng.uniform(0.03, 0.18)
    drop = size * rng.uniform(0.4, 1.2)
    parts = [((size, depth, drop), (width * i / nx, depth / 2, height - drop / 2)) for i in range(nx + 1)]
    return parts + [((width, size, drop * 0.9), (width / 2, depth * i / ny, height - drop * 0.45)) for i in range(ny + 1)]


def dress(shell, wall, openings, material, trim):
    """Relief all over one wall of a room, around its openings, mostly of the wall's own material."""
    stage, rng = shell.stage, shell.stage.rng
    length, height = shell.wall_length(wall), shell.height
    cover = rng.choice((panels, panels, boards, battens, None))
    parts, trims = [], []
    for x0, x1 in shell.gaps(wall, openings, margin=0.12, least=0.15):
        if x1 - x0 > 1.6 and rng.random() < 0.35:
            at = rng.uniform(x0 + 0.75, x1 - 0.75)
            trims += door(rng, at, min(rng.uniform(1.95, 2.2), height - 0.15))
            stretches = [(x0, at - 0.62), (at + 0.62, x1)]
        else:
            stretches = [(x0, x1)]
        for a, b in stretches:
            if cover and b - a > 0.15:
                parts += cover(rng, a, b, height)
    for a, b, low, high in openings:
        reach = rng.uniform(0.06, 0.14)
        trims += moulding(rng, a - reach, b + reach, low - reach, high + reach)
        if low > 0.5 and rng.random() < 0.5:
            trims += radiator(rng, (a + b) / 2, (b - a) * rng.uniform(0.5, 0.9), low - 0.25)
    if rng.random() < 0.7:
        trims += cornice(rng, length, height)
    at, turn = shell.wall_point(wall, 0), wall * math.pi / 2
    if parts:
        stage.add(shapes.boxes(parts), material if rng.random() < 0.75 else trim, at, turn)
    if trims:
        stage.add(shapes.boxes(trims), trim if rng.random() < 0.6 else material, at, turn)
    for _ in range(2):
        point = Vector(shell.wall_point(wall, rng.uniform(0.1, 0.9) * length, 0.05))
        stage.interest.append(point + Vector((0, 0, rng.uniform(0.3, 0.95) * height)))


def rails(rng, x0, x1, z, y):
    """A balustrade: posts, thin bars, hand rail."""
    high, pitch, bar = rng.uniform(0.8, 1.1), rng.uniform(0.07, 0.16), rng.uniform(0.012, 0.05)
    parts = [((x1 - x0, 0.06, 0.05), ((x0 + x1) / 2, y, z + h)) for h in (0.08, high)]
    parts += [((bar, bar, high), (x0 + pitch * (i + 0.5), y, z + high / 2)) for i in range(int((x1 - x0) / pitch))]
    posts = max(1, round((x1 - x0) / 2.0))
    return parts + [((0.1, 0.1, high + 0.08), (x0 + (x1 - x0) * i / posts, y, z + high / 2)) for i in range(posts + 1)]


def roof(rng, width, depth, rise, overhang):
    """A gable of two slopes, shingled: rows of boxes with joints, thrown a little."""
    rows, parts = max(6, int(math.hypot(depth / 2, rise) / rng.uniform(0.12, 0.3))), []
    for row in range(rows):
        t = (row + 0.5) / rows
        tile, x = rng.uniform(0.15, 0.5), -width / 2 - overhang
        while x < width / 2 + overhang:
            wide = tile * rng.uniform(0.7, 1.3)
            for side in (-1, 1):
                parts.append(((wide - 0.012, (depth / 2 + overhang) / rows * 1.25, rise / rows * 1.25),
                              (x + wide / 2, side * (depth / 2 + overhang) * (1 - t), rise * t + rng.uniform(-0.006, 0.006))))
            x += wide
    return parts


def house(stage):
    """A house of boards, shingles, mullions and rails, in one or two colours; looked at from its garden."""
    rng, lib = stage.rng, stage.library
    stage.add(shapes.box((80, 80, 0.1), 0, (0, 0, -0.05)), palette.choose(rng, lib, "ground", 0.1))
    walls = m.paint(rng, (0.15, 0.95))
    trim = walls if rng.random() < 0.4 else m.paint(rng, (0.1, 0.95))
    tiles = m.rough_stone(rng) if rng.random() < 0.5 else m.paint(rng, (0.02, 0.3))
    for k in range(rng.randint(1, 3)):  # wings
        w, d, h = rng.uniform(5, 11), rng.uniform(4, 8), rng.uniform(2.8, 6.5)
        at, turn = ((rng.uniform(-4, 4) if k else 0.0), 5.0 + 2.5 * k, 0.0), rng.choice((0.0, 0.0, math.pi / 2))
        stage.add(shapes.box((w, d, h), 0, (0, d / 2, h / 2)), walls, at, turn)
        pitch = rng.uniform(0.09, 0.25)
        if rng.random() < 0.3:
            clad = moved(battens(rng, 0, w, h), -w / 2, 0, 0, -1)
        else:
            clad = [((w + 2 * out, d + 2 * out, pitch * share), (0, d / 2, pitch * (i + level))) for i in range(int(h / pitch))
                    for out, share, level in ((0.03, 0.55, 0.275), (0.012, 0.45, 0.775))]
        stage.add(shapes.boxes(clad), walls, at, turn)
        details, columns = [], max(2, int(w / rng.uniform(1.4, 2.6)))
        glass = []
        for i in range(columns):
            for j in range(max(1, int(h / 2.8))):
                x, z = (i + 0.5) * w / columns - w / 2, 1.5 + 2.7 * j
                ww, wh = w / columns * rng.uniform(0.35, 0.6), rng.uniform(1.0, 1.5)
                if z + wh / 2 > h - 0.2:
                    continue
                glass.append(((ww, 0.02, wh), (x, -0.035, z)))
                around = moulding(rng, x - ww / 2 - 0.1, x + ww / 2 + 0.1, z - wh / 2 - 0.1, z + wh / 2 + 0.1)
                details += moved(around, 0, -0.03, 0, -1)
                bars = rng.randint(1, 4)
                details += [((0.03, 0.05, wh), (x + ww * (b / bars - 0.5), -0.05, z)) for b in range(bars + 1)]
                details += [((ww, 0.05, 0.03), (x, -0.05, z + wh * (b / bars - 0.5))) for b in range(bars + 1)]
                if rng.random() < 0.2:  # shutters of slats
                    details += [((ww * 0.4, 0.03, 0.03), (x + s * ww * 0.75, -0.05, z + wh * (b / 14 - 0.5))) for b in range(15) for s in (-1, 1)]
        if rng.random() < 0.7:  # a porch
            out = rng.uniform(1.2, 2.5)
            details += [((w, out, 0.2), (0, -out / 2, 0.1)), ((w, out + 0.2, 0.12), (0, -out / 2, 2.6))]
            details += rails(rng, -w / 2 + 0.05, w / 2 - rng.uniform(0.05, w * 0.4), 0.2, -out + 0.1)
            details += [((0.14, 0.14, 2.4), (-w / 2 + 0.1 + (w - 0.2) * i / 4, -out + 0.1, 1.4)) for i in range(5)]
        details += moved(cornice(rng, w, h), -w / 2, 0, 0, -1)
        dark = m.Nodes("window").principled(Base_Color=(0.02, 0.025, 0.03), Roughness=0.03, Coat_Weight=1.0)
        for parts, material in ((glass, dark), (details, trim)):
            if parts:
                stage.add(shapes.boxes(parts), material, at, turn)
        shingles = moved(roof(rng, w, d, rng.uniform(1.0, 3.0), rng.uniform(0.1, 0.5)), 0, d / 2, h)
        stage.add(shapes.boxes(shingles), tiles, at, turn)
        stage.interest += [Vector((at[0] + rng.uniform(-w / 2, w / 2), at[1], rng.uniform(0.5, h))) for _ in range(3)]
    fence = rails(rng, -10, 10, 0, 0)
    if rng.random() < 0.4:
        stage.add(shapes.boxes(fence), trim, (0, rng.uniform(-1, 1.5), 0))
