"""The extension as it is used with the mouse and the keyboard, in a window of Blender: run by in_window.py.

    blender --enable-event-simulate --python window.py -- FOLDER

FOLDER holds the frame buffer of Xvfb; copies of it and `said.json`, what was found, lie there in the end.
Everything is driven by one timer, whose beats also tell whether Blender stood still. Buttons are found by
moving the pointer over the panel and asking what lies beneath it, and are pressed by events of Blender's own
queue.
"""

import json
import math
import os
import pathlib
import shutil
import sys
import time
import traceback

import bpy
import numpy

FOLDER = pathlib.Path(sys.argv[-1])
BEAT_SECONDS = 0.02
PATIENCE_SECONDS = 240.0
COPIES = 40
STEP = 6  # pixels between the places where a button is looked for

demc = sys.modules["bl_ext.user_default.demc"]
jobs, panel = demc.jobs, demc.panel


class Found:
    """What was checked, and how long Blender stood still at most."""

    def __init__(self):
        self.lines, self.failed = [], 0
        self.last, self.longest = time.monotonic(), 0.0

    def check(self, holds, words):
        self.failed += not holds
        self.lines.append(f"{'ok' if holds else 'FAILED'}: {words}")
        print(self.lines[-1], flush=True)

    def beat(self):
        now = time.monotonic()
        self.longest, self.last = max(self.longest, now - self.last), now

    def moved(self, words):
        # Against the job's time, not the clock: on a busy machine all is slow, but a Blender that waits
        # stands still for as long as the job takes. A second is what drawing by software may take.
        taken = jobs.current().seconds
        self.check(self.longest < max(taken / 2, 1.0), f"{words}: still for {self.longest:.2f} s at most of {taken:.1f} s")

    def end(self):
        said = {"blender": bpy.app.version_string, "failed": self.failed, "lines": self.lines}
        (FOLDER / "said.json").write_text(json.dumps(said))


found = Found()


def scene():
    """The scene, looked up anew each time: undo replaces it."""
    return bpy.context.window_manager.windows[0].scene


def area(kind):
    """The editor of a kind."""
    return next(area for area in bpy.context.window_manager.windows[0].screen.areas if area.type == kind)


def override(of):
    """Blender's context with the pointer in an editor."""
    region = next(region for region in of.regions if region.type == "WINDOW")
    return bpy.context.temp_override(window=bpy.context.window_manager.windows[0], area=of, region=region)


def until(holds):
    """Waits, and fails rather than for ever."""
    end = time.monotonic() + PATIENCE_SECONDS
    while not holds():
        if time.monotonic() > end:
            raise TimeoutError("waited in vain")
        yield


def pause(seconds):
    """Lets Blender draw."""
    end = time.monotonic() + seconds
    yield from until(lambda: time.monotonic() > end)


def event(kind, value, where, **modifiers):
    """One event of the mouse or the keyboard."""
    bpy.context.window_manager.windows[0].event_simulate(kind, value, x=where[0], y=where[1], **modifiers)


