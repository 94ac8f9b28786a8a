"""The installed package against the installed command: same bits, same words."""

import json
import os
import pathlib
import re
import signal
import subprocess
import sys
import sysconfig
import tempfile
import threading
import time
import unittest
from unittest import mock

import numpy as np
import OpenImageIO as oiio

import demc

ROOT = pathlib.Path(__file__).resolve().parents[2]
ROOM = ROOT / "tests/data/s0000_room_0004spp.exr"
REFERENCE = ROOT / "tests/data/s0000_room_ref.exr"
COMMAND = pathlib.Path(sysconfig.get_path("scripts")) / "demc"


def command(*arguments):
    return subprocess.run([COMMAND, *map(str, arguments)], capture_output=True, text=True)


def passes(path):
    """Channels by name, and the header's text attributes, of all parts."""
    source = oiio.ImageInput.open(str(path))
    channels, samples, part = {}, None, 0
    while source.seek_subimage(part, 0):
        spec = source.spec()
        pixels = source.read_image(part, 0, 0, spec.nchannels, "float")
        channels.update((name, pixels[..., i]) for i, name in enumerate(spec.channelnames))
        count = spec.getattribute("cycles.ViewLayer.samples")
        samples = int(count) if count else samples
        part += 1
    source.close()
    return channels, samples


def stacked(channels, layer, components):
    return np.stack([channels[f"ViewLayer.{layer}.{c}"] for c in components], axis=-1).astype(np.float32)


