"""The extension in Blender's Python module, as a user has it: installed from its archive, enabled, used,
disabled.

    python test_extension.py ARCHIVE.zip      with bpy 4.5 or 5.0 from PyPI
"""

import os
import pathlib
import sys
import tempfile
import time
import types
import unittest

ARCHIVE = pathlib.Path(sys.argv.pop(1)).resolve()
_home = tempfile.TemporaryDirectory()
os.environ["BLENDER_USER_RESOURCES"] = _home.name

import bpy  # noqa: E402  (reads the environment when it is loaded)

MODULE = "bl_ext.user_default.demc"


def handlers():
    """All handlers there are, by name."""
    names = ("render_init", "render_write", "render_complete", "render_cancel", "load_pre")
    return {name: list(getattr(bpy.app.handlers, name)) for name in names}


def classes():
    """Names of what is registered."""
    return {name for kind in (bpy.types.Operator, bpy.types.Panel, bpy.types.PropertyGroup)
            for name in (cls.__name__ for cls in kind.__subclasses__() if cls.is_registered) if "demc" in name.lower()}


def install():
    """Installs and enables the archive as Preferences > Get Extensions > Install from Disk does."""
    bpy.ops.extensions.package_install_files(filepath=str(ARCHIVE), repo="user_default", enable_on_install=True)


def scene(folder, size=32):
    """A cube under a lamp before a camera, to be rendered in a moment."""
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=False)
    made = bpy.context.scene
    bpy.ops.mesh.primitive_cube_add()
    bpy.ops.object.light_add(type="SUN", rotation=(0.5, 0.3, 0))
    bpy.ops.object.camera_add(location=(4, -4, 3), rotation=(1.1, 0, 0.785))
    made.camera = bpy.context.object
    made.render.engine = "CYCLES"
    made.cycles.samples, made.cycles.device = 2, "CPU"
    # Debian builds Blender 4.3 without Open Image Denoise, and refuses to render with it.
    made.cycles.use_denoising = False
    made.render.resolution_x = made.render.resolution_y = size
    made.render.filepath = os.path.join(folder, "shot_")
    made.frame_start, made.frame_end = 1, 2
    made.demc.output = os.path.join(folder, "clean")
    made.demc.model = "demc-s"
    return made


