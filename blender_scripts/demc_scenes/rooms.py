"""Furnished interiors: walls with windows, furniture along them, things on tables, lamps, clutter.

The room spans x in [0, width], y in [0, depth], z in [0, height]; its walls have real thickness, so
daylight comes in through windows alone.
"""

import math

from mathutils import Matrix, Vector

from . import materials as m
from . import palette, props, relief, shapes
from .outside import DAY, bush
from .stage import darkness, environment

_THICK = 0.25


class Room:
    """The shell of a room and what light it has."""

    def __init__(self, stage, width, depth, height, relief=False, sunlit=False):
        self.stage, self.width, self.depth, self.height = stage, width, depth, height
        self.relief = relief  # whether walls and ceiling are dressed
        # How far sunbeams sink for each metre into the room; None where the sun is not what the room is
        # about.
        self.sunbeam = stage.rng.uniform(0.2, 1.1) if sunlit else None
        self.windows = []  # (centre, inward normal, width, height)

    def wall_point(self, wall, along, off=0.0):
        """A point on the floor at `along` metres of a wall, `off` metres into the room."""
        w, d = self.width, self.depth
        return ((along, off, 0), (w - off, along, 0), (w - along, d - off, 0), (off, d - along, 0))[wall]

    def wall_length(self, wall):
        return self.width if wall % 2 == 0 else self.depth

    def gaps(self, wall, openings, margin=0.0, least=0.01):
        """The stretches of a wall's foot outside its openings and a margin around each."""
        edges = [0.0] + [v for a, b, *_ in sorted(openings) for v in (a - margin, b + margin)] + [self.wall_length(wall)]
        return [(a, b) for a, b in zip(edges[::2], edges[1::2]) if b - a > least]

    # A thing made to face -Y, standing with its back to a wall, faces into the room after this turn.
    @staticmethod
    def wall_turn(wall):
        return (math.pi, -math.pi / 2, 0.0, math.pi / 2)[wall]


def room(stage, mood=None, relief=False, sunlit=False):
    """A furnished room; `mood` is day, night or dim."""
    rng = stage.rng
    mood = mood or rng.choice(("day", "day", "day", "night", "dim"))
    shell = Room(stage, rng.uniform(2.8, 6.5), rng.uniform(3.0, 7.5), rng.uniform(2.35, 3.4), relief, sunlit)
    build_shell(shell, windows=rng.randint(1, 4))
    furnish(shell)
    decorate_walls(shell)
    clutter(shell)
    if sunlit:
        sunbeams(shell)
    else:
        lights(shell, mood)
    return shell


def build_shell(shell, windows):
    """Floor, ceiling, walls, openings, trims."""
    stage, rng, lib = shell.stage, shell.stage.rng, shell.stage.library
    w, d, h = shell.width, shell.depth, shell.height
    floor = shapes.box((w + 0.4, d + 0.4, 0.1), 0, (w / 2, d / 2, -0.05))
    stage.add(floor, palette.choose(rng, lib, "floor", 0.15))
    ceiling = palette.choose(rng, lib, "floor") if rng.random() < 0.1 else m.paint(rng, (0.75, 0.95))
    stage.add(shapes.box((w + 0.4, d + 0.4, 0.1), 0, (w / 2, d / 2, h + 0.05)), ceiling)
    paint = (lambda rng, _: m.paint(rng)) if shell.relief else palette.walls
    base, accent = paint(rng, lib), paint(rng, lib)
    trim = m.paint(rng, (0.1, 0.95)) if rng.random() < 0.6 else palette.choose(rng, lib, "furniture")
    per_wall = [[] for _ in range(4)]
    for _ in range(windows):
        wall = rng.randrange(4)
        length = shell.wall_length(wall)
        ww, sill = rng.uniform(0.6, min(2.2, length * 0.5)), rng.choice((0.05, rng.uniform(0.6, 1.0)))
        wh = rng.uniform(0.9, h - 0.3 - sill)
        u = rng.uniform(0.3, length - ww - 0.3)
        if all(u > b + 0.2 or u + ww < a - 0.2 for a, b, _, _ in per_wall[wall]):
            per_wall[wall].append((u, u + ww, sill, sill + wh))
    for wall in range(4):
        parts = wall_parts(shell.wall_length(wall), h, per_wall[wall])
        material = accent if rng.random() < 0.3 else base
        stage.add(shapes.boxes(parts), material, shell.wall_point(wall, 0), wall * math.pi / 2)
        if shell.relief:
            relief.dress(shell, wall, per_wall[wall], material, trim)
        for opening in per_wall[wall]:
            window(shell, wall, opening, trim)
        if rng.random() < 0.8:
            height = rng.uniform(0.06, 0.14)
            skirting = [((x1 - x0, 0.02, height), ((x0 + x1) / 2, 0.01, height / 2))
                        for x0, x1 in shell.gaps(wall, [o for o in per_wall[wall] if o[2] < height])]
            stage.add(shapes.boxes(skirting, 0.004), trim, shell.wall_point(wall, 0), wall * math.pi / 2)
    if shell.relief and rng.random() < 0.4:
        stage.add(shapes.boxes(relief.coffers(rng, w, d, h)), ceiling)
    elif rng.random() < 0.2:
        beams = [((w, 0.12, 0.16), (w / 2, d * (i + 0.5) / 4, h - 0.08)) for i in range(4)]
        stage.add(shapes.boxes(beams, 0.01), palette.choose(rng, lib, "furniture"))


