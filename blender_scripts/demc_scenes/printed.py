"""Pixel-sharp images made from numbers: pages of text, charts, screens of programs, sprites and test
patterns.

Photographs, which the library's textures are, hold few edges of one pixel; print, signs, and screens hold
little else. An image is a numpy array of (height, width, 3) sRGB values from the top; `image` makes one that
Blender can render, without a file.
"""

import math

import bpy
import numpy as np

from . import materials as m
from . import palette, shapes, studio
from .props import small

_UPRIGHT = math.pi / 2
_WORDS = (
    "noise",
    "light",
    "of",
    "the",
    "shade",
    "render",
    "and",
    "sample",
    "lamp",
    "12.50",
    "a",
    "mirror",
    "to",
    "path",
    "2026",
    "is",
    "colour",
    "edge",
    "glass",
    "pixel",
    "room",
    "in",
    "texture",
    "x=0.5",
    "frame",
)


def image(rng):
    """A Blender image of a random sort."""
    make = rng.choice((page, page, chart, interface, interface, sprite, pattern))
    return stored(make.__name__, make(np.random.default_rng(rng.randrange(1 << 32))))


def stored(name, pixels):
    """An array of pixels as a Blender image."""
    height, width = pixels.shape[:2]
    made = bpy.data.images.new(name, width, height)
    rgba = np.ones((height, width, 4), np.float32)
    rgba[..., :3] = pixels[::-1]  # Blender's first row is the lowest
    made.pixels.foreach_set(rgba.ravel())
    made.pack()  # a changed image is kept only where it is packed
    return made


def _tones(draw, count):
    """Colours of one print: a ground, an ink that stands out from it, and further ones."""
    ground = draw.uniform(0.75, 1.0, 3) if draw.random() < 0.65 else draw.uniform(0.0, 0.2, 3)
    ink = np.clip(1.0 - ground + draw.uniform(-0.15, 0.15, 3), 0, 1)
    return [ground, ink] + [draw.uniform(0, 1, 3) for _ in range(count - 2)]


def _alphabet(draw):
    """Forty letters of 7 by 5 pixels, each a few strokes: print as it looks to who cannot read it."""
    letters = np.zeros((40, 7, 5), bool)
    for letter in letters:
        for _ in range(draw.integers(2, 5)):
            stroke = draw.integers(4)
            if stroke == 0:
                letter[:, draw.choice((0, 2, 4))] = True
            elif stroke == 1:
                letter[draw.choice((0, 3, 6)), :] = True
            elif stroke == 2:
                letter[range(1, 6), range(5)] = True
            else:
                letter[range(1, 6), range(4, -1, -1)] = True
    return letters


def _write(draw, canvas, letters, ink, top, left, bottom, right, scale=1):
    """Fills a rectangle with lines of words."""
    for y in range(top, bottom - 7 * scale, 10 * scale):
        x, end = left, right if draw.random() < 0.8 else left + (right - left) // 2
        while x < end - 5 * scale:
            if draw.random() < 0.18:  # between words
                x += 4 * scale
                continue
            letter = np.kron(letters[draw.integers(len(letters))], np.ones((scale, scale), bool))
            canvas[y : y + 7 * scale, x : x + 5 * scale][letter] = ink
            x += 6 * scale


