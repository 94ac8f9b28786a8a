"""From a seed to a scene that is ready to render: built, set up, seen by a camera, and exposed."""

import random

import bpy

from demc_blender import rendering

from . import moving, views
from .blends import open_blend
from .kinds import KINDS
from .stage import Stage

# Scenes of these seeds judge what was trained on others: nothing may ever train on them.
DEVELOPMENT_SEEDS = range(9_000_000, 10_000_000)
_FRAME_SIZES = ((480, 270), (480, 270), (480, 270), (640, 360), (640, 360), (960, 540))


def build(library, seed, kind, blends):
    """Builds a scene; returns its stage and the function that places a camera."""
    rng = random.Random(f"scene {seed} {kind}")
    bpy.ops.wm.read_factory_settings(use_empty=True)
    stage = Stage(rng, library, random.Random(f"aside {seed} {kind}"))
    if kind in blends:
        return stage, open_blend(stage, blends[kind])
    stage.scene.render.engine = "CYCLES"
    return stage, KINDS[kind][0](stage)


def set_up(edits, stage, threads=None, finished=False, size=None):
    """Render settings that artists use; those of a finished .blend are left as they are. Without a size the
    frame has one of a few."""
    rng, scene = stage.rng, stage.scene
    rendering.prepare_scene(edits, scene)
    rendering.set_output(edits, scene)
    if threads:
        edits.set(scene.render, "threads_mode", "FIXED")
        edits.set(scene.render, "threads", threads)
    rendering.set_resolution(edits, scene, size or rng.choice(_FRAME_SIZES))
    if scene.world:  # the map that Cycles builds by itself takes seconds, for every single crop
        scene.world.cycles.sampling_method = "MANUAL"
        scene.world.cycles.sample_map_resolution = 512
    if finished:
        return
    cycles = scene.cycles
    cycles.device = "CPU"
    cycles.max_bounces, cycles.diffuse_bounces = rng.choice((6, 8)), rng.choice((2, 3, 4))
    cycles.glossy_bounces, cycles.transmission_bounces, cycles.transparent_max_bounces = 4, 8, 8
    cycles.sample_clamp_indirect = rng.choice((0.0, 0.0, 10.0, 10.0))
    cycles.sample_clamp_direct = 0.0
    cycles.blur_glossy = rng.choice((0.0, 1.0))
    cycles.caustics_reflective = cycles.caustics_refractive = rng.random() < 0.85
    cycles.use_light_tree = rng.random() < 0.7
    scene.frame_set(1)


def look(edits, stage, place_camera, crops, size, finished=False, frames=1, plain=False):
    """Places the camera where it sees enough and exposes the scene; returns the crops, X,Y,W,H each, or
    raises Unseen where three tries find none. Without a size the whole frame is the crop. Of several frames
    it is the middle one that is looked at, and it stays the current one. Crops are the likelier the more they show,
    or if they are to be `plain`, all as likely."""
    if frames > 1:
        stage.scene.frame_set(moving.middle(frames))
    reason = "no place for a camera"
    for _ in range(3):
        if not finished:
            views.undo_lens_effects(stage)  # of the camera before
        camera = place_camera()
        if camera is None:
            continue
        if stage.panorama:
            width, _ = rendering.frame_size(stage.scene)
            rendering.set_resolution(edits, stage.scene, (width, width // 2))
        if not finished:
            views.lens_effects(stage, camera, blurs=frames == 1)
        guides = views.probe(stage.scene)
        reason = views.refusal(guides, stage.dark)
        if reason:
            continue
        if size:
            regions = views.crops(stage, guides, crops, size, plain)
        else:
            regions = [(0, 0, *rendering.frame_size(stage.scene))] if views.shows(stage, guides) else []
        if len(regions) == crops:
            if not finished:
                views.expose(stage.rng, stage.scene, guides[0])
            if frames > 1:
                moving.animate(stage, camera, frames)
            return regions
        reason = "featureless"
    raise Unseen(reason)


class Unseen(Exception):
    """A scene with nothing to see, and why."""