def wall_parts(length, height, openings):
    """Boxes of a wall along +X at y in [-thick, 0], around its openings (u0, u1, v0, v1)."""
    us = sorted({-_THICK, length + _THICK, *(u for o in openings for u in o[:2])})
    parts = []
    for u0, u1 in zip(us, us[1:]):
        holes = sorted(o[2:] for o in openings if o[0] <= u0 + 1e-6 and o[1] >= u1 - 1e-6)
        v = 0.0
        for low, high in holes + [(height, height)]:
            if low - v > 1e-3:
                parts.append(((u1 - u0, _THICK, low - v), ((u0 + u1) / 2, -_THICK / 2, (v + low) / 2)))
            v = high
    return parts


def window(shell, wall, opening, trim):
    """Frame, bars, pane, sill, and a curtain or blinds."""
    stage, rng = shell.stage, shell.stage.rng
    u0, u1, v0, v1 = opening
    w, h, u, bar = u1 - u0, v1 - v0, (u0 + u1) / 2, rng.uniform(0.04, 0.08)
    at, turn = shell.wall_point(wall, 0), wall * math.pi / 2
    y = -_THICK * 0.6
    parts = [((w, bar, bar), (u, y, v0 + bar / 2)), ((w, bar, bar), (u, y, v1 - bar / 2)),
             ((bar, bar, h), (u0 + bar / 2, y, (v0 + v1) / 2)), ((bar, bar, h), (u1 - bar / 2, y, (v0 + v1) / 2))]
    for i in range(1, rng.randint(1, 4)):
        parts.append(((bar * 0.6, bar * 0.8, h), (u0 + w * i / 3, y, (v0 + v1) / 2)))
    for i in range(1, rng.randint(1, 3)):
        parts.append(((w, bar * 0.8, bar * 0.6), (u, y, v0 + h * i / 2)))
    parts.append(((w + 0.1, 0.2, 0.03), (u, 0.0, v0 - 0.015)))
    stage.add(shapes.boxes(parts, 0.004), trim, at, turn)
    if rng.random() < 0.6:
        stage.add(shapes.box((w, 0.008, h), 0, (u, y, (v0 + v1) / 2)), m.pane(rng), at, turn)
    roll = rng.random()
    if shell.sunbeam:
        screen(shell, opening, at, turn)
    elif roll < 0.45:
        cloth = m.translucent(rng) if rng.random() < 0.7 else palette.choose(rng, stage.library, "fabric")
        for side in (-1, 1):
            width = w * rng.uniform(0.15, 0.55)
            drop = min(v1 + 0.15, shell.height)
            curtain = shapes.sheet(width, drop - 0.02, rng.randint(4, 9), 0.04)
            curtain.location = (u + side * (w / 2 + 0.1 - width / 2), 0.12, 0.02)
            stage.add(curtain, cloth, at, turn)
    elif roll < 0.6:
        slats = [((w, 0.04, 0.003), (u, 0.03, v0 + i * 0.045)) for i in range(int(h / 0.045))]
        stage.add(shapes.boxes(slats), m.paint(rng), at, turn)
    # Where the light comes from, for lamps placed outside and portals in the opening.
    outside = Vector(shell.wall_point(wall, u, -1.5)) + Vector((0, 0, (v0 + v1) / 2))
    inside = Vector(shell.wall_point(wall, u, 1.5)) + Vector((0, 0, (v0 + v1) / 2))
    shell.windows.append((outside, inside, w, h))