def page(draw):
    """A printed page: a headline, columns of text, a picture box."""
    height, width = draw.integers(160, 420), draw.integers(160, 320)
    ground, ink, accent = _tones(draw, 3)
    canvas = np.tile(ground, (height, width, 1))
    letters = _alphabet(draw)
    head = 12 + 7 * (scale := int(draw.integers(2, 5)))
    _write(draw, canvas, letters, accent, 8, 10, head, width - 8, scale)
    columns = draw.integers(1, 4)
    for i in range(columns):
        left, right = (10 + (width - 16) * k // columns for k in (i, i + 1))
        _write(draw, canvas, letters, ink, head + 8, left, height - 8, right - 6)
    if draw.random() < 0.5:
        y, x = draw.integers(head, height - 60), draw.integers(8, width - 70)
        figure = sprite(draw)[:50, :60]
        canvas[y : y + figure.shape[0], x : x + figure.shape[1]] = figure
    return canvas


def chart(draw):
    """Bars, a curve and a grid with labels."""
    height, width = 240, 320
    ground, ink, *rest = _tones(draw, 6)
    canvas = np.tile(ground, (height, width, 1))
    canvas[20 : -30 : draw.integers(10, 30), 30:-10] = 0.5 * (ground + ink)
    canvas[20:-30, 30 : -10 : draw.integers(10, 40)] = 0.5 * (ground + ink)
    bars = draw.integers(4, 20)
    for i in range(bars):
        x0, x1 = (34 + (width - 50) * k // bars for k in (i, i + 1))
        canvas[height - 30 - draw.integers(5, 180) : height - 30, x0 : x1 - 2] = rest[i % len(rest)]
    curve = np.cumsum(draw.normal(0, 4, width - 40)) + height / 2
    for x, y in enumerate(np.clip(curve, 20, height - 32).astype(int)):
        canvas[y : y + 2, 30 + x] = ink
    canvas[20 : height - 30, 30:32] = canvas[height - 32 : height - 30, 30:-10] = ink
    _write(draw, canvas, _alphabet(draw), ink, height - 24, 30, height - 8, width - 10)
    return canvas


def interface(draw):
    """A program's window: bars, a list, code, buttons."""
    height, width = 270, 480
    ground, ink, bar, accent, *marks = _tones(draw, 7)
    canvas = np.tile(ground, (height, width, 1))
    letters = _alphabet(draw)
    canvas[:16] = bar
    _write(draw, canvas, letters, ground, 4, 8, 14, width // 2)
    side = draw.integers(60, 160)
    canvas[16:, :side] = 0.8 * ground + 0.2 * bar
    _write(draw, canvas, letters, ink, 24, 8, height - 8, side - 4)
    canvas[24 + 10 * draw.integers(2, 20) :, :side][:10] = accent
    for y in range(24, height - 30, 10):  # code: each line indented, each in the colour of its kind
        left = side + 8 + 12 * draw.integers(0, 4)
        _write(
            draw,
            canvas,
            letters,
            [ink, *marks][draw.integers(len(marks) + 1)],
            y,
            left,
            y + 8,
            draw.integers(left + 20, width),
        )
    for i in range(draw.integers(2, 6)):
        x = width - 20 - 60 * i
        canvas[height - 18 : height - 4, x - 50 : x] = accent if i == 0 else bar
    return canvas


def sprite(draw):
    """Pixel art: mirrored random figures of few colours, each pixel several texels wide."""
    cells, scale = draw.integers(8, 17), int(draw.integers(4, 9))
    tones = np.array(_tones(draw, 5))
    half = draw.integers(0, 5, (cells, cells)) * (draw.random((cells, cells)) < 0.6)
    tile = np.concatenate([half, half[:, ::-1]], 1)
    tile = np.tile(tile, (2, 2)) if draw.random() < 0.4 else tile
    return np.kron(tones[tile], np.ones((scale, scale, 1)))


def pattern(draw):
    """What printers and lens makers test with: line pairs, checkers, a star, bars of a code."""
    side = 256
    y, x = np.mgrid[:side, :side]
    angle, radius = np.arctan2(y - side / 2, x - side / 2), np.hypot(y - side / 2, x - side / 2)
    field = (
        lambda: (x // draw.integers(1, 8)) % 2,
        lambda: (x // (n := draw.integers(2, 24)) + y // n) % 2,
        lambda: np.sin(angle * draw.integers(12, 72)) > 0,
        lambda: np.sin(radius * draw.uniform(0.2, 1.5)) > 0,
        lambda: np.repeat(draw.integers(0, 2, side // 2), 2)[None] * np.ones((side, 1), int),
        lambda: np.kron(draw.integers(0, 2, (32, 32)), np.ones((8, 8), int)),
    )[draw.integers(6)]()
    ground, ink = _tones(draw, 2)
    return np.where(np.asarray(field, bool)[..., None], ink, ground)


def paper(rng):
    """A material of print: matt, or glossy as a magazine; texels stay squares where they are large."""
    n = m.Nodes("print")
    base = m.image(n, image(rng), n.uv(1.0))
    base.interpolation = rng.choice(("Closest", "Linear"))
    return n.principled(
        Base_Color=base.outputs[0],
        Roughness=rng.uniform(0.2, 0.9),
        Coat_Weight=rng.choice((0, 0, 1)),
        Coat_Roughness=0.05,
    )


def sheet(stage, at, turn, width, height, tilt):
    """A sheet of print on its lower edge: `tilt` is 0 where it lies, pi / 2 where it stands and faces -Y."""
    page_ = shapes.plane(width, height, unit_uv=True)
    page_.rotation_euler.x = tilt - _UPRIGHT
    return stage.add(page_, paper(stage.rng), at, turn)


def lettering(rng, size, lines):
    """Flat letters as geometry: the sharpest edges there are."""
    words = "\n".join(" ".join(rng.choice(_WORDS) for _ in range(rng.randint(2, 6))) for _ in range(lines))
    obj = shapes.text(words, size, 0.0)
    obj.data.bevel_depth = 0.0
    return obj


def printed_box(stage, at, turn, side):
    """A carton with print on its front and its lid."""
    carton = shapes.box((side, side, side), 0.0, (0, 0, side / 2))
    stage.add(carton, m.paint(stage.rng), at, turn)
    front = (at[0] + 0.502 * side * math.sin(turn), at[1] - 0.502 * side * math.cos(turn))
    sheet(stage, (*front, at[2]), turn, side, side, _UPRIGHT)
    sheet(stage, (*front, at[2] + side * 1.002), turn, side, side, 0.0)


def desk(stage):
    """Pages, cards, boxes and letters on a table, before a wall of posters."""
    rng, lib = stage.rng, stage.library
    studio.ground(stage)

    def thing(at):
        roll, turn = rng.random(), rng.uniform(-0.6, 0.6)
        if roll < 0.35:
            sheet(
                stage,
                (at[0], at[1], rng.uniform(0.001, 0.004)),
                turn,
                rng.uniform(0.1, 0.3),
                rng.uniform(0.1, 0.35),
                0.0,
            )
        elif roll < 0.55:
            sheet(stage, at, turn, rng.uniform(0.08, 0.25), rng.uniform(0.08, 0.3), rng.uniform(1.2, 1.57))
        elif roll < 0.7:
            printed_box(stage, at, turn, rng.uniform(0.06, 0.18))
        elif roll < 0.85:
            words = lettering(rng, rng.uniform(0.012, 0.04), rng.randint(2, 8))
            words.rotation_euler.x = rng.choice((0.0, 1.2))
            stage.add(
                words, m.plastic(rng), (at[0] - 0.1, at[1], 0.12 if words.rotation_euler.x else 0.006), turn
            )
        else:
            small(stage, at, 0.35)

    studio.cluster(stage, rng.randint(8, 18), 0.24, thing)
    for i in range(rng.randint(1, 4)):
        sheet(
            stage,
            (rng.uniform(-0.8, 0.8), 1.0 + 0.01 * i, rng.uniform(0.05, 0.5)),
            0.0,
            rng.uniform(0.3, 0.9),
            rng.uniform(0.3, 0.7),
            _UPRIGHT,
        )
    if rng.random() < 0.5:
        stage.add(shapes.box((3, 0.05, 1.5), 0, (0, 1.1, 0.75)), palette.walls(rng, lib))
    studio.base_light(stage, 0.2)