def press(kind, of, **modifiers):
    """A key, with the pointer in the middle of an editor."""
    where = (of.x + of.width // 2, of.y + of.height // 2)
    event("MOUSEMOVE", "NOTHING", where)
    yield
    event(kind, "PRESS", where, **modifiers)
    event(kind, "RELEASE", where, **modifiers)
    yield from pause(0.3)


def click(command, across=0.6):
    """Looks for the button of a command from the panel's top down, and presses it."""
    of = area("PROPERTIES")
    for y in range(of.y + of.height - 40, of.y + 4, -STEP):
        where = (of.x + int(of.width * across), y)
        event("MOUSEMOVE", "NOTHING", where)
        yield
        yield
        with override(of):
            bpy.context.window_manager.clipboard = ""
            if bpy.ops.ui.copy_python_command_button.poll():
                bpy.ops.ui.copy_python_command_button()
            beneath = bpy.context.window_manager.clipboard
        if command in beneath:
            event("LEFTMOUSE", "PRESS", where)
            yield
            event("LEFTMOUSE", "RELEASE", where)
            yield
            return
    raise LookupError(f"no button for {command}")


def said():
    """All that operators reported, as the Info editor lists it."""
    of = area("IMAGE_EDITOR")
    of.type = "INFO"
    yield from pause(0.2)
    with override(of):
        bpy.ops.info.select_all(action="SELECT")
        bpy.ops.info.report_copy()
    of.type = "IMAGE_EDITOR"
    return bpy.context.window_manager.clipboard


def picture(name):
    """What the window shows. Blender's own pictures of windows are black where Mesa draws them by
    software."""
    yield from pause(0.7)
    shutil.copy(FOLDER / "Xvfb_screen0", FOLDER / f"{name}.xwd")


def box(name, size, location, colour, texture=False, **inputs):
    """A block with a material."""
    bpy.ops.mesh.primitive_cube_add(size=1, location=location, scale=size)
    material = bpy.data.materials.new(name)
    if bpy.app.version < (5, 0):
        material.use_nodes = True
    shader = material.node_tree.nodes["Principled BSDF"]
    shader.inputs["Base Color"].default_value = (*colour, 1.0)
    for key, value in inputs.items():
        shader.inputs[key.replace("_", " ")].default_value = value
    if texture:
        checker = material.node_tree.nodes.new("ShaderNodeTexChecker")
        checker.inputs["Scale"].default_value = 12.0
        checker.inputs["Color1"].default_value, checker.inputs["Color2"].default_value = (*colour, 1.0), (0.1, 0.1, 0.15, 1.0)
        material.node_tree.links.new(checker.outputs["Color"], shader.inputs["Base Color"])
    bpy.context.object.data.materials.append(material)
    return bpy.context.object


def build():
    """A room with coloured walls, a checkered floor, and a monkey of metal and a ball of glass in it."""
    for thing in list(bpy.data.objects):
        bpy.data.objects.remove(thing)
    white = (0.7, 0.7, 0.7)
    box("floor", (4, 4, 0.1), (0, 0, 0), white, texture=True)
    box("ceiling", (4, 4, 0.1), (0, 0, 3), white)
    box("back", (4, 0.1, 3), (0, 2, 1.5), white)
    box("left", (0.1, 4, 3), (-2, 0, 1.5), (0.6, 0.05, 0.04))
    box("right", (0.1, 4, 3), (2, 0, 1.5), (0.05, 0.35, 0.06))
    glass = box("glass", (0.1, 0.1, 0.1), (0, 0, -1), white, Transmission_Weight=1.0, Roughness=0.0)
    metal = box("metal", (0.1, 0.1, 0.1), (0, 0, -1), (0.9, 0.6, 0.3), Metallic=1.0, Roughness=0.25)
    bpy.ops.mesh.primitive_monkey_add(size=1.5, location=(-0.7, 0.5, 0.9), rotation=(0, 0, 0.5))
    monkey = bpy.context.object
    bpy.ops.mesh.primitive_uv_sphere_add(radius=0.5, location=(0.9, -0.3, 0.55), segments=48, ring_count=24)
    ball = bpy.context.object
    for thing, block in ((monkey, metal), (ball, glass)):
        thing.data.materials.append(block.data.materials[0])
        for polygon in thing.data.polygons:
            polygon.use_smooth = True
    bpy.ops.object.light_add(type="AREA", location=(0, 0, 2.9))
    bpy.context.object.data.energy, bpy.context.object.data.size = 80, 1.0
    bpy.ops.object.camera_add(location=(0, -6.2, 1.5), rotation=(math.pi / 2, 0, 0))
    made = scene()
    made.camera = bpy.context.object
    made.render.engine = "CYCLES"
    made.cycles.samples, made.cycles.device, made.cycles.use_denoising = 4, "CPU", True
    made.cycles.use_adaptive_sampling = False
    made.render.resolution_x, made.render.resolution_y, made.render.resolution_percentage = 480, 270, 100
    made.render.filepath = str(FOLDER / "shot_")
    bpy.ops.wm.save_as_mainfile(filepath=str(FOLDER / "room.blend"))


def arrange():
    """The picture at the left, the compositor below it, the panel at the right, opened."""
    window = bpy.context.window_manager.windows[0]
    with override(area("OUTLINER")):
        bpy.ops.screen.area_close()
    yield from pause(0.3)
    area("DOPESHEET_EDITOR").ui_type = "CompositorNodeTree"
    area("VIEW_3D").ui_type = "IMAGE_EDITOR"
    yield from pause(0.3)
    properties, nodes = area("PROPERTIES"), area("NODE_EDITOR")
    nodes.spaces.active.show_region_ui = False
    if hasattr(nodes.spaces.active, "show_region_asset_shelf"):
        nodes.spaces.active.show_region_asset_shelf = False
    with bpy.context.temp_override(window=window):
        bpy.ops.screen.area_move(x=properties.x - 1, y=properties.y + 200, delta=int(window.width * 0.66) - properties.x)
        yield from pause(0.3)
        bpy.ops.screen.area_move(x=200, y=nodes.y + nodes.height, delta=int(window.height * 0.38) - nodes.height)
    # The others make room, as where a user closes them.
    for kind in bpy.types.Panel.__subclasses__():
        if getattr(kind, "bl_context", "") == "render" and kind.is_registered and not kind.__name__.startswith("DEMC"):
            bpy.utils.unregister_class(kind)
    panel.unregister()
    panel.DEMC_PT_panel.bl_options = set()
    panel.register()
    properties.spaces.active.context = "RENDER"
    yield from pause(0.5)


def show_render():
    """The render in the image editor, whole."""
    of = area("IMAGE_EDITOR")
    of.spaces.active.image = bpy.data.images["Render Result"]
    yield from pause(0.3)
    with override(of):
        bpy.ops.image.view_all(fit_view=True)


def render():
    """F12, to the end."""
    ended = []
    bpy.app.handlers.render_complete.append(lambda *_: ended.append(True))
    yield from press("F12", area("IMAGE_EDITOR"))
    yield from until(lambda: ended and not bpy.app.is_job_running("RENDER"))
    bpy.app.handlers.render_complete.pop()


def prepared():
    layer = scene().view_layers[0]
    return layer.cycles.denoising_store_passes and scene().render.image_settings.file_format == "OPEN_EXR_MULTILAYER"


def wired():
    tree = getattr(scene(), "compositing_node_group", None) or getattr(scene(), "node_tree", None)
    return tree is not None and any(node.get("demc") for node in tree.nodes)


def job_ends():
    """Waits for a job to begin and to end, and how Blender fares meanwhile."""
    yield from until(jobs.is_running)
    found.longest = 0.0
    yield from until(lambda: not jobs.is_running())


def prepare_and_undo():
    yield from picture("missing")
    yield from click("demc.prepare")
    yield from until(prepared)
    yield from press("Z", area("IMAGE_EDITOR"), ctrl=True)
    found.check(not prepared(), "undo takes back what Prepare Passes set")
    yield from press("Z", area("IMAGE_EDITOR"), ctrl=True, shift=True)
    found.check(prepared(), "redo sets it again")


def this_render():
    yield from render()
    yield from show_render()
    yield from picture("noisy")
    yield from click("demc.denoise_render")
    yield from job_ends()
    found.moved("Denoise This Render")
    yield from pause(0.5)
    image = bpy.data.images.get("Denoised Scene")
    found.check(image is not None and tuple(image.size) == (480, 270), f"a picture of the result: {jobs.current().summary()}")
    found.check(area("IMAGE_EDITOR").spaces.active.image == image, "the image editor shows it")
    found.check(wired(), "the compositor has it")
    nodes = area("NODE_EDITOR")
    yield from wipe(nodes)
    yield from press("Z", nodes, ctrl=True)
    found.check(not wired(), "undo takes back what was wired")
    yield from press("Z", nodes, ctrl=True, shift=True)
    found.check(wired(), "redo wires it again")


def wipe(nodes):
    """The compositor's viewer has the noisy picture at the left and the denoised one at the right."""
    # Blender computes a viewer that is looked at.
    nodes.spaces.active.show_backdrop = True
    yield from until(lambda: "Viewer Node" in bpy.data.images and bpy.data.images["Viewer Node"].size[0] == 480)
    yield from pause(2.0)
    nodes.spaces.active.show_backdrop = False
    image = bpy.data.images["Viewer Node"]
    pixels = numpy.array(image.pixels).reshape(270, 480, 4)[..., :3].mean(axis=2)
    left, right = (float(numpy.abs(numpy.diff(half, axis=1)).mean()) for half in (pixels[:, 10:230], pixels[:, 250:470]))
    found.check(left > 2 * right, f"a wipe: neighbours differ by {left:.4f} at the left, {right:.4f} at the right")
    area("IMAGE_EDITOR").spaces.active.image = image
    for node in bpy.data.node_groups[-1].nodes if bpy.app.version >= (5, 0) else scene().node_tree.nodes:
        node.select = bool(node.get("demc"))
    yield from pause(0.5)
    with override(area("IMAGE_EDITOR")):
        bpy.ops.image.view_all(fit_view=True)
    with override(nodes):
        bpy.ops.node.view_selected()
    yield from picture("wipe")
    area("IMAGE_EDITOR").spaces.active.image = bpy.data.images["Denoised Scene"]


def folders():
    yield from click("demc.denoise_folder")
    yield from pause(0.3)
    yield from picture("refused")
    yield from press("ESC", area("IMAGE_EDITOR"))
    text = yield from said()
    found.check("Choose the folder of the frames first" in text, "what is wrong is reported in words")
    # Frames enough to be cancelled among them.
    frames = FOLDER / "frames"
    frames.mkdir()
    bpy.data.images["Render Result"].save_render(str(frames / "shot_0001.exr"), scene=scene())
    for number in range(2, COPIES + 1):
        shutil.copy(frames / "shot_0001.exr", frames / f"shot_{number:04}.exr")
    scene().demc.folder, scene().demc.model, scene().demc.threads = "//frames", "demc-l", 1
    for how in ("Escape", "the X"):
        yield from click("demc.denoise_folder")
        yield from until(lambda: jobs.is_running() and jobs.current().finished > 2)
        found.longest = 0.0
        if how == "Escape":
            yield from picture("progress")
            yield from press("ESC", area("IMAGE_EDITOR"))
        else:
            yield from click("demc.cancel", across=0.93)
        yield from until(lambda: not jobs.is_running())
        found.moved(f"Denoise This Folder until {how}")
        done = [path.name for path in (frames / "denoised").iterdir()]
        found.check(jobs.current().state == jobs.CANCELLED and 2 < len(done) < COPIES, f"{how} cancels after {len(done)} frames")
        found.check(not any(name.endswith(".tmp") for name in done), "no half file is left")
        shutil.rmtree(frames / "denoised")
    text = yield from said()
    found.check("Cancelled; " in text, "that it was cancelled is reported")


def after_render():
    scene().demc.after_render, scene().demc.threads, scene().demc.model = True, 0, "demc-m"
    bpy.data.images.remove(bpy.data.images["Denoised Scene"])
    yield from show_render()
    yield from render()
    yield from job_ends()
    found.moved("Denoise After Render")
    yield from pause(0.5)
    image = bpy.data.images.get("Denoised Scene")
    found.check(image is not None and area("IMAGE_EDITOR").spaces.active.image == image, "F12 shows a denoised picture")
    scene().view_layers[0].cycles.denoising_store_passes = False
    yield from render()
    yield from until(jobs.refusal)
    found.check("Denoising Data" in jobs.refusal(), "the panel says why a render was not denoised")
    yield from picture("not_denoised")
    scene().view_layers[0].cycles.denoising_store_passes, scene().demc.after_render = True, False


def another_file():
    scene().demc.threads = 1
    yield from click("demc.denoise_folder")
    yield from until(jobs.is_running)
    job = jobs.current()
    bpy.ops.wm.read_homefile(use_empty=True)
    yield from pause(0.5)
    found.check(job.state == jobs.CANCELLED and jobs.current() is None, "opening another file cancels")


def story():
    """All of it."""
    yield from pause(1.0)
    build()
    yield from arrange()
    for part in (prepare_and_undo, this_render, folders, after_render, another_file):
        yield from part()


def beat(told=story()):
    """Goes on with the story; the timer's function."""
    found.beat()
    try:
        next(told)
    except StopIteration:
        pass
    except Exception:
        found.check(False, traceback.format_exc())
        shutil.copy(FOLDER / "Xvfb_screen0", FOLDER / "failed.xwd")
    else:
        return BEAT_SECONDS
    found.end()
    # Not quit_blender, which would ask whether to save.
    os._exit(bool(found.failed))


bpy.context.preferences.view.show_splash = False
bpy.context.preferences.view.render_display_type = "NONE"
bpy.app.timers.register(beat, first_interval=BEAT_SECONDS, persistent=True)