def screen(shell, opening, at, turn):
    """What breaks sunlight into stripes: blinds, bars, a lattice, or leaves outside."""
    stage, rng = shell.stage, shell.stage.rng
    u0, u1, v0, v1 = opening
    w, h, u, v = u1 - u0, v1 - v0, (u0 + u1) / 2, (v0 + v1) / 2
    pitch, thin = rng.uniform(0.03, 0.15), rng.uniform(0.004, 0.03)
    material = m.paint(rng, (0.02, 0.95)) if rng.random() < 0.7 else palette.choose(rng, stage.library, "furniture")
    rows = [v0 + (i + 0.5) * pitch for i in range(int(h / pitch))]
    columns = [u0 + (i + 0.5) * pitch for i in range(int(w / pitch))]
    way = rng.choice(("blinds", "blinds", "blinds", "vertical", "bars", "lattice", "leaves", "none"))
    if way == "blinds":
        # Open to the sun.
        depth, tilt = pitch * rng.uniform(0.5, 1.0), rng.uniform(-0.5, 0.5) - math.atan(shell.sunbeam)
        stage.add(shapes.boxes([((w, depth, 0.003), (u, 0.05, z)) for z in rows], turn=Matrix.Rotation(tilt, 4, "X")), material, at, turn)
    elif way == "vertical":
        slats = [((pitch * 0.9, 0.003, h), (x, 0.08, v)) for x in columns]
        stage.add(shapes.boxes(slats, turn=Matrix.Rotation(rng.uniform(0.9, 2.2), 4, "Z")), material, at, turn)
    elif way in ("bars", "lattice"):
        bars = [((thin, thin, h), (x, -_THICK, v)) for x in columns]
        if way == "lattice":
            bars += [((w, thin, thin), (u, -_THICK, z)) for z in rows]
        stage.add(shapes.boxes(bars), material, at, turn)
    elif way == "leaves":
        for _ in range(rng.randint(1, 3)):
            out = Vector(shell.wall_point(0, u + rng.uniform(-w, w), -rng.uniform(0.6, 2.0))) + Vector((0, 0, v + rng.uniform(-0.3, 1.0)))
            bush(stage, Matrix.Translation(at) @ Matrix.Rotation(turn, 4, "Z") @ out, rng.uniform(0.6, 1.5))


def furnish(shell):
    """Furniture along the walls, a group in the middle, plants and lamps in between."""
    stage, rng, lib = shell.stage, shell.stage.rng, shell.stage.library
    middle(shell)
    for _ in range(rng.randint(8, 18)):  # what finds no room is left out
        along_wall(shell)
    if rng.random() < 0.6:
        w, d = rng.uniform(1.2, 2.6), rng.uniform(1.0, 2.0)
        carpet = shapes.box((w, d, 0.012), 0.004, (0, 0, 0.006))
        stage.add(carpet, palette.choose(rng, lib, "rug"), (shell.width * rng.uniform(0.35, 0.65), shell.depth * rng.uniform(0.35, 0.65), 0), rng.uniform(-0.2, 0.2))
    for _ in range(rng.randint(0, 3)):
        spot = empty_spot(shell, 0.5)
        if spot:
            stage.taken.append((spot[0] - 0.25, spot[1] - 0.25, spot[0] + 0.25, spot[1] + 0.25))
            models = lib.with_role("plant", largest=1.5)
            if models and rng.random() < 0.5:
                stage.model(rng.choice(models)).place(spot, rng.uniform(0, 6.28), rng.uniform(0.7, 1.3))
            else:
                props.plant(stage, spot, rng.uniform(0.5, 1.4))


def empty_spot(shell, size, margin=0.15):
    """A free square of the floor, or None."""
    stage, rng = shell.stage, shell.stage.rng
    for _ in range(20):
        x = rng.uniform(margin + size / 2, shell.width - margin - size / 2)
        y = rng.uniform(margin + size / 2, shell.depth - margin - size / 2)
        if stage.free((x - size / 2, y - size / 2, x + size / 2, y + size / 2)):
            return (x, y, 0.0)
    return None


