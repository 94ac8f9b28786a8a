"""Where to look from: cameras that see something, depth of field, motion blur, and good crops."""

import math
import os
import tempfile

import bpy
import numpy as np
from mathutils import Vector

from demc_blender import exr, rendering
from demc_blender.edits import Edits

# A probe frame's long side in pixels, and what a crop of it must show to be worth rendering.
_PROBE = 160
_DARKEST = 1e-5
_LEAST_DETAIL = 0.05
_LEAST_BUSY = 0.15
# Where light finds so few samples at 4 spp that more surface pixels than this stay black, no
# affordable reference comes clean.
_STARVED = 0.5
# A crop darker than this share of its frame's brightness shows next to nothing.
_DARK_SHARE = 0.02


def room_camera(stage, shell):
    """Inside a room, from near a wall or over the furniture, toward what stands in it."""
    rng = stage.rng
    for _ in range(60):
        at = Vector((rng.uniform(0.25, shell.width - 0.25), rng.uniform(0.25, shell.depth - 0.25), rng.uniform(0.8, min(1.8, shell.height - 0.3))))
        target = Vector(rng.choice(stage.interest) if stage.interest else (shell.width / 2, shell.depth / 2, 0.8))
        if rng.random() < 0.8:  # people look at furniture, not at ceilings
            target.z = min(target.z, rng.uniform(0.6, 1.3))
        near = rng.random() < 0.2  # a close look at one thing
        direction = Vector(target) - at
        if near and direction.length > 1.2:
            at = Vector(target) - direction.normalized() * rng.uniform(0.7, 1.5)
            direction = Vector(target) - at
        if direction.length < (0.6 if near else 1.6):
            continue
        if sees_ahead(stage, at, direction, 0.4 if near else 0.9):
            return stage.camera(at, target, rng.uniform(18, 35) if not near else rng.uniform(30, 60))
    return None


def sees_ahead(stage, at, direction, distance):
    """Whether most of a fan of rays runs free for a while: no camera inside a cupboard."""
    bpy.context.view_layer.update()
    side = direction.normalized().cross(Vector((0, 0, 1))).normalized()
    up = side.cross(direction).normalized()
    rays = [direction.normalized() + side * u + up * v for u in (-0.4, 0, 0.4) for v in (-0.25, 0, 0.25)]
    return sum(stage.clear_ray(at, ray, distance) for ray in rays) >= 7


def around_camera(stage, center, radius, height, lens=(28, 70), spread=0.25):
    """On a ring around a point, looking at it or near it."""
    rng = stage.rng
    for _ in range(40):
        angle = rng.uniform(0, 2 * math.pi)
        r = rng.uniform(*radius)
        at = Vector(center) + Vector((r * math.cos(angle), r * math.sin(angle), rng.uniform(*height)))
        target = Vector(center) + Vector([rng.gauss(0, spread) for _ in range(3)])
        if sees_ahead(stage, at, target - at, min(r * 0.3, 2.0)):
            return stage.camera(at, target, rng.uniform(*lens))
    return None


def undo_lens_effects(stage):
    """Takes back what `lens_effects` did for a camera that was refused."""
    camera = stage.scene.camera
    if camera:
        camera.animation_data_clear()
        camera.data.dof.use_dof = False
    stage.scene.render.use_motion_blur = False


def lens_effects(stage, camera, blurs=True):
    """Depth of field on what the middle of the view shows, and motion blur now and then where it `blurs`."""
    rng, scene = stage.rng, stage.scene
    if rng.random() < stage.defocus and not stage.panorama:
        direction = camera.matrix_world.to_quaternion() @ Vector((0, 0, -1))
        hit, point, *_ = scene.ray_cast(bpy.context.evaluated_depsgraph_get(), camera.location, direction)
        camera.data.dof.use_dof = True
        focus = (point - camera.location).length if hit else 3.0
        camera.data.dof.focus_distance = focus
        # Nearer subjects are stopped down, or all but a sliver of the frame would be blur.
        camera.data.dof.aperture_fstop = rng.choice((1.4, 2.0, 2.8, 5.6)) * max(1.0, 1.5 / max(focus, 0.1))
        camera.data.dof.aperture_blades = rng.choice((0, 0, 6))
    if blurs and rng.random() < 0.1:
        scene.render.use_motion_blur = True
        scene.render.motion_blur_shutter = rng.uniform(0.2, 0.8)
        movers = [o for o in scene.objects if o.type == "MESH" and 0.02 < max(o.dimensions) < 5]
        movers.sort(key=lambda obj: off_axis(camera, obj))  # what stands in the middle of the view
        for obj in rng.sample(movers[:12], min(len(movers), 4)):
            move(rng, obj, max(obj.dimensions) * 0.12, rng.gauss(0, 0.15))
        if rng.random() < 0.5:
            # A pan of a fifth of a degree to three degrees a frame.
            move(rng, camera, 0.02, math.radians(0.2 * 15 ** rng.random()) * rng.choice((-0.5, 0.5)))