class Extension(unittest.TestCase):
    @classmethod
    def setUpClass(cls):
        cls.before = handlers()
        install()

    def setUp(self):
        folder = tempfile.TemporaryDirectory()
        self.addCleanup(folder.cleanup)
        self.folder = folder.name
        self.scene = scene(self.folder)

    def prepared(self):
        self.assertEqual(bpy.ops.demc.prepare(), {"FINISHED"})
        self.assertEqual(sys.modules[f"{MODULE}.passes"].missing(self.scene, frames=True), [])

    def clean(self):
        folder = pathlib.Path(self.folder, "clean")
        return sorted(path.name for path in folder.iterdir()) if folder.is_dir() else []

    def picture(self):
        """Renders and denoises; returns the values of the picture that is shown."""
        bpy.ops.render.render()
        self.assertEqual(bpy.ops.demc.denoise_render(), {"FINISHED"})
        return bpy.data.images[f"Denoised {self.scene.name}"].pixels[:]

    def refused(self, operator, words):
        with self.assertRaisesRegex(RuntimeError, words):
            operator()

    def test_this_render_becomes_a_picture_beside_the_noisy_one(self):
        self.prepared()
        bpy.ops.render.render()
        settings = self.scene.render.image_settings
        settings.file_format = "OPEN_EXR_MULTILAYER"
        kept = (settings.file_format, settings.color_depth, settings.exr_codec)
        self.assertEqual(bpy.ops.demc.denoise_render(), {"FINISHED"})
        self.assertEqual((settings.file_format, settings.color_depth, settings.exr_codec), kept)
        picture = bpy.data.images[f"Denoised {self.scene.name}"]
        self.assertEqual(tuple(picture.size), (32, 32))
        self.assertTrue(max(picture.pixels[:]) > 0.0)
        tree = getattr(self.scene, "compositing_node_group", None) or self.scene.node_tree
        mine = [node for node in tree.nodes if node.get("demc")]
        split = next(node for node in mine if node.bl_idname == "CompositorNodeSplit")
        sides = [link.from_node.bl_idname for socket in split.inputs for link in socket.links]
        self.assertEqual(sides, ["CompositorNodeImage", "CompositorNodeRLayers"], "the result is at the right")
        # A window refuses to render a scene whose compositor has no output.
        outputs = [node for node in tree.nodes if node.bl_idname in ("CompositorNodeComposite", "NodeGroupOutput")]
        self.assertTrue(outputs and outputs[0].inputs["Image"].is_linked)
        # Again: the picture is the same one, and the nodes are not doubled.
        count = len(tree.nodes)
        bpy.ops.demc.denoise_render()
        self.assertEqual(len(tree.nodes), count)

    def image_settings(self):
        """How the scene says that images are saved, all of it."""
        settings = self.scene.render.image_settings
        names = [p.identifier for p in settings.bl_rna.properties if p.type in ("ENUM", "INT", "BOOLEAN", "FLOAT")]
        return {name: getattr(settings, name) for name in names}

    def test_this_render_leaves_how_images_are_saved_as_it_is(self):
        self.prepared()
        bpy.ops.render.render()
        settings = self.scene.render.image_settings
        for media, kind, depth in (("IMAGE", "PNG", "8"), ("IMAGE", "JPEG", "8"), ("IMAGE", "OPEN_EXR", "16"),
                                   ("VIDEO", "FFMPEG", "8"), ("MULTI_LAYER_IMAGE", "OPEN_EXR_MULTILAYER", "16")):
            if hasattr(settings, "media_type"):
                settings.media_type = media
            settings.file_format, settings.color_depth = kind, depth
            if "EXR" in kind:
                settings.exr_codec = "DWAB"
            before = self.image_settings()
            self.assertEqual(bpy.ops.demc.denoise_render(), {"FINISHED"}, kind)
            self.assertEqual(self.image_settings(), before)

    def test_this_render_leaves_the_colour_space_of_files_as_it_is(self):
        self.prepared()
        settings = self.scene.render.image_settings
        settings.color_management = "OVERRIDE"
        settings.linear_colorspace_settings.name = "ACEScg"
        bpy.ops.render.render()
        self.assertEqual(bpy.ops.demc.denoise_render(), {"FINISHED"})
        self.assertEqual(settings.linear_colorspace_settings.name, "ACEScg")

    def test_colours_are_those_that_blender_computes_in(self):
        if not hasattr(bpy.data, "colorspace"):
            self.skipTest("before Blender 5 there is one working space")
        self.prepared()
        bpy.ops.wm.set_working_color_space(working_space="ACEScg")
        bpy.ops.render.render()
        self.assertEqual(bpy.ops.demc.denoise_render(), {"FINISHED"})
        image = bpy.data.images[f"Denoised {self.scene.name}"]
        self.assertEqual(image.colorspace_settings.name, "ACEScg")
        # Also where files have colours of their own, which stay as they are.
        usual = image.pixels[:]
        settings = self.scene.render.image_settings
        settings.color_management = "OVERRIDE"
        settings.view_settings.view_transform, settings.view_settings.exposure = "Raw", 1.5
        self.assertEqual(bpy.ops.demc.denoise_render(), {"FINISHED"})
        self.assertTrue(image.pixels[:] == usual, "the colours were converted")
        self.assertEqual((settings.view_settings.view_transform, settings.view_settings.exposure), ("Raw", 1.5))

    def test_pixels_that_are_not_square(self):
        self.scene.render.pixel_aspect_x = 2.0
        self.prepared()
        bpy.ops.render.render(animation=True)
        self.assertEqual(bpy.ops.demc.denoise_range(), {"FINISHED"})
        self.assertEqual(bpy.ops.demc.denoise_render(), {"FINISHED"})

    def test_the_wipe_shows_this_scene(self):
        self.prepared()
        bpy.ops.render.render()
        tree = sys.modules[f"{MODULE}.compositor"]._tree(self.scene)
        elsewhere = bpy.data.scenes.new("elsewhere")
        for node in tree.nodes:
            if node.bl_idname == "CompositorNodeRLayers":
                node.scene = elsewhere
        self.assertEqual(bpy.ops.demc.denoise_render(), {"FINISHED"})
        split = next(node for node in tree.nodes if node.bl_idname == "CompositorNodeSplit")
        shown = [link.from_node for socket in split.inputs for link in socket.links]
        renders = [node.scene for node in shown if node.bl_idname == "CompositorNodeRLayers"]
        self.assertEqual(renders, [self.scene])

    def test_frames_that_are_not_there_and_paths_that_mean_nothing_are_told(self):
        self.prepared()
        bpy.ops.render.render(animation=True)
        self.scene.frame_end = 5
        self.assertEqual(bpy.ops.demc.denoise_range(), {"FINISHED"})
        told = sys.modules[f"{MODULE}.jobs"].current().notes
        self.assertTrue(any("3 of the frames 1 to 5 are not there, such as shot_0003.exr" in note for note in told), told)
        if bpy.app.version >= (4, 5):  # variables in braces
            self.scene.render.filepath = os.path.join(self.folder, "{nope}", "shot_")
            self.refused(bpy.ops.demc.denoise_range, "Output path .* cannot be read")
            bpy.ops.render.render()

    def test_results_of_frames_that_were_rendered_again_are_told(self):
        self.prepared()
        bpy.ops.render.render(animation=True)
        self.assertEqual(bpy.ops.demc.denoise_range(), {"FINISHED"})
        later = time.time() + 60
        os.utime(bpy.path.abspath(self.scene.render.frame_path(frame=2)), (later, later))
        self.assertEqual(bpy.ops.demc.denoise_range(), {"FINISHED"})
        told = "2 results were there already, 1 of an older render or other settings (Overwrite makes them again)"
        self.assertEqual(sys.modules[f"{MODULE}.jobs"].current().summary(), told)

    def test_both_eyes(self):
        self.prepared()
        self.scene.render.use_multiview = True
        bpy.ops.render.render(animation=True)
        self.assertEqual(bpy.ops.demc.denoise_range(), {"FINISHED"})
        eyes = [f"shot_000{frame}_{eye}.exr" for frame in (1, 2) for eye in "LR"]
        self.assertEqual(self.clean(), eyes)
        self.assertEqual(bpy.ops.demc.denoise_render(), {"FINISHED"})
        self.assertIn(f"Denoised {self.scene.name}", bpy.data.images)
        self.assertEqual(self.scene.render.image_settings.views_format, "INDIVIDUAL")
        # Frames of one eye each are shots.
        self.scene.demc.use_temporal = self.scene.demc.overwrite = True
        self.prepared()
        bpy.ops.render.render(animation=True)
        self.assertEqual(bpy.ops.demc.denoise_range(), {"FINISHED"})
        notes = sys.modules[f"{MODULE}.jobs"].current().notes
        self.assertFalse([note for note in notes if "frame number" in note], notes)

    def test_one_eye_of_two(self):
        self.prepared()
        render = self.scene.render
        render.use_multiview, render.views["right"].use = True, False
        # Blender renders none but left and right where the setup is for two eyes.
        render.views.new("centre")
        bpy.ops.render.render(animation=True)
        self.assertEqual(bpy.ops.demc.denoise_range(), {"FINISHED"})
        self.assertEqual(self.clean(), ["shot_0001_L.exr", "shot_0002_L.exr"])
        self.assertEqual(sys.modules[f"{MODULE}.jobs"].current().notes, [])

    def test_stereo_that_keeps_no_passes_is_prepared(self):
        settings = self.scene.render.image_settings
        self.scene.render.use_multiview = True
        settings.views_format = "STEREO_3D"
        self.prepared()
        self.assertIn(settings.views_format, ("INDIVIDUAL", "MULTIVIEW"))
        bpy.ops.render.render(animation=True)
        self.assertEqual(bpy.ops.demc.denoise_range(), {"FINISHED"})

    def test_light_groups_are_not_what_is_shown(self):
        self.prepared()
        self.scene.demc.use_compositor = False
        usual = self.picture()
        for name in ("a_key", "fill"):
            self.scene.view_layers[0].lightgroups.add(name=name)
        bpy.data.objects["Sun"].lightgroup = "fill"
        self.scene.demc.light_passes = True
        self.assertTrue(self.picture() == usual, "one light group is shown")

    def test_what_is_refused_leaves_no_copy_of_the_render(self):
        self.prepared()
        bpy.ops.render.render()
        self.scene.demc.model, self.scene.demc.weights = "FILE", ""
        before = os.listdir(bpy.app.tempdir)
        self.refused(bpy.ops.demc.denoise_render, "Choose the weights file")
        self.assertEqual(os.listdir(bpy.app.tempdir), before)
        self.scene.demc.output = "//clean"
        self.refused(bpy.ops.demc.denoise_render, "begins at the .blend")

    def test_frames_without_an_ending_in_their_names(self):
        self.scene.render.use_file_extension = False
        self.prepared()
        bpy.ops.render.render(animation=True)
        self.assertEqual(bpy.ops.demc.denoise_range(), {"FINISHED"})

    def test_a_single_render_needs_nothing_that_frames_need(self):
        self.prepared()
        self.scene.demc.use_temporal = self.scene.render.use_motion_blur = True
        bpy.ops.render.render()
        self.assertEqual(bpy.ops.demc.denoise_render(), {"FINISHED"})
        self.scene.view_layers.new("without").cycles.denoising_store_passes = False
        bpy.ops.render.render()
        self.refused(bpy.ops.demc.denoise_render, "without lacks albedo")
        self.scene.demc.view_layer = self.scene.view_layers[0].name
        self.assertEqual(bpy.ops.demc.denoise_render(), {"FINISHED"})

    def test_what_goes_not_with_temporal_is_said(self):
        self.prepared()
        bpy.ops.render.render(animation=True)
        self.scene.demc.use_temporal = self.scene.demc.light_passes = True
        self.refused(bpy.ops.demc.denoise_range, "turn off Light Passes or Temporal")

    def test_a_view_layer_of_the_results_name(self):
        self.prepared()
        self.scene.demc.use_compositor = False
        usual = self.picture()
        self.scene.view_layers[0].name = "Denoised"
        # Not assertEqual, which would look for hours at how thousands of numbers differ.
        self.assertTrue(self.picture() == usual, "the noisy picture is shown")

    def test_frames_of_a_range_and_of_a_folder(self):
        self.prepared()
        bpy.ops.render.render(animation=True)
        self.assertEqual(bpy.ops.demc.denoise_range(), {"FINISHED"})
        self.assertEqual(self.clean(), ["shot_0001.exr", "shot_0002.exr"])
        self.scene.demc.folder = self.folder
        self.scene.demc.output = os.path.join(self.folder, "other")
        self.assertEqual(bpy.ops.demc.denoise_folder(), {"FINISHED"})
        self.assertEqual(sorted(os.listdir(self.scene.demc.output)), ["shot_0001.exr", "shot_0002.exr"])

    def test_renders_are_denoised_when_they_are_done(self):
        self.prepared()
        self.scene.demc.after_render = True
        bpy.ops.render.render()
        self.assertIn(f"Denoised {self.scene.name}", bpy.data.images)
        bpy.ops.render.render(animation=True)
        self.assertEqual([name for name in self.clean() if name.startswith("shot_")], ["shot_0001.exr", "shot_0002.exr"])

    def test_a_render_in_a_window_is_followed_by_timers(self):
        handlers = sys.modules[f"{MODULE}.handlers"]
        self.prepared()
        bpy.ops.render.render()
        self.assertIsNone(handlers._begin_later(self.scene.name, []))
        while handlers._follow() is not None:
            time.sleep(0.02)
        self.assertIn(f"Denoised {self.scene.name}", bpy.data.images)

    def test_a_render_while_another_is_denoised_waits_for_it(self):
        handlers = sys.modules[f"{MODULE}.handlers"]
        jobs, job = self.begun()
        self.assertEqual(handlers._begin_later(self.scene.name, []), handlers._LOOK_SECONDS)
        job.wait()
        self.assertIsNone(handlers._begin_later(self.scene.name, []))
        self.assertIsNot(jobs.current(), job)
        self.assertIsNone(jobs.refusal())
        jobs.current().wait()

    def test_what_is_being_rendered_is_not_saved(self):
        operators = sys.modules[f"{MODULE}.operators"]
        self.prepared()
        self.assertTrue(bpy.ops.demc.denoise_render.poll())
        kept, busy = operators.bpy, types.SimpleNamespace(is_job_running=lambda kind: kind == "RENDER")
        operators.bpy = types.SimpleNamespace(app=busy)
        try:
            self.assertFalse(bpy.ops.demc.denoise_render.poll())
        finally:
            operators.bpy = kept

    def test_strips_of_an_edit_are_no_renders_of_their_own(self):
        jobs = sys.modules[f"{MODULE}.jobs"]
        self.prepared()
        self.scene.demc.after_render = True
        edit = bpy.data.scenes.new("edit")
        edit.render.resolution_x = edit.render.resolution_y = 16
        edit.frame_start, edit.frame_end = 1, 2
        edit.render.filepath = os.path.join(self.folder, "edit_")
        sequences = edit.sequence_editor_create()
        strips = sequences.strips if hasattr(sequences, "strips") else sequences.sequences  # before 4.4
        strips.new_scene("shot", self.scene, 1, 1)
        jobs.abandon()
        bpy.ops.render.render(animation=True, scene="edit")
        self.assertTrue(os.path.isfile(os.path.join(self.folder, "edit_0002.png")))
        self.assertEqual((jobs.current(), jobs.refusal(), self.clean()), (None, None, []))
        # The next render of the shot itself is one.
        bpy.ops.render.render(scene=self.scene.name)
        self.assertIsNotNone(jobs.current())

    def test_what_scripts_render_is_not_denoised(self):
        jobs = sys.modules[f"{MODULE}.jobs"]
        sys.path.insert(0, str(pathlib.Path(__file__).resolve().parents[2] / "blender_scripts"))
        from demc_blender import rendering
        from demc_blender.edits import Edits

        self.prepared()
        self.scene.demc.after_render = True
        jobs.abandon()
        with Edits() as edits:
            rendering.prepare_scene(edits, self.scene)
            bpy.ops.render.render(write_still=True)
        self.assertIsNone(jobs.current())
        self.assertTrue(self.scene.demc.after_render)

    def brightness(self):
        image = bpy.data.images[f"Denoised {self.scene.name}"]
        return sum(image.pixels[:]) / len(image.pixels)

    def test_a_picture_that_was_packed_shows_the_new_result(self):
        self.prepared()
        bpy.ops.render.render()
        bpy.ops.demc.denoise_render()
        before = self.brightness()
        bpy.data.images[f"Denoised {self.scene.name}"].pack()
        bpy.data.lights[0].energy = 8.0
        bpy.ops.render.render()
        bpy.ops.demc.denoise_render()
        self.assertGreater(self.brightness(), 1.5 * before)

    def test_the_result_of_an_unsaved_file_is_kept_in_it(self):
        jobs = sys.modules[f"{MODULE}.jobs"]
        self.prepared()
        self.scene.demc.output = ""
        bpy.ops.render.render()
        bpy.ops.demc.denoise_render()
        image = bpy.data.images[f"Denoised {self.scene.name}"]
        self.assertIsNotNone(image.packed_file)
        self.assertTrue(any("the result is kept in it" in note for note in jobs.current().notes))
        os.remove(bpy.path.abspath(image.filepath))
        self.assertGreater(self.brightness(), 0.0)
        bpy.ops.render.render()
        bpy.ops.demc.denoise_render()
        self.assertTrue(os.path.isfile(bpy.path.abspath(image.filepath)))

    def test_the_wipe_shows_the_view_layer_that_was_denoised(self):
        self.prepared()
        more = self.scene.view_layers.new("A richer one")
        more.cycles.denoising_store_passes = more.use_pass_normal = more.use_pass_position = True
        bpy.ops.render.render()
        bpy.ops.demc.denoise_render()
        tree = sys.modules[f"{MODULE}.compositor"]._tree(self.scene)
        split = next(node for node in tree.nodes if node.bl_idname == "CompositorNodeSplit")
        shown = [link.from_node for socket in split.inputs for link in socket.links]
        layers = [node.layer for node in shown if node.bl_idname == "CompositorNodeRLayers"]
        self.assertEqual(layers, ["A richer one"])

    def test_frames_that_are_rendered_again_are_denoised_again(self):
        self.prepared()
        self.scene.demc.after_render = True
        bpy.ops.render.render(animation=True)
        results = [pathlib.Path(self.folder, "clean", f"shot_000{frame}.exr") for frame in (1, 2)]
        before = [result.read_bytes() for result in results]
        self.scene.cycles.seed += 1
        bpy.ops.render.render(animation=True)
        for result, was in zip(results, before):
            self.assertNotEqual(result.read_bytes(), was)

    def test_a_render_that_is_written_is_no_frame_of_an_animation(self):
        self.prepared()
        bpy.ops.render.render(animation=True)
        self.scene.demc.after_render = True
        bpy.ops.render.render(write_still=True)
        self.assertIn(f"Denoised {self.scene.name}", bpy.data.images)
        self.assertFalse([name for name in self.clean() if name.startswith("shot_000")])

    def test_prepare_tells_what_it_did(self):
        done = sys.modules[f"{MODULE}.passes"].prepare(self.scene)
        self.assertEqual(done, ["Denoising Data is on", "frames are saved as OpenEXR MultiLayer"])
        self.assertEqual(sys.modules[f"{MODULE}.passes"].prepare(self.scene), [])

    def test_undo_takes_back_what_was_prepared(self):
        def state():
            settings, layer = bpy.context.scene.render.image_settings, bpy.context.scene.view_layers[0]
            return settings.file_format, layer.cycles.denoising_store_passes

        before = state()
        bpy.ops.ed.undo_push(message="before")
        bpy.ops.demc.prepare()
        self.assertNotEqual(state(), before)
        bpy.ops.ed.undo_push(message="prepared")
        bpy.ops.ed.undo()
        self.assertEqual(state(), before)

    def test_what_is_missing_is_said_with_its_remedy(self):
        self.refused(bpy.ops.demc.denoise_folder, "Choose the folder")
        self.refused(bpy.ops.demc.denoise_range, "render the animation first")
        bpy.ops.render.render()
        self.refused(bpy.ops.demc.denoise_render, "Denoising Data.*Prepare Passes sets it")
        self.prepared()
        self.scene.demc.model, self.scene.demc.weights = "FILE", ""
        self.refused(bpy.ops.demc.denoise_render, "Choose the weights file")

    def begun(self):
        """The module of jobs, and one that denoises an animation just rendered."""
        jobs, plans = sys.modules[f"{MODULE}.jobs"], sys.modules[f"{MODULE}.plans"]
        self.prepared()
        bpy.ops.render.render(animation=True)
        job = plans.of_range(self.scene)
        jobs.begin(job)
        return jobs, job

    def test_a_job_is_cancelled_and_leaves_no_half_file(self):
        jobs, job = self.begun()
        self.assertTrue(jobs.is_running() and not bpy.ops.demc.denoise_range.poll())
        job.stop()
        job.wait()
        self.assertIn(job.state, (jobs.CANCELLED, jobs.DONE))
        self.assertFalse([name for name in self.clean() if name.endswith(".tmp")])

    def test_opening_another_file_ends_a_job(self):
        jobs, job = self.begun()
        bpy.ops.wm.read_homefile(use_empty=True)
        self.assertEqual((job.state, jobs.current()), (jobs.CANCELLED, None))

    def test_why_a_render_was_not_denoised_is_kept_for_the_panel(self):
        jobs = sys.modules[f"{MODULE}.jobs"]
        self.scene.demc.after_render = True
        bpy.ops.render.render()
        self.assertIn("Denoising Data", jobs.refusal())
        self.prepared()
        bpy.ops.render.render()
        self.assertIsNone(jobs.refusal())

    def test_a_worker_that_fails_is_told_in_words(self):
        self.prepared()
        pathlib.Path(self.folder, "shot_0001.exr").write_bytes(b"no EXR at all")
        self.refused(bpy.ops.demc.denoise_range, "shot_0001.exr.*not an EXR")

    def test_zz_nothing_stays_when_it_is_disabled(self):
        bpy.ops.preferences.addon_disable(module=MODULE)
        self.assertFalse(hasattr(bpy.types.Scene, "demc"))
        self.assertEqual(handlers(), self.before)
        self.assertFalse(classes())


if __name__ == "__main__":
    ended = unittest.main(verbosity=2, exit=False)
    _home.cleanup()
    sys.stdout.flush()
    sys.stderr.flush()
    # bpy 4.5 does not always come to its own end after many renders.
    os._exit(0 if ended.result.wasSuccessful() else 1)