def stand(shell, maker, at, turn, size):
    """Places what `maker(at, turn)` builds if its rectangle is free and inside; returns its Group."""
    from .stage import Group
    stage = shell.stage
    w, d = (size if abs(math.cos(turn)) > 0.5 else (size[1], size[0]))
    box = (at[0] - w / 2, at[1] - d / 2, at[0] + w / 2, at[1] + d / 2)
    if box[0] < -0.02 or box[1] < -0.02 or box[2] > shell.width + 0.02 or box[3] > shell.depth + 0.02 or not stage.free(box):
        return None
    stage.taken.append(box)
    group = Group(maker(at, turn))
    stage.interest.append((group.low + group.high) / 2)
    return group


def along_wall(shell):
    """One piece of furniture with its back to a wall, and what stands on it."""
    stage, rng, lib = shell.stage, shell.stage.rng, shell.stage.library
    wall = rng.randrange(4)
    length = shell.wall_length(wall)
    turn = shell.wall_turn(wall)
    models = lib.with_role("wall", "sofa", "bed", "table", "lamp", smallest=0.5, largest=min(length, 3.3))
    if models and rng.random() < 0.6:
        group = stage.model(rng.choice(models))
        # The long side goes along the wall; models look to -Y or, where they are deep, to +X.
        w, d = group.size.x, group.size.y
        extra = math.pi / 2 if d > w * 1.15 else 0.0
        size = (max(w, d), min(w, d)) if extra else (w, d)
        along = rng.uniform(size[0] / 2, max(length - size[0] / 2, size[0] / 2 + 0.01))
        at = shell.wall_point(wall, along, size[1] / 2 + 0.03)
        placed = stand(shell, lambda p, t: group.place(p, t - extra).objects, at, turn, size)
        if placed is None:
            group.remove()
            return
        height = placed.size.z
    else:
        makers = ((props.sofa, (2.5, 1.05)), (props.shelf, (1.65, 0.4)), (props.shelf, (1.65, 0.4)), (props.table, (1.85, 0.9)))
        maker, size = rng.choice(makers)
        along = rng.uniform(size[0] / 2, max(length - size[0] / 2, size[0] / 2 + 0.01))
        placed = stand(shell, lambda p, t: maker(stage, p, t), shell.wall_point(wall, along, size[1] / 2 + 0.02), turn, size)
        if placed is None:
            return
        height = placed.size.z
    if height < 1.4 and rng.random() < 0.8:
        props.scatter_on(stage, placed, rng.randint(2, 7))


def middle(shell):
    """A table with chairs around it, or a low table."""
    stage, rng, lib = shell.stage, shell.stage.rng, shell.stage.library
    at = (shell.width * rng.uniform(0.35, 0.65), shell.depth * rng.uniform(0.35, 0.65), 0.0)
    models = lib.with_role("table", smallest=0.5)
    low = rng.random() < 0.4
    if models and rng.random() < 0.6:
        group = stage.model(rng.choice(models))
        size = (group.size.x, group.size.y)
        placed = stand(shell, lambda p, t: group.place(p, t).objects, at, rng.choice((0, math.pi / 2)), size)
        if placed is None:
            group.remove()
    else:
        placed = stand(shell, lambda p, t: props.table(stage, p, t, low), at, rng.choice((0, math.pi / 2)), (1.6, 0.9))
    if placed is None:
        return
    props.scatter_on(stage, placed, rng.randint(3, 9))
    if placed.size.z < 0.6:
        return
    chairs = lib.with_role("chair")
    chosen = rng.choice(chairs) if chairs and rng.random() < 0.6 else None
    half_w, half_d = placed.size.x / 2, placed.size.y / 2
    for dx, dy, turn in ((0, -1, math.pi), (0, 1, 0), (-1, 0, math.pi / 2), (1, 0, -math.pi / 2)):
        if rng.random() < 0.3:
            continue
        spot = (at[0] + dx * (half_w + rng.uniform(0.1, 0.4)), at[1] + dy * (half_d + rng.uniform(0.1, 0.4)), 0)
        angle = turn + rng.uniform(-0.4, 0.4)
        if not (0.3 < spot[0] < shell.width - 0.3 and 0.3 < spot[1] < shell.depth - 0.3):
            continue
        if chosen:
            stage.model(chosen).place(spot, angle)
        else:
            props.chair(stage, spot, angle)