class Package(unittest.TestCase):
    @unittest.skipUnless(hasattr(os, "fork"), "this system does not fork")
    def test_a_forked_process_denoises(self):
        color, albedo, normal, _ = self.arrays()
        expected = demc.denoise(color, albedo, normal, "demc-s")  # its threads are there now
        child = os.fork()
        if child == 0:
            os._exit(0 if (demc.denoise(color, albedo, normal, "demc-s") == expected).all() else 1)
        end = time.monotonic() + 60
        while (ended := os.waitpid(child, os.WNOHANG)) == (0, 0):
            if time.monotonic() > end:
                os.kill(child, signal.SIGKILL)
                os.waitpid(child, 0)
                self.fail("it waits for threads that the other process has")
            time.sleep(0.01)
        self.assertEqual(ended, (child, 0))

    def setUp(self):
        folder = tempfile.TemporaryDirectory()
        self.addCleanup(folder.cleanup)
        self.folder = pathlib.Path(folder.name)

    def arrays(self):
        channels, samples = passes(ROOM)
        color = stacked(channels, "Combined", "RGB")
        albedo = stacked(channels, "Denoising Albedo", "RGB")
        normal = stacked(channels, "Denoising Normal", "XYZ")
        return color, albedo, normal, samples

    def test_arrays_give_the_bits_of_the_command(self):
        done = command("denoise", ROOM, "--out", self.folder)
        self.assertEqual(done.returncode, 0, done.stderr)
        color, albedo, normal, samples = self.arrays()
        result = demc.denoise(color, albedo, normal, samples=samples)
        self.assertEqual((result.dtype, result.shape), (np.float32, color.shape))
        written = stacked(passes(self.folder / ROOM.name)[0], "Denoised", "RGB")
        # Stored as the beauty is: half floats in a file of half floats.
        if np.array_equal(written, written.astype(np.float16)):
            result = result.astype(np.float16).astype(np.float32)
        np.testing.assert_array_equal(result, written)
        self.assertFalse(np.array_equal(written, color))

    def test_halves_stay_halves_and_threads_change_no_bit(self):
        color, albedo, normal, _ = (a if i == 3 else a.astype(np.float16) for i, a in enumerate(self.arrays()))
        half = demc.denoise(color, albedo, normal, model="demc-s")
        self.assertEqual(half.dtype, np.float16)
        whole = [a.astype(np.float32) for a in (color, albedo, normal)]
        of_one = demc.denoise(*whole, model="demc-s", threads=1)
        np.testing.assert_array_equal(half, of_one.astype(np.float16))
        flipped = demc.denoise(*(a[:, ::-1][:, ::-1] for a in whole), model="demc-s")
        np.testing.assert_array_equal(flipped, of_one)

    def test_files_are_the_command_s_to_the_byte(self):
        command("denoise", ROOM, "--out", self.folder)
        out = self.folder / "module.exr"
        report = demc.denoise_file(ROOM, out)
        self.assertEqual((report["width"], report["view_layer"]), (128, "ViewLayer"))
        self.assertEqual(out.read_bytes(), (self.folder / ROOM.name).read_bytes())
        with self.assertRaisesRegex(demc.Error, "exists; overwrite=True"):
            demc.denoise_file(ROOM, out)
        demc.denoise_file(ROOM, out, model="demc-s", overwrite=True)
        self.assertNotEqual(out.read_bytes(), (self.folder / ROOM.name).read_bytes())
        with self.assertRaisesRegex(ValueError, "overwrite what it is made of"):
            demc.denoise_file(out, out, overwrite=True)
        with self.assertRaisesRegex(ValueError, "overwrite what it is made of"):
            demc.denoise_file(ROOM, out, albedo=out, overwrite=True)
        with self.assertRaisesRegex(ValueError, "from 1 to 4096"):
            demc.denoise_file(ROOM, out, overwrite=True, threads=4097)

    def test_python_ends_while_a_daemon_thread_is_in_a_call(self):
        code = (
            "import sys, threading, time, numpy, demc\n"
            "image = numpy.random.rand(400, 600, 3).astype('f4')\n"
            "threading.Thread(target=demc.denoise, args=(image,), kwargs={'threads': 1}, daemon=True).start()\n"
            "time.sleep(0.3)\n"
        )
        for _ in range(3):
            ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
            self.assertEqual((ended.returncode, ended.stderr), (0, ""))

    def test_what_is_masked_is_filled_in(self):
        color, albedo, normal, _ = self.arrays()
        hidden = np.zeros(color.shape, bool)
        hidden[10:20, 10:20] = True
        masked = np.ma.array(np.where(hidden, np.float32(1e4), color), mask=hidden)
        holes = np.where(hidden, np.float32(np.nan), color)
        one, other = (demc.denoise(c, albedo, normal, model="demc-s") for c in (masked, holes))
        np.testing.assert_array_equal(one, other)

    def test_alpha_goes_along_and_empty_pixels_stay_empty(self):
        color, albedo, normal, samples = self.arrays()
        rows, columns = np.mgrid[: color.shape[0], : color.shape[1]]
        covered = (rows - 64) ** 2 + (columns - 64) ** 2 < 40**2
        noise = np.random.default_rng(1).random(covered.shape) < 0.5
        edge = covered & ((rows - 64) ** 2 + (columns - 64) ** 2 > 36**2)
        alpha = np.where(edge, noise, covered).astype(np.float32)
        film = color * alpha[..., None]
        denoised, share = demc.denoise(film, albedo, normal, "demc-s", alpha=alpha, samples=samples)
        self.assertEqual((denoised.shape, share.shape, share.dtype), (color.shape, alpha.shape, np.float32))
        self.assertFalse(np.array_equal(share, alpha))
        far = (rows - 64) ** 2 + (columns - 64) ** 2 > 46**2
        self.assertEqual((denoised[far].max(), share[far].max()), (0, 0))
        self.assertEqual(demc.denoise(film, model="noisy", alpha=alpha.astype(np.float16))[1].dtype, np.float16)
        with self.assertRaisesRegex(ValueError, r"alpha has shape .*; give \(H, W\)"):
            demc.denoise(film, model="noisy", alpha=film)
        with self.assertRaisesRegex(demc.Error, "are NaN or infinite"):
            demc.denoise(np.full_like(color, np.nan), albedo, normal, "demc-s")

    def test_other_byte_orders_are_arrays_too(self):
        color, albedo, normal, _ = self.arrays()
        one = demc.denoise(color, albedo, normal, "demc-s")
        other = demc.denoise(color.astype(">f4"), albedo.astype(">f4"), normal, "demc-s")
        self.assertEqual(other.dtype, np.dtype(">f4"))
        np.testing.assert_array_equal(other, one)

    def test_a_call_as_python_ends_comes_back(self):
        code = (
            "import atexit, sys\n"
            "def last():\n    print(demc.inspect(sys.argv[1])['layout'])\n"
            "atexit.register(last)\n"
            "import demc\n"
        )
        ended = subprocess.run([sys.executable, "-c", code, ROOM], capture_output=True, text=True, timeout=60)
        self.assertEqual((ended.returncode, ended.stdout.strip()), (0, "multi-part"), ended.stderr)

    def test_files_take_the_command_s_options(self):
        def made(*options):
            self.assertEqual(command("denoise", ROOM, "--model", "demc-s", "--out", self.folder, "--overwrite", *options).returncode, 0)
            return (self.folder / ROOM.name).read_bytes()

        out = self.folder / "module.exr"
        for options, said in [
            (dict(layer="Clean"), ("--layer", "Clean")),
            (dict(layer=None), ("--replace",)),
            (dict(alpha="keep", confidence=True), ("--alpha", "keep", "--confidence")),
            (dict(passes=True), ("--passes",)),
        ]:
            report = demc.denoise_file(ROOM, out, "demc-s", overwrite=True, **options)
            self.assertEqual(out.read_bytes(), made(*said), said)
        self.assertEqual((report["samples"], report["was_denoised"]), (4, False))
        self.assertGreater(report["expected_error"], 0)
        demc.denoise_file(ROOM, out, "demc-s", overwrite=True)
        before, after = (demc.compare(out, REFERENCE, layer=layer)["relmse"] for layer in ("Combined", "Denoised"))
        self.assertLess(after, before)
        self.assertEqual(demc.compare(out, out, layer="Denoised", reference_layer="Denoised")["relmse"], 0)
        with self.assertRaisesRegex(ValueError, "give one of auto, denoise, keep"):
            demc.denoise_file(ROOM, self.folder / "new.exr", alpha="drop")
        with self.assertRaisesRegex(ValueError, "noisy denoises the beauty alone"):
            demc.denoise_file(ROOM, self.folder / "new.exr", model="noisy", passes=True)
        self.assertEqual(demc.models(), json.loads(command("models", "--json").stdout))
        self.assertIn("demc-m", [model["model"] for model in demc.models()])

    def test_wrong_arguments_are_named(self):
        for wrong, words in [
            ({"names": ["albedo=x"]}, "names is a list"), ({"names": {"albedo": None}}, "names has 'albedo': None"),
            ({"view_layer": 3}, "view_layer is a int"), ({"layer": 3}, "layer is a int"), ({"alpha": None}, "alpha is a NoneType"),
            ({"model": 3}, "model is a int"), ({"albedo": 3}, "albedo is a int"),
        ]:
            with self.assertRaisesRegex(ValueError, words):
                demc.denoise_file(ROOM, self.folder / "out.exr", **wrong)
        demc.denoise_file(os.fsencode(ROOM), os.fsencode(self.folder / "bytes.exr"), model="demc-s")
        pipe = self.folder / "pipe"
        os.mkfifo(pipe)
        with self.assertRaisesRegex(demc.Error, "what has this name is no file"):
            demc.denoise_file(ROOM, pipe, model="demc-s", overwrite=True)
        self.assertTrue(pipe.is_fifo())

    def test_ctrl_c_ends_the_command_as_it_ends_the_program(self):
        arguments = ["denoise", str(self.folder), "--out", str(self.folder / "out"), "--watch"]
        code = "import sys; from demc._command import main; sys.argv = ['demc', *sys.argv[1:]]; main()"
        with subprocess.Popen([sys.executable, "-c", code, *arguments], stderr=subprocess.PIPE, text=True) as process:
            time.sleep(2)
            process.send_signal(signal.SIGINT)
            said = process.communicate(timeout=20)[1]
        self.assertEqual((process.returncode, "Traceback" in said), (130, False), said)

    def test_inspect_and_compare_say_what_the_command_says(self):
        self.assertEqual(demc.inspect(ROOM), json.loads(command("inspect", "--json", ROOM).stdout))
        said = json.loads(command("compare", "--json", ROOM, REFERENCE).stdout)
        self.assertEqual(demc.compare(ROOM, REFERENCE), said)
        self.assertGreater(said["relmse"], 0)

    def test_guides_may_be_left_out(self):
        color, albedo, normal, _ = self.arrays()
        alike = lambda *guides: demc.denoise(color, *guides, model="demc-s")
        # What is blank holds as little as what is not there.
        np.testing.assert_array_equal(alike(), alike(np.zeros_like(albedo), np.zeros_like(normal)))
        self.assertFalse(np.array_equal(alike(albedo), alike()))

    def test_what_is_wrong_is_said(self):
        color, albedo, normal, _ = self.arrays()
        for words, arguments in [
            ("and alpha by itself", (np.zeros((4, 4, 4), np.float32),)),
            ("float64; give float32", (color.astype(np.float64),)),
            ("is a list", ([1.0],)),
            ("arrays of one render", (color, albedo[:-1], normal)),
            ("no model 'nosuch'", (color, albedo, normal, "nosuch")),
        ]:
            with self.subTest(words), self.assertRaisesRegex(ValueError, words):
                demc.denoise(*arguments)
        # In this order: a model that was found stays loaded.
        for words, weights in [
            ("demc: its weights are no part of the program", self.folder),
            ("demc needs the pass Normal", ROOT / "eval/rivals/weights"),
        ]:
            with mock.patch.dict(os.environ, DEMC_WEIGHTS=str(weights)), self.assertRaisesRegex(ValueError, words):
                demc.denoise(color, albedo, normal, "demc")
        with self.assertRaisesRegex(ValueError, "samples is 0"):
            demc.denoise(color, albedo, normal, samples=0)
        missing = self.folder / "missing.exr"
        for call in (demc.inspect, lambda p: demc.compare(p, p), lambda p: demc.denoise_file(p, self.folder / "o")):
            with self.assertRaisesRegex(demc.Error, r"missing\.exr: cannot read"):
                call(missing)
        self.assertEqual(command("inspect", missing).returncode, 1)
        self.assertEqual(command("nosuch").returncode, 2)

    def test_passes_are_found_under_names_and_in_files_of_their_own(self):
        names = {"albedo": "Denoising Albedo", "normal": "Denoising Normal"}
        demc.denoise_file(ROOM, self.folder / "plain.exr")
        demc.denoise_file(ROOM, self.folder / "named.exr", names=names)
        demc.denoise_file(ROOM, self.folder / "beside.exr", albedo=ROOM, normal=ROOM)
        # Files differ in the note of how they were made alone.
        plain, *others = (passes(self.folder / f"{name}.exr")[0] for name in ("plain", "named", "beside"))
        for other in others:
            self.assertEqual(list(other), list(plain))
            for name in plain:
                np.testing.assert_array_equal(other[name], plain[name], name)
        with self.assertRaisesRegex(demc.Error, "no layer 'nothing'"):
            demc.denoise_file(ROOM, self.folder / "wrong.exr", names={"albedo": "nothing"})
        with self.assertRaisesRegex(ValueError, "is no pass"):
            demc.denoise_file(ROOM, self.folder / "wrong.exr", names={"colour": "Denoising Albedo"})

    def test_others_run_meanwhile(self):
        color, albedo, normal, _ = (a if i == 3 else np.tile(a, (4, 4, 1)) for i, a in enumerate(self.arrays()))
        steps, ended = 0, threading.Event()

        def work():
            demc.denoise(color, albedo, normal)
            ended.set()

        thread = threading.Thread(target=work)
        thread.start()
        while not ended.wait(0.005):
            steps += 1
        thread.join()
        self.assertGreater(steps, 5)

    def test_ctrl_c_ends_the_call_and_writes_nothing(self):
        # A timer stands for the keyboard.
        code = (
            "import demc, signal, sys\n"
            "signal.signal(signal.SIGALRM, signal.default_int_handler)\n"
            "signal.setitimer(signal.ITIMER_REAL, 0.01)\n"
            "try:\n    demc.denoise_file(*sys.argv[1:], threads=1)\n"
            "except KeyboardInterrupt:\n    print('stopped')\n"
        )
        out = self.folder / "o.exr"
        done = subprocess.run([sys.executable, "-c", code, ROOM, out], capture_output=True, text=True)
        self.assertEqual(done.stdout.strip(), "stopped", done.stderr)
        self.assertFalse(out.exists())

    def test_manuals_and_completions_are_installed_where_they_are_found(self):
        share = pathlib.Path(sysconfig.get_path("data")) / "share"
        self.assertEqual(command("man", "--out", self.folder).returncode, 0)
        pages = sorted(path.name for path in self.folder.iterdir())
        self.assertIn("demc-denoise.1", pages)
        for page in pages:
            self.assertEqual((share / "man/man1" / page).read_bytes(), (self.folder / page).read_bytes(), page)
        for shell, place in [
            ("bash", "bash-completion/completions/demc"),
            ("zsh", "zsh/site-functions/_demc"),
            ("fish", "fish/vendor_completions.d/demc.fish"),
        ]:
            self.assertEqual((share / place).read_text(), command("completions", shell).stdout, shell)

    def test_examples_of_the_documentation_run(self):
        text = (ROOT / "docs/python.md").read_text()
        examples = re.findall(r"```python\n(.*?)```", text, re.S)
        self.assertGreater(len(examples), 1)
        color, albedo, normal, _ = self.arrays()
        for name, array in [("color", color), ("albedo", albedo), ("normal", normal)]:
            np.save(self.folder / f"{name}.npy", array)
        (self.folder / "shot.exr").write_bytes(ROOM.read_bytes())
        (self.folder / "reference.exr").write_bytes(REFERENCE.read_bytes())
        for example in examples:
            done = subprocess.run([sys.executable, "-c", example], cwd=self.folder, capture_output=True, text=True)
            self.assertEqual(done.returncode, 0, done.stderr)


if __name__ == "__main__":
    unittest.main()
