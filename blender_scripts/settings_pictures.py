"""Shows what render settings do to a denoise: the pictures and figures of docs/settings.md.

    python settings_pictures.py --out docs/settings --work DIR

Renders small scenes that need no assets with a setting at several values, runs
`demc denoise` and `demc compare` on each, and writes <setting>.png (noisy above, denoised below, the
reference at the right) and figures.csv. Renders stay in --work: a rerun makes what is missing. Needs bpy,
numpy, OpenImageIO, and demc on the PATH.
"""

import argparse
import csv
import json
import math
import os
import subprocess
import sys

import numpy as np
import OpenImageIO as oiio

sys.path.insert(0, os.path.dirname(os.path.abspath(__file__)))

from demc_blender import command_line as cl
from demc_blender import exr, rendering
from demc_blender.edits import Edits
from demc_scenes import making, materials, props, shapes
from demc_scenes.assets import Library
from demc_scenes.kinds import KINDS
from demc_scenes.views import find

_SIZE = (256, 144)
_SMALL_SIZE, _SMALL = (160, 90), ("light_tree", "seeds", "pixel_filter")  # that need references of their own
_FEW_SPP = 256  # of those references
_REFERENCE_SPP = 1024
_COLUMNS = ("setting", "value", "samples", "relmse_noisy", "relmse_denoised", "also", "what")
_WIDTH, _TITLE, _GAP, _FONT = 192, 40, 4, 13
_BACKGROUND = np.array((0.05, 0.15, 0.5), np.float32)  # what a transparent film is laid over


def parse(arguments):
    parser = argparse.ArgumentParser(prog="settings_pictures.py",
                                     description="Pictures and figures of docs/settings.md.")
    parser.add_argument("--out", required=True, metavar="DIR", help="folder for the pictures and figures.csv")
    parser.add_argument("--work", required=True, metavar="DIR", help="folder for renders and results")
    parser.add_argument("--only", type=cl.names, default=list(SETTINGS), metavar="a,b", help="these settings alone")
    parser.add_argument("--demc", default="demc", metavar="PATH", help="the program (default: on the PATH)")
    parser.add_argument("--threads", type=cl.positive, default=2, metavar="N", help="CPU threads (default 2)")
    options = parser.parse_args(arguments)
    for name in options.only:
        if name not in SETTINGS:
            parser.error(f"{name} is none of {', '.join(SETTINGS)}")
    return options


def corner(stage, lamps=0):
    """The corner of a closed room: books, a head, a ball. A spot turned to the ceiling gives most of the
    light, or many small lamps below it do. Returns what places the camera."""
    rng = stage.rng
    wall, floor = materials.paint(rng, (0.7, 0.8)), materials.tiles(rng)
    for size, at in (((5, 0.1, 2.6), (0, 1.5, 1.3)), ((0.1, 5, 2.6), (-1.7, 0, 1.3)), ((0.1, 5, 2.6), (2.3, 0, 1.3)),
                     ((5, 0.1, 2.6), (0, -2.4, 1.3)), ((5, 5, 0.1), (0, 0, 2.65))):
        stage.add(shapes.box(size), wall, at)
    stage.add(shapes.box((5, 5, 0.1)), floor, (0, 0, -0.05))
    props.shelf(stage, (-0.9, 1.2, 0), 0.0)
    stage.add(shapes.monkey(0.7), materials.plastic(rng), (0.45, 0.7, 0.4), -0.3)
    stage.add(shapes.sphere(0.3), materials.metal(rng), (1.3, 0.9, 0.3))
    props.framed(stage, (0.6, 1.43, 1.2), 0.8, 0.6)
    if lamps:
        for _ in range(lamps):
            at = (rng.uniform(-1.6, 2.2), rng.uniform(-2.3, 1.4), rng.uniform(1.9, 2.5))
            color = (rng.uniform(0.3, 1), rng.uniform(0.3, 1), rng.uniform(0.3, 1))
            stage.lamp("POINT", at, rng.uniform(0.2, 2), color, shadow_soft_size=0.02)
    else:
        stage.lamp("AREA", (1.6, -0.6, 2.5), 15, (1, 0.9, 0.8), aim=(0.2, 0.8, 0.4), size=0.3)
        stage.lamp("SPOT", (1.5, -1.0, 1.5), 500, (0.9, 0.95, 1), aim=(1.2, 0.0, 2.6), spot_size=math.radians(50),
                   shadow_soft_size=0.05)
    stage.defocus = 0.0
    return lambda: stage.camera((1.0, -2.2, 1.4), (-0.15, 1.2, 0.75), 30)