def all_around(stage, camera):
    """Makes a camera see all around, as a panorama of twice its height."""
    stage.panorama = True
    camera.data.type = "PANO"
    owner = camera.data if hasattr(camera.data, "panorama_type") else camera.data.cycles  # before Blender 5
    owner.panorama_type = "EQUIRECTANGULAR"
    camera.rotation_euler.x, camera.rotation_euler.y = math.pi / 2, 0.0
    return camera


def off_axis(camera, obj):
    """How far from the middle of the view an object is, as the sine of an angle; more behind the camera."""
    toward = (obj.matrix_world.translation - camera.location).normalized()
    ahead = camera.rotation_euler.to_quaternion() @ Vector((0, 0, -1))
    return toward.cross(ahead).length if toward.dot(ahead) > 0 else 2.0


def move(rng, obj, distance, turn):
    """Two keys around frame 1: a straight shift, and a turn about the upright axis, in radians."""
    place, angle = obj.location.copy(), obj.rotation_euler.z
    shift = Vector([rng.gauss(0, distance) for _ in range(3)])
    for frame, side in ((0, -1), (2, 1)):
        obj.location, obj.rotation_euler.z = place + shift * side, angle + turn * side
        obj.keyframe_insert("location", frame=frame)
        obj.keyframe_insert("rotation_euler", frame=frame)
    obj.location, obj.rotation_euler.z = place, angle


def probe(scene, spp=4):
    """A tiny render of the whole frame: (height, width, 3) radiance, albedo and normal."""
    width, height = rendering.frame_size(scene)
    scale = _PROBE / max(width, height)
    handle, path = tempfile.mkstemp(suffix=".exr")
    os.close(handle)
    try:
        with Edits() as edits:
            layer = next(layer for layer in scene.view_layers if layer.use)
            rendering.set_resolution(edits, scene, (max(int(width * scale), 8), max(int(height * scale), 8)))
            edits.set(scene.render, "use_border", False)
            edits.set(layer.cycles, "denoising_store_passes", True)
            rendering.set_sampling(edits, scene, spp, 1)
            rendering.render_to(scene, path)
        passes = exr.read(path)
    finally:
        os.remove(path)
    pick = lambda name, axes: np.stack([np.nan_to_num(find(passes, f"{name}.{a}").astype(np.float32)) for a in axes], -1)
    return pick("Combined", "RGB"), pick("Denoising Albedo", "RGB"), pick("Denoising Normal", "XYZ")


def find(passes, ending):
    """The channel whose name ends so."""
    return next(plane for name, plane in passes.items() if name.endswith("." + ending) or name == ending)


def starved(image, normal):
    """Share of the pixels on surfaces that no light has reached yet."""
    covered = np.abs(normal).max(-1) > 0.1
    return float((image.max(-1)[covered] <= 1e-7).mean()) if covered.any() else 0.0


