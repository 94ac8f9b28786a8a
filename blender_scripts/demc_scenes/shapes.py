"""Meshes made from numbers: boxes, planes, lathes, curtains, terrain, tubes. UVs are in metres."""

import math

import bmesh
import bpy
from mathutils import Matrix, Vector


def _finish(mesh_builder, name, smooth, box_uv=True):
    if box_uv:
        _box_uv(mesh_builder)
    mesh = bpy.data.meshes.new(name)
    mesh_builder.to_mesh(mesh)
    mesh_builder.free()
    for polygon in mesh.polygons:
        polygon.use_smooth = smooth
    return bpy.data.objects.new(name, mesh)


def _box_uv(builder):
    """Projects every face along its main axis, one UV unit a metre."""
    layer = builder.loops.layers.uv.verify()
    builder.normal_update()
    for face in builder.faces:
        normal = face.normal
        axis = max(range(3), key=lambda i: abs(normal[i]))
        u, v = ((1, 2), (0, 2), (0, 1))[axis]
        for loop in face.loops:
            loop[layer].uv = (loop.vert.co[u], loop.vert.co[v])


def box(size, bevel=0.0, center=(0, 0, 0), segments=2):
    """A box with rounded edges; `center` shifts the mesh, not the object."""
    builder = bmesh.new()
    bmesh.ops.create_cube(builder, size=1.0, matrix=Matrix.Translation(center) @ Matrix.Diagonal((*size, 1)))
    bevel = min(bevel, min(size) * 0.45)
    if bevel > 1e-4:
        bmesh.ops.bevel(builder, geom=list(builder.edges), offset=bevel, segments=segments, profile=0.5, affect="EDGES")
    return _finish(builder, "box", False)


def boxes(parts, bevel=0.0, turn=Matrix()):
    """Several (size, center) boxes in one mesh, each turned about its center."""
    builder = bmesh.new()
    for size, center in parts:
        made = bmesh.ops.create_cube(builder, size=1.0, matrix=Matrix.Translation(center) @ turn @ Matrix.Diagonal((*size, 1)))
        if bevel:
            edges = {e for v in made["verts"] for e in v.link_edges}
            bmesh.ops.bevel(builder, geom=list(edges), offset=min(bevel, min(size) * 0.45), segments=2, profile=0.5, affect="EDGES")
    return _finish(builder, "boxes", False)


def plane(width, height, unit_uv=False):
    """A rectangle in XZ facing -Y, standing on its base; `unit_uv` maps it to 0..1."""
    builder = bmesh.new()
    corners = [builder.verts.new((x * width / 2, 0, z * height)) for x, z in ((-1, 0), (1, 0), (1, 1), (-1, 1))]
    face = builder.faces.new(corners)
    if unit_uv:
        layer = builder.loops.layers.uv.verify()
        for loop, uv in zip(face.loops, ((0, 0), (1, 0), (1, 1), (0, 1))):
            loop[layer].uv = uv
    return _finish(builder, "plane", False, not unit_uv)


def lathe(profile, steps=48, smooth=True):
    """Turns (radius, height) points around Z: vases, glasses, shades."""
    builder = bmesh.new()
    rings = []
    for radius, height in profile:
        ring = [builder.verts.new((radius * math.cos(a), radius * math.sin(a), height))
                for a in (2 * math.pi * i / steps for i in range(steps))] if radius > 1e-5 else [builder.verts.new((0, 0, height))]
        rings.append(ring)
    for low, high in zip(rings, rings[1:]):
        for i in range(steps):
            j = (i + 1) % steps
            corners = ([low[i], low[j]] if len(low) > 1 else [low[0]]) + ([high[j], high[i]] if len(high) > 1 else [high[0]])
            if len(corners) > 2:
                builder.faces.new(corners)
    bmesh.ops.recalc_face_normals(builder, faces=list(builder.faces))
    return _finish(builder, "lathe", smooth)


def curved(profile, steps=6):
    """A smooth curve through profile points (Catmull-Rom), for `lathe`."""
    points = [profile[0]] + list(profile) + [profile[-1]]
    out = []
    for p0, p1, p2, p3 in zip(points, points[1:], points[2:], points[3:]):
        for i in range(steps):
            t = i / steps
            out.append(tuple(max(0.0, 0.5 * (2 * b + (c - a) * t + (2 * a - 5 * b + 4 * c - d) * t * t
                                             + (3 * b - a - 3 * c + d) * t ** 3)) if k == 0 else
                             0.5 * (2 * b + (c - a) * t + (2 * a - 5 * b + 4 * c - d) * t * t + (3 * b - a - 3 * c + d) * t ** 3)
                             for k, (a, b, c, d) in enumerate(zip(p0, p1, p2, p3))))
    out.append(profile[-1])
    return out


def vessel(rng, height, wall=0.004):
    """A random vase, bowl or glass with a wall of real thickness."""
    radius = height * rng.uniform(0.25, 0.7)
    outer = [(radius * rng.uniform(0.4, 0.8), 0.0)] + [
        (radius * rng.uniform(0.45, 1.0), height * h) for h in (0.25, 0.5, 0.75)] + [(radius * rng.uniform(0.3, 1.0), height)]
    outer = curved(outer)
    inner = [(max(r - wall, 0.001), max(z, wall)) for r, z in reversed(outer)]
    return lathe([(0.0, 0.0)] + outer + inner + [(0.0, wall)])