KINDS |= {"corner": (corner,), "lamps": (lambda stage: corner(stage, 300),)}


class Shot:
    """A scene that is ready to render, and the files made of it."""

    def __init__(self, options, setting, kind, seed):
        self.options, self.setting = options, setting
        # Settings of one scene share its reference.
        self.folder = os.path.join(os.path.abspath(options.work), "moving" if setting == "seeds" else f"{kind}{seed}")
        os.makedirs(self.folder, exist_ok=True)
        self.stage, place_camera = making.build(Library([]), seed, kind, {})
        self.scene = self.stage.scene
        # The scene is thrown away with the next one, so nothing is taken back.
        making.set_up(Edits(), self.stage, options.threads, size=_SMALL_SIZE if setting in _SMALL else _SIZE)
        making.look(Edits(), self.stage, place_camera, 1, None)
        self.scene.render.use_motion_blur = False
        self.scene.camera.data.dof.use_dof = kind == "cutout"
        cycles = self.scene.cycles
        cycles.sample_clamp_indirect, cycles.use_light_tree = 0.0, True
        rendering.enable_passes(Edits(), self.scene.view_layers)

    def render(self, name, spp, seed, threshold=0.0, frame=1, **settings):
        """The file of a render; settings are of Cycles, or of the scene's render settings."""
        path = os.path.join(self.folder, f"{name}.exr")
        if os.path.exists(path):
            return path
        with Edits() as edits:
            self.scene.frame_set(frame)
            rendering.set_sampling(edits, self.scene, spp, seed, threshold)
            for key, value in settings.items():
                edits.set(self.scene.cycles if hasattr(self.scene.cycles, key) else self.scene.render, key, value)
            rendering.render_to(self.scene, path)
        print(f"{self.setting}: rendered {name}")
        return path

    def noisy(self, name, spp=4, seed=1, **settings):
        return self.render(f"{name}_{spp:04}spp", spp, seed, **settings)

    def reference(self, name="ref", spp=_REFERENCE_SPP, **settings):
        return self.render(name, spp, 77, **settings)

    def denoised(self, path, *arguments, folder="clean"):
        """The result of `demc denoise`."""
        out = os.path.join(self.folder, folder)
        threads = str(self.options.threads)
        self._demc("denoise", path, "--out", out, "--quiet", "--overwrite", "--threads", threads, *arguments)
        return os.path.join(out, os.path.basename(path))

    def relmse(self, path, reference, layer):
        return json.loads(self._demc("compare", path, reference, "--layer", layer, "--json"))["relmse"]

    def _demc(self, *arguments):
        done = subprocess.run([self.options.demc, *arguments], capture_output=True, text=True, check=False)
        if done.returncode:
            raise RuntimeError(f"demc {' '.join(arguments)}: {done.stdout}{done.stderr}")
        return done.stdout


class Column:
    """A value of the setting: what was rendered, what became of it, and the reference it is held against."""

    def __init__(self, shot, value, noisy, reference, *arguments, folder="clean", samples=4):
        self.value, self.noisy, self.reference, self.samples = value, noisy, reference, samples
        self.clean = shot.denoised(noisy, *arguments, folder=folder)
        self.before = shot.relmse(noisy, reference, "Combined")
        self.after = shot.relmse(self.clean, reference, "Denoised")
        self.also, self.what = "", ""

    def with_also(self, also, what):
        self.also, self.what = f"{also:.4g}", what
        return self


