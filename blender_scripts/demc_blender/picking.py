"""What of a .blend is rendered: its scene, view layers, stereo views and frames; and what it lacks.

Each raises RuntimeError with what there is to choose from, where the file has not what is asked for.
"""

import glob
import os

import bpy


def open_scene(path, scripts=False):
    """Opens a .blend without its interface, and lets its scripts run where that is said; raises RuntimeError in one
    line where it cannot."""
    if not os.path.isfile(path):
        raise RuntimeError(f"{path}: no such file")
    # Left out, it is as Blender was started: `blender --enable-autoexec` lets them run.
    allowed = {"use_scripts": True} if scripts else {}
    bpy.ops.wm.open_mainfile(filepath=os.path.abspath(path), load_ui=False, **allowed)


def warn_of_scripts():
    """Says that scripts and drivers of the open file were not run, so that what they move stays where it is."""
    if bpy.app.autoexec_fail and not bpy.app.autoexec_fail_quiet:
        print(f"warning: scripts of the file do not run ({bpy.app.autoexec_fail_message}), so what they drive stays as it "
              "was saved; --scripts lets them, if you trust the file")


def has_camera(scene):
    """Whether there is one to render with, of the scene or of a marker on its timeline."""
    return scene.camera is not None or any(marker.camera for marker in scene.timeline_markers)


def chosen_layers(edits, scene, name):
    """The view layers to render; a named one has the others switched off."""
    if name is None:
        layers = [layer for layer in scene.view_layers if layer.use]
        if not layers:
            raise RuntimeError(f"no view layer of {scene.name} is on; choose one with --view-layer")
        return layers
    if name not in scene.view_layers:
        known = ", ".join(layer.name for layer in scene.view_layers)
        raise RuntimeError(f"no view layer {name!r} in {scene.name}; it has {known}")
    for layer in scene.view_layers:
        edits.set(layer, "use", layer.name == name)
    return [scene.view_layers[name]]


def chosen_scene(name, blend):
    """The scene to render; a file with several has them named."""
    scenes = [scene.name for scene in bpy.data.scenes]
    if name is None:
        scene = bpy.context.scene
        if len(scenes) > 1:
            print(f"note: {blend} has {len(scenes)} scenes: {', '.join(scenes)}; rendering {scene.name} (--scene)")
        return scene
    if name not in scenes:
        raise RuntimeError(f"no scene {name!r} in {blend}; it has {', '.join(scenes)}")
    return bpy.data.scenes[name]


def choose_views(edits, scene, wanted):
    """Switches stereo views on and off; returns the names of those to render, none for a scene of one eye."""
    if not scene.render.use_multiview:
        if wanted:
            raise RuntimeError(f"{scene.name} has no stereo views (--views); turn Stereoscopy on in Output Properties")
        return []
    views = list(scene.render.views)
    unknown = set(wanted or []) - {view.name for view in views}
    if unknown:
        known = ", ".join(view.name for view in views)
        raise RuntimeError(f"no view {', '.join(sorted(unknown))} in {scene.name}; it has {known}")
    if wanted:
        for view in views:
            edits.set(view, "use", view.name in wanted)
    return [view.name for view in views if view.use]


def chosen_frames(scene, spans):
    """The frames that `--frames` names, in order, each once."""
    whole = (scene.frame_start, scene.frame_end, None)
    frames, skipped = [], False
    for first, last, step in [whole] if spans is None else spans:
        if step is None and first < last and scene.frame_step > 1:
            # Counted from the scene's start, so that chunks of a range make the same frames as the whole.
            frames += [f for f in range(first, last + 1) if (f - scene.frame_start) % scene.frame_step == 0]
            skipped = True
        else:
            frames += range(first, last + 1, step or 1)
    if skipped:
        print(f"note: {scene.name} renders every {scene.frame_step}. frame; --frames A-B:1 renders all")
    return list(dict.fromkeys(frames))


def warn_of_simulations(scene):
    """Says what is simulated and not baked: what it shows depends on the frames that were rendered before."""
    unbaked = []
    world = scene.rigidbody_world
    if world and world.enabled and world.collection and world.collection.objects and not world.point_cache.is_baked:
        unbaked.append("rigid bodies")
    for thing in scene.objects:
        caches = [modifier.point_cache for modifier in thing.modifiers if modifier.show_render
                  and modifier.type in ("CLOTH", "SOFT_BODY")]
        caches += [system.point_cache for system in thing.particle_systems
                   if system.settings.type == "EMITTER" or system.use_hair_dynamics]
        if any(not cache.is_baked for cache in caches):
            unbaked.append(thing.name)
    if unbaked:
        print(f"warning: {', '.join(unbaked[:4])}: simulated and not baked, so frames that are rendered apart, or again, show "
              "another state; bake the caches first")


def warn_of_missing_files():
    """Names textures, libraries, caches ... that the scene refers to and that are not there."""
    for path in bpy.utils.blend_paths(absolute=True, packed=False, local=False):
        # A tiled or numbered image stands for many files; Blender's own font for none.
        if "<builtin>" in path or glob.glob(glob.escape(path).replace("<UDIM>", "*").replace("<UVTILE>", "*")):
            continue
        print(f"warning: missing file {path}: what it holds renders pink or not at all")
    lost = [linked.name for library in bpy.data.libraries for linked in library.users_id if linked.is_missing]
    if lost:
        print(f"warning: {len(lost)} linked data-blocks are missing from their libraries: {', '.join(lost[:4])}")