def bottle(rng, height):
    """A bottle with neck and wall."""
    r = height * rng.uniform(0.1, 0.18)
    neck = r * rng.uniform(0.25, 0.45)
    shoulder = rng.uniform(0.5, 0.7)
    outer = [(r * 0.95, 0), (r, height * 0.03), (r, height * shoulder), (neck, height * (shoulder + 0.15)), (neck, height * 0.98), (neck * 1.1, height)]
    inner = [(max(a - 0.003, 0.002), max(b, 0.005)) for a, b in reversed(outer)]
    return lathe([(0, 0)] + outer + inner + [(0, 0.005)])


def sphere(radius, detail=4):
    """An icosphere standing on its base."""
    builder = bmesh.new()
    bmesh.ops.create_icosphere(builder, subdivisions=detail, radius=radius, matrix=Matrix.Translation((0, 0, radius)))
    return _finish(builder, "sphere", True)


def monkey(size):
    """Blender's own head, subdivided."""
    builder = bmesh.new()
    bmesh.ops.create_monkey(builder, matrix=Matrix.Translation((0, 0, size * 0.5)) @ Matrix.Scale(size * 0.5, 4))
    obj = _finish(builder, "monkey", True)
    obj.modifiers.new("smooth", "SUBSURF").render_levels = 2
    obj.modifiers[0].levels = 2
    return obj


def torus(radius, thickness):
    """A ring lying on its side, standing on the ground."""
    steps = 24
    ring = [(radius + thickness * math.cos(a), thickness * (1 + math.sin(a))) for a in (2 * math.pi * i / steps for i in range(steps + 1))]
    return lathe(ring, 64)


def gem(rng, size):
    """A cut stone: the convex hull of random points, flat faces."""
    builder = bmesh.new()
    for _ in range(rng.randint(14, 40)):
        direction = Vector((rng.gauss(0, 1), rng.gauss(0, 1), rng.gauss(0, 1))).normalized()
        builder.verts.new(direction * size * 0.5)
    bmesh.ops.convex_hull(builder, input=list(builder.verts))
    low = min(v.co.z for v in builder.verts)
    bmesh.ops.translate(builder, verts=list(builder.verts), vec=(0, 0, -low))
    bmesh.ops.recalc_face_normals(builder, faces=list(builder.faces))
    return _finish(builder, "gem", False)


def sheet(width, height, across, fold, steps=96):
    """A hanging cloth in folds: `across` folds of depth `fold`, facing -Y."""
    builder = bmesh.new()
    rows = 8
    grid = []
    for j in range(rows + 1):
        z = height * j / rows
        depth = fold * (1.0 - 0.4 * j / rows)
        grid.append([builder.verts.new((width * (i / steps - 0.5), depth * math.sin(across * 2 * math.pi * i / steps + 0.3 * math.sin(j)), z))
                     for i in range(steps + 1)])
    for low, high in zip(grid, grid[1:]):
        for i in range(steps):
            builder.faces.new((low[i], low[i + 1], high[i + 1], high[i]))
    return _finish(builder, "sheet", True)


def terrain(size, steps, height):
    """A square of ground, raised by `height(x, y)`."""
    builder = bmesh.new()
    line = [size * (i / steps - 0.5) for i in range(steps + 1)]
    grid = [[builder.verts.new((x, y, height(x, y))) for x in line] for y in line]
    for low, high in zip(grid, grid[1:]):
        for i in range(steps):
            builder.faces.new((low[i], low[i + 1], high[i + 1], high[i]))
    return _finish(builder, "terrain", True)


def leaves(rng, count, spread, size):
    """Crossed leaf cards in a ball of radius `spread`: each a quad with UV 0..1."""
    builder = bmesh.new()
    layer = builder.loops.layers.uv.verify()
    for _ in range(count):
        at = Vector((rng.gauss(0, 1), rng.gauss(0, 1), rng.gauss(0, 1)))
        at = at.normalized() * spread * rng.random() ** 0.4
        turn = Matrix.Rotation(rng.uniform(0, 6.28), 3, "Z") @ Matrix.Rotation(rng.uniform(-1.2, 1.2), 3, "X")
        scale = size * rng.uniform(0.6, 1.3)
        corners = [builder.verts.new(at + turn @ (Vector((x, 0, z)) * scale)) for x, z in ((-0.5, 0), (0.5, 0), (0.5, 1), (-0.5, 1))]
        face = builder.faces.new(corners)
        for loop, uv in zip(face.loops, ((0, 0), (1, 0), (1, 1), (0, 1))):
            loop[layer].uv = uv
    return _finish(builder, "leaves", False, False)


def tube(points, radius):
    """A smooth tube through points: cables, neon, rails."""
    curve = bpy.data.curves.new("tube", "CURVE")
    curve.dimensions, curve.bevel_depth, curve.bevel_resolution = "3D", radius, 3
    spline = curve.splines.new("NURBS")
    spline.points.add(len(points) - 1)
    for target, point in zip(spline.points, points):
        target.co = (*point, 1.0)
    spline.use_endpoint_u = True
    return bpy.data.objects.new("tube", curve)


def text(words, size, depth):
    """Raised letters in XZ facing -Y."""
    curve = bpy.data.curves.new("text", "FONT")
    curve.body, curve.size, curve.extrude = words, size, depth
    curve.bevel_depth = depth * 0.1
    obj = bpy.data.objects.new("text", curve)
    obj.rotation_euler = (math.pi / 2, 0, 0)
    return obj