def plane(path, *endings):
    """(height, width, 3) of a pass, or (height, width, 1) of one channel."""
    passes = exr.read(path)
    return np.stack([np.nan_to_num(find(passes, ending).astype(np.float32)) for ending in endings], -1)


def color(path, layer):
    return plane(path, *(f"{layer}.{axis}" for axis in "RGB"))


def light_kept(column):
    """Mean radiance of the result as a share of the reference's."""
    return color(column.clean, "Denoised").mean() / color(column.reference, "Combined").mean()


# The settings: each returns its columns. --------------------------------------------------------------------


def samples(shot):
    reference = shot.reference()
    counts = (1, 2, 4, 8, 16, 32, 64)
    return [Column(shot, f"{n} samples", shot.noisy("s", n), reference, samples=n) for n in counts]


def adaptive(shot):
    """At most 64 samples. Samples are the same in all, so a pixel that differs from the frame without a
    threshold ended early."""
    reference, most = shot.reference(), 64
    full = shot.noisy("s", most)
    columns = [Column(shot, "no threshold", full, reference, samples=most)]
    for threshold in (0.05, 0.1, 0.2):
        path = shot.render(f"threshold{threshold}", most, 1, threshold)
        early = (color(path, "Combined") != color(full, "Combined")).any(-1).mean()
        column = Column(shot, f"threshold {threshold}", path, reference, samples=most)
        columns.append(column.with_also(early, "share of pixels that ended early"))
    return columns


def clamping(shot):
    reference = shot.reference()
    values = (("off", 0.0), ("10", 10.0), ("1", 1.0), ("0.1", 0.1))
    columns = [Column(shot, f"clamp {name}", shot.noisy(f"clamp{name}", sample_clamp_indirect=value), reference)
               for name, value in values]
    return [column.with_also(light_kept(column), "light kept") for column in columns]


def light_tree(shot):
    reference = shot.reference(spp=_FEW_SPP)
    return [Column(shot, name, shot.noisy(name, use_light_tree=on), reference)
            for name, on in (("light tree off", False), ("light tree on", True))]


def seeds(shot):
    """Five frames of a camera that moves: the third is judged."""
    camera = shot.scene.camera
    across = camera.matrix_world.to_quaternion().to_matrix().col[0]
    start = camera.location.copy()
    for frame in (0, 6):
        camera.location = start + across * 0.06 * (frame - 3)
        camera.keyframe_insert("location", frame=frame)
    plain, blurred = {"frame": 3}, {"frame": 3, "use_motion_blur": True, "motion_blur_shutter": 0.5}
    references = {False: shot.reference("ref", 2 * _FEW_SPP, **plain),
                  True: shot.reference("ref_blurred", 2 * _FEW_SPP, **blurred)}
    columns = []
    for name, own, blur in (("one seed", False, False), ("own seeds", True, False), ("motion blur", True, True)):
        for layer in shot.scene.view_layers:
            layer.use_pass_vector = not blur
        for frame in range(1, 6):
            settings = (blurred if blur else plain) | {"frame": frame}
            path = shot.render(f"{name.replace(' ', '_')}_0004spp.{frame:04}", 4, frame if own else 1, **settings)
            if frame == 3:
                judged = path
        for way, arguments in (("alone", ()), ("temporal", ("--temporal",))):
            columns.append(Column(shot, f"{name}, {way}", judged, references[blur], *arguments, folder=way))
    return columns


def pixel_filter(shot):
    shot.scene.camera.data.lens *= 1.8
    columns = []
    for width in (0.5, 1.5, 4.0):
        settings = {"pixel_filter_type": "BLACKMAN_HARRIS", "filter_width": width}
        reference = shot.reference(f"ref{width}", _FEW_SPP, **settings)
        column = Column(shot, f"{width} pixels", shot.noisy(f"width{width}", **settings), reference)
        columns.append(column.with_also(neighbours(column), "correlation of neighbouring pixels' noise"))
    return columns


def neighbours(column):
    """Correlation of the relative error of pixels with that of their right neighbours."""
    reference = color(column.reference, "Combined")
    error = np.clip((color(column.noisy, "Combined") - reference) / np.sqrt(reference**2 + 0.001), -3, 3)
    error -= error.mean()
    return float((error[:, 1:] * error[:, :-1]).mean() / (error**2).mean())


