"""Short shots out of still scenes: the camera travels, things slide and turn, lamps swing, all a little."""

import math

import bpy
from mathutils import Matrix, Vector

_FAR = 4.0  # metres to what the camera turns around where it looks at nothing


def middle(frames):
    """The number of the middle one of so many frames, counted from 1."""
    return (frames + 1) // 2


def animate(stage, camera, frames):
    """Moves what a scene shows through `frames` frames, so that the middle one is the scene as it was built.

    Keys are set beyond both ends too: a frame's vectors tell where things were before and will be after it."""
    rng, scene = stage.rng, stage.scene
    scene.render.use_motion_blur = False  # Cycles writes no vectors with it
    steps = [(frame, frame - middle(frames)) for frame in range(frames + 2)]
    move_camera(rng, scene, camera, steps)
    movers = [o for o in scene.objects if o.type == "MESH" and not o.parent and 0.02 < max(o.dimensions) < 3]
    for obj in rng.sample(movers, min(len(movers), rng.choice((0, 0, 1, 2, 4)))):
        slide = Vector([rng.gauss(0, 0.04) * max(obj.dimensions) for _ in range(3)])
        turn = math.radians(rng.choice((0.0, rng.gauss(0, 4))))
        place(obj, steps, lambda step, start: Matrix.Translation(slide * step) @ start @ Matrix.Rotation(turn * step, 4, "Z"))
    lamps = [o for o in scene.objects if o.type == "LIGHT" and o.data.type != "SUN"]
    if lamps and rng.random() < 0.3:
        swing = Vector([rng.gauss(0, 0.04) for _ in range(3)])
        place(rng.choice(lamps), steps, lambda step, start: Matrix.Translation(swing * step) @ start)


def move_camera(rng, scene, camera, steps):
    """A pan, a ride around or toward what is seen, a ride past it, or none."""
    depsgraph = bpy.context.evaluated_depsgraph_get()
    start = camera.matrix_world.copy()
    ahead = start.to_quaternion() @ Vector((0, 0, -1))
    hit, point, *_ = scene.ray_cast(depsgraph, start.translation, ahead)
    point = point.copy() if hit else start.translation + ahead * _FAR
    distance = (point - start.translation).length
    way = rng.choice(("none", "pan", "pan", "around", "around", "toward", "past"))
    # From a tenth of a degree to one and a half, slow ones more often; as much again in other units.
    angle = math.radians(0.1 * 15 ** rng.random()) * rng.choice((-1, 1))
    axis = Vector((rng.gauss(0, 0.2), rng.gauss(0, 0.2), 1)).normalized()
    shift = (ahead if way == "toward" else start.to_quaternion() @ Vector((1, 0, 0))) * distance * angle
    pivots = {"pan": start.translation, "around": point}

    def at(step, start):
        if way in pivots:
            pivot = Matrix.Translation(pivots[way])
            return pivot @ Matrix.Rotation(angle * step, 4, axis) @ pivot.inverted() @ start
        return Matrix.Translation(shift * step if way in ("toward", "past") else Vector()) @ start

    place(camera, steps, at)


def place(obj, steps, at):
    """Keys of an object's place and turn, one a frame: `at` makes them from the step and the matrix at step 0."""
    start = obj.matrix_world.copy()
    for frame, step in steps:
        obj.matrix_world = at(step, start)
        for what in ("location", f"rotation_{'quaternion' if obj.rotation_mode == 'QUATERNION' else 'euler'}"):
            obj.keyframe_insert(what, frame=frame)
    obj.matrix_world = start