def decorate_walls(shell):
    """Pictures, mirrors, screens, wall shelves."""
    stage, rng = shell.stage, shell.stage.rng
    for _ in range(rng.randint(1, 6)):
        wall = rng.randrange(4)
        width, height = rng.uniform(0.25, 1.3), rng.uniform(0.25, 0.9)
        along = rng.uniform(width / 2 + 0.1, shell.wall_length(wall) - width / 2 - 0.1)
        point = Vector(shell.wall_point(wall, along, 0.03))
        # The middle of a window lies between where its light comes from and where it goes.
        middles = [((outside + inside) / 2, w) for outside, inside, w, _ in shell.windows]
        if any((point - Vector((m.x, m.y, 0))).length < (width + w) / 2 + 0.2 for m, w in middles):
            continue
        z = rng.uniform(1.2, 1.5)
        props.framed(stage, (point.x, point.y, z), width, height, shell.wall_turn(wall))
        stage.interest.append(point + Vector((0, 0, z + height / 2)))


def clutter(shell):
    """Things on the floor, and cables."""
    stage, rng = shell.stage, shell.stage.rng
    for _ in range(rng.randint(1, 10)):
        spot = empty_spot(shell, 0.3)
        if spot:
            props.small(stage, spot, largest=1.2)
    if rng.random() < 0.4:
        a, b = (shell.wall_point(rng.randrange(4), rng.uniform(0.2, 2.5), 0.05) for _ in range(2))
        props.cable(stage, a, b)


def lights(shell, mood):
    """Daylight through the windows, or lamps at night; dim rooms live on indirect light."""
    stage, rng = shell.stage, shell.stage.rng
    if mood == "night":
        darkness(stage, rng.uniform(0.0, 0.05))
    else:
        environment(stage, DAY, rng.uniform(0.6, 3.0) if mood == "day" else rng.uniform(0.2, 0.8), ("night",))
        daylight(shell, mood)
        if shell.windows and rng.random() < 0.55:
            outside, inside, *_ = rng.choice(shell.windows)
            toward = inside - outside
            side = Vector((-toward.y, toward.x, 0)) * rng.uniform(-0.8, 0.8)
            stage.lamp("SUN", (0, 0, 9), rng.uniform(3, 25) * (0.5 if mood == "dim" else 1), rng.choice(((1, 0.95, 0.85), (1, 0.8, 0.55))),
                       aim=Vector((0, 0, 9)) + toward + side - Vector((0, 0, toward.length * rng.uniform(0.3, 1.2))), angle=math.radians(rng.uniform(0.3, 3)))
    lamps = {"day": rng.choice((0, 0, 1)), "dim": rng.randint(0, 1), "night": rng.randint(1, 4)}[mood]
    for _ in range(lamps):
        rng.choice((pendant, panel, downlights, floor_lamp, floor_lamp))(shell)


def sunbeams(shell):
    """A low sun through a window, and where its light falls as what is worth looking at."""
    stage, rng = shell.stage, shell.stage.rng
    environment(stage, DAY, rng.uniform(0.4, 2.0), ("night",))
    daylight(shell, "day")
    if not shell.windows:
        return
    outside, inside, *_ = rng.choice(shell.windows)
    inward = (inside - outside).normalized()
    ray = inward + Vector((-inward.y, inward.x, 0)) * rng.uniform(-0.9, 0.9) - Vector((0, 0, shell.sunbeam))
    stage.lamp("SUN", (0, 0, 9), rng.uniform(4, 30), rng.choice(((1, 0.95, 0.85), (1, 0.8, 0.55), (1, 1, 1))), aim=Vector((0, 0, 9)) + ray,
               angle=math.radians(rng.uniform(0.2, 1.5)))
    lit = []
    for outside, inside, w, h in shell.windows:
        center, inward = outside.lerp(inside, 0.5), (inside - outside).normalized()
        if inward.dot(ray) < 0.2:
            continue
        side = Vector((-inward.y, inward.x, 0))
        for _ in range(8):
            start = center + side * rng.uniform(-w / 2, w / 2) + Vector((0, 0, rng.uniform(-h / 2, h / 2)))
            # Where the beam leaves the box of the room, along each axis.
            ends = [((far if step > 0 else 0.0) - from_) / step for from_, step, far in zip(start, ray, (shell.width, shell.depth, shell.height)) if abs(step) > 1e-3]
            lit.append(start + ray * min(end for end in ends if end > 1e-3))
        lit += [center] * 3
    stage.interest = lit + rng.sample(stage.interest, min(len(stage.interest), 3))