def alpha(shot):
    reference = shot.reference()
    noisy, columns = shot.noisy("film"), []
    wanted = plane(reference, "Combined.A")
    for way, ending in (("keep", "Combined.A"), ("denoise", "Denoised.A")):
        column = Column(shot, f"alpha {way}", noisy, reference, "--alpha", way, folder=way)
        error = np.sqrt(((plane(column.clean, ending) - wanted) ** 2).mean())
        columns.append(column.with_also(error, "RMSE of alpha"))
    return columns


def passes(shot):
    reference = shot.reference()
    frame = exr.read(shot.noisy("guides"))
    normal, albedo = "Denoising Normal", "Denoising Albedo"
    columns = []
    for name, blank in (("all passes", ()), ("blank normal", (normal,)), ("blank albedo", (albedo,)),
                        ("both blank", (normal, albedo))):
        path = os.path.join(shot.folder, f"{name.replace(' ', '_')}_0004spp.exr")
        wanted = {key: np.zeros_like(value) if any(name in key for name in blank) else value
                  for key, value in frame.items()}
        exr.write_float(path, wanted)
        columns.append(Column(shot, name, path, reference))
    return columns


def precision(shot):
    reference = shot.reference()
    half = shot.noisy("half")
    shot.scene.render.image_settings.color_depth = "32"
    full = shot.noisy("float")
    columns = [Column(shot, "half", half, reference), Column(shot, "float", full, reference)]
    return [c.with_also(os.path.getsize(c.noisy) / 2**20, "MiB of the file") for c in columns]


def denoiser(shot):
    """Blender's own denoiser left on. Its passes keep what it began with, which is what demc takes; without
    them (a file that holds the denoised picture alone) its result is denoised once more."""
    reference = shot.reference()
    off = shot.noisy("off")
    with Edits() as edits:
        rendering.denoise(edits, shot.scene, shot.scene.view_layers)
        on = shot.noisy("on", use_denoising=True)
    lost = os.path.join(shot.folder, "lost_0004spp.exr")
    exr.write_float(lost, {name: value for name, value in exr.read(on).items() if "Noisy" not in name})
    made = (("off", off), ("on", on), ("on, Noisy Image lost", lost))
    return [Column(shot, name, path, reference) for name, path in made]


# Name: what makes its columns, kind and seed of the scene, the crop to show (x, y, width, height), and which
# columns are shown.
SETTINGS = {
    "samples": (samples, "corner", 1, (60, 12, 96, 80), (0, 2, 4, 6)),
    "adaptive": (adaptive, "corner", 1, (60, 12, 96, 80), (0, 1, 2, 3)),
    "clamping": (clamping, "corner", 1, (60, 12, 96, 80), (0, 1, 2, 3)),
    "light_tree": (light_tree, "lamps", 1, (32, 5, 128, 85), (0, 1)),
    "seeds": (seeds, "corner", 1, (32, 5, 96, 80), (0, 1, 2, 3)),
    "pixel_filter": (pixel_filter, "print", 1, (32, 5, 96, 80), (0, 1, 2)),
    "alpha": (alpha, "cutout", 3, (116, 30, 64, 48), (0, 1)),
    "passes": (passes, "corner", 1, (50, 0, 96, 80), (0, 1, 2, 3)),
    "precision": (precision, "corner", 1, None, ()),
    "denoiser": (denoiser, "corner", 1, None, ()),
}