def refusal(guides, dark=False):
    """Why a probe frame is not worth rendering, or None; `dark` where most of it may be black."""
    image, _, normal = guides
    luminance = image @ np.array([0.2126, 0.7152, 0.0722], np.float32)
    # A few samples leave most pixels of an interior black: judge means of small blocks.
    height, width = (n // 8 * 8 for n in luminance.shape)
    blocks = luminance[:height, :width].reshape(height // 8, 8, width // 8, 8).mean((1, 3))
    if brightness(image) < _DARKEST or not dark and np.median(blocks) < 0.01 * blocks.mean():
        return "black"
    if not dark and starved(image, normal) > _STARVED:
        return "too noisy"
    return None


def brightness(image):
    """Mean luminance with the brightest 2% of pixels capped, as a metric's exposure sees it."""
    luminance = image @ np.array([0.2126, 0.7152, 0.0722], np.float32)
    return float(np.minimum(luminance, np.percentile(luminance, 98)).mean())


def expose(rng, scene, image):
    """Scales every light so that the frame is as bright as a lighting artist leaves it; returns the
    factor. Lights are scaled, not the film: adaptive sampling then sees final values."""
    factor = 0.25 * math.exp(rng.gauss(0, 0.6)) / brightness(image)
    for light in bpy.data.lights:
        light.energy *= factor
    trees = [m.node_tree for m in bpy.data.materials if m.node_tree]
    trees += [scene.world.node_tree] if scene.world and scene.world.node_tree else []
    for tree in trees:
        for node in tree.nodes:
            if node.bl_idname in ("ShaderNodeEmission", "ShaderNodeBackground"):
                node.inputs["Strength"].default_value *= factor
            elif node.bl_idname == "ShaderNodeBsdfPrincipled":
                node.inputs["Emission Strength"].default_value *= factor
    return factor


def shows(stage, guides):
    """Whether a whole frame shows enough: half of what a crop must, as no crop was chosen for it."""
    _, albedo, normal = guides
    covered = (np.abs(normal).max(-1) > 0.1).mean()
    return covered > stage.least_covered / 2 and busy(albedo, normal) > _LEAST_BUSY / 3


def crops(stage, guides, count, size, plain=False):
    """Up to `count` regions X,Y,W,H of the frame, the likelier the more they show. Crops with too
    little detail, or darkness alone, are not offered. `plain` ones are all as likely, but for darkness."""
    rng, scene = stage.rng, stage.scene
    image, albedo, normal = guides
    width, height = rendering.frame_size(scene)
    size = (min(size[0], width), min(size[1], height))
    scale, frame_level = image.shape[1] / width, max(brightness(image), 1e-9)
    found = []
    for _ in range(60):
        x, y = rng.randint(0, width - size[0]), rng.randint(0, height - size[1])
        part = np.s_[int(y * scale):max(int((y + size[1]) * scale), int(y * scale) + 2), int(x * scale):max(int((x + size[0]) * scale), int(x * scale) + 2)]
        light = image[part].mean(-1)
        covered = (np.abs(normal[part]).max(-1) > 0.1).mean()
        if (
            light.mean() < _DARK_SHARE * frame_level
            or not plain
            and covered < stage.least_covered
            or not stage.dark
            and starved(image[part], normal[part]) > _STARVED + 0.1
        ):
            continue
        level = np.log1p(np.minimum(light / frame_level, 50))
        detail = albedo[part].std((0, 1)).mean() + 0.5 * normal[part].std((0, 1)).mean() + 0.2 * min(float(level.std()), 1.0)
        shows = 1.0 if plain else busy(albedo[part], normal[part])
        if plain or detail > _LEAST_DETAIL and shows > _LEAST_BUSY:
            found.append((shows, (x, y, *size)))
    chosen = []
    while found and len(chosen) < count:
        pick = rng.choices(range(len(found)), [min(b, 0.6) ** 2 for b, _ in found])[0]
        region = found.pop(pick)[1]
        if all(overlap(region, other) < 0.3 for other in chosen):
            chosen.append(region)
    return chosen


def busy(albedo, normal):
    """Share of a crop's small blocks that hold an edge of a texture or of a shape: two even halves
    have much contrast and little to learn from."""
    spread = lambda image: np.ptp(_blocks(image), axis=(1, 3)).max(-1)
    return float(((spread(albedo) > 0.12) | (spread(normal) > 0.4)).mean())


def _blocks(image, side=4):
    height, width = (n // side * side for n in image.shape[:2])
    if not height or not width:  # a crop smaller than a block of the probe is one block
        return image[:, None, :, None].reshape(1, image.shape[0], 1, image.shape[1], -1)
    return image[:height, :width].reshape(height // side, side, width // side, side, -1)


def overlap(a, b):
    """Shared part of two equal regions."""
    w = min(a[0] + a[2], b[0] + b[2]) - max(a[0], b[0])
    h = min(a[1] + a[3], b[1] + b[3]) - max(a[1], b[1])
    return max(w, 0) * max(h, 0) / (a[2] * a[3])