def dim(stage, factor):
    """Dims the sky and the soft lights in the windows, so that the sun alone is bright."""
    for node in stage.scene.world.node_tree.nodes:
        if node.bl_idname == "ShaderNodeBackground":
            node.inputs["Strength"].default_value *= factor
    for obj in stage.scene.objects:
        if obj.type == "LIGHT" and obj.data.type == "AREA":
            obj.data.energy *= factor


def daylight(shell, mood):
    """Portals that guide samples to the sky, or soft area lights in the windows: both are what
    artists do for interiors; some do neither."""
    stage, rng = shell.stage, shell.stage.rng
    way = rng.choice(("portal", "portal", "portal", "area", "none"))
    if way == "none":
        return
    energy = rng.uniform(10, 80) * (0.3 if mood == "dim" else 1.0)
    for outside, inside, width, height in shell.windows:
        at = outside.lerp(inside, 0.5) + (outside - inside).normalized() * _THICK * 0.8
        lamp = stage.lamp("AREA", at, energy * width * height, (0.85, 0.93, 1.0), aim=inside, shape="RECTANGLE", size=width, size_y=height)
        lamp.data.cycles.is_portal = way == "portal"


def pendant(shell):
    """A hanging lamp: shade, bulb, wire; or a bare emitter in a chandelier model."""
    stage, rng = shell.stage, shell.stage.rng
    x, y, z = shell.width * rng.uniform(0.3, 0.7), shell.depth * rng.uniform(0.3, 0.7), shell.height - rng.uniform(0.4, 0.9)
    models = stage.library.with_role("ceiling")
    if models and rng.random() < 0.4:
        group = stage.model(rng.choice(models))
        group.place((x, y, shell.height - group.size.z))
        stage.lamp("POINT", (x, y, shell.height - group.size.z * 1.1), rng.uniform(30, 200), (1, 0.8, 0.6), shadow_soft_size=0.1)
        return
    r = rng.uniform(0.1, 0.3)
    shade = shapes.lathe(shapes.curved([(r, 0), (r * 0.9, r * 0.3), (r * 0.4, r * 0.8), (0.02, r)]))
    stage.add(shade, rng.choice((m.metal, m.translucent, m.glass, m.plastic))(rng), (x, y, z))
    stage.add(shapes.sphere(0.04, 3), m.light(rng, rng.uniform(50, 400)), (x, y, z))
    stage.add(shapes.box((0.006, 0.006, shell.height - z - r), 0, (0, 0, (shell.height - z + r) / 2)), m.plastic(rng), (x, y, z))


def panel(shell):
    """A flat light on the ceiling."""
    stage, rng = shell.stage, shell.stage.rng
    w, d = rng.uniform(0.2, 1.2), rng.uniform(0.1, 0.6)
    stage.add(shapes.box((w, d, 0.03), 0.005), m.light(rng, rng.uniform(4, 30)), (shell.width * rng.uniform(0.3, 0.7), shell.depth * rng.uniform(0.3, 0.7), shell.height - 0.02))


def downlights(shell):
    """A grid of spots in the ceiling."""
    stage, rng = shell.stage, shell.stage.rng
    nx, ny = rng.randint(1, 3), rng.randint(1, 3)
    energy, color = rng.uniform(20, 120), rng.choice(((1, 0.75, 0.5), (1, 0.9, 0.8), (0.9, 0.95, 1)))
    for i in range(nx):
        for j in range(ny):
            at = (shell.width * (i + 0.5) / nx, shell.depth * (j + 0.5) / ny, shell.height - 0.03)
            stage.lamp("SPOT", at, energy, color, aim=(at[0] + 0.01, at[1], 0), spot_size=rng.uniform(0.7, 1.6), spot_blend=0.5, shadow_soft_size=0.03)


def floor_lamp(shell):
    """A standing lamp in a free corner."""
    spot = empty_spot(shell, 0.4)
    if spot:
        props.standing_lamp(shell.stage, spot, shell.stage.rng.uniform(150, 1200))