class Page:
    """The picture of a setting."""

    def __init__(self, columns, crop):
        self.columns, self.crop = columns, crop
        self.over_color = columns[0].what == "RMSE of alpha"
        self.zoom = max(_WIDTH // crop[2], 2)
        width, height = (n * self.zoom for n in crop[2:])
        self.step = (width + _GAP, height + _GAP)
        self.size = (self.step[0] * (len(columns) + 1) - _GAP, _TITLE + 2 * self.step[1] - _GAP)
        reference = self._image(columns[0].reference, "Combined", "Combined")
        light = reference @ np.array([0.2126, 0.7152, 0.0722], np.float32)
        # That of demc's metrics.
        self.exposure = 0.35 / max(np.minimum(light, np.percentile(light, 98)).mean(), 1e-6)

    def _image(self, path, layer, alpha_layer):
        image = color(path, layer)
        return image + (1 - plane(path, f"{alpha_layer}.A")) * _BACKGROUND if self.over_color else image

    def _cell(self, path, layer, alpha_layer):
        x, y, width, height = self.crop
        image = self._image(path, layer, alpha_layer)[y:y + height, x:x + width]
        shown = np.clip(image * self.exposure, 0, 1) ** (1 / 2.2)
        return (shown * 255 + 0.5).astype(np.uint8).repeat(self.zoom, 0).repeat(self.zoom, 1)

    def write(self, path):
        canvas = np.full((self.size[1], self.size[0], 3), 255, np.uint8)
        titles = []
        for index, column in enumerate(self.columns):
            alpha_layer = "Denoised" if column.value == "alpha denoise" else "Combined"
            self._paste(canvas, index, 0, self._cell(column.noisy, "Combined", "Combined"))
            self._paste(canvas, index, 1, self._cell(column.clean, "Denoised", alpha_layer))
            told = f"RelMSE {column.before:.3g} > {column.after:.3g}"
            if self.over_color:
                told = f"alpha RMSE {column.also}"
            titles.append((index, column.value, told))
        references = list(dict.fromkeys(column.reference for column in self.columns))
        self._paste(canvas, len(self.columns), 0, self._cell(references[0], "Combined", "Combined"))
        titles.append((len(self.columns), "reference", ""))
        if len(references) > 1:
            self._paste(canvas, len(self.columns), 1, self._cell(references[-1], "Combined", "Combined"))
            titles[-1] = (len(self.columns), "references:", "first above, last below")
        picture = oiio.ImageBuf(oiio.ImageSpec(self.size[0], self.size[1], 3, "uint8"))
        picture.set_pixels(oiio.ROI(0, self.size[0], 0, self.size[1], 0, 1, 0, 3), canvas)
        for index, first, second in titles:
            for row, words in enumerate((first, second)):
                oiio.ImageBufAlgo.render_text(picture, index * self.step[0] + 2, 15 + 18 * row, words, fontsize=_FONT,
                                              textcolor=(0, 0, 0))
        picture.specmod().attribute("png:compressionLevel", 9)
        if not picture.write(path):
            raise RuntimeError(f"{path}: {picture.geterror()}")

    def _paste(self, canvas, column, row, cell):
        x, y = column * self.step[0], _TITLE + row * self.step[1]
        canvas[y:y + cell.shape[0], x:x + cell.shape[1]] = cell


def kept_rows(path, made):
    """Rows of settings that are not made now."""
    if not os.path.exists(path):
        return []
    with open(path, newline="", encoding="utf-8") as file:
        return [row for row in csv.DictReader(file) if row["setting"] not in made]


def main():
    options = parse(cl.script_arguments())
    cl.quiet_stdout()
    cl.make_folder(options.out)
    table = os.path.join(options.out, "figures.csv")
    rows = kept_rows(table, options.only)
    for name in options.only:
        make, kind, seed, crop, shown = SETTINGS[name]
        columns = make(Shot(options, name, kind, seed))
        for c in columns:
            figures = (name, c.value, c.samples, f"{c.before:.4g}", f"{c.after:.4g}", c.also, c.what)
            rows.append(dict(zip(_COLUMNS, figures)))
            print(f"{name}: {c.value}: {c.before:.4g} -> {c.after:.4g} {c.what} {c.also}")
        if shown:
            Page([columns[index] for index in shown], crop).write(os.path.join(options.out, f"{name}.png"))
        rows.sort(key=lambda row: list(SETTINGS).index(row["setting"]))
        with open(table, "w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, _COLUMNS, lineterminator="\n")
            writer.writeheader()
            writer.writerows(rows)


if __name__ == "__main__":
    main()
