"""Makes pairs on which `demc train` makes a prefilter, without a renderer: flat pictures seen through few samples.

    python flat_albedos.py --out OUT --seeds 0:300 --textures FOLDER... [--size 192]

A picture is a wall, mapped in perspective, behind polygons, discs, bars and gratings, each of one colour, of a pattern or of an
image, down to many texels a pixel, as Cycles sees textures without mip maps; some are out of focus, some are glass that shows what lies
behind, displaced, or a reflection, sample by sample. Samples lie as Cycles draws them for its Blackman-Harris filter of 1.5
pixels. Written are two noisy frames of 4 samples and a reference of 48, as albedo_pairs.py writes them: an albedo
in the place of radiance, and the normals of the samples. The same seed gives the same pixels.
"""

import argparse
import glob
import os

import numpy as np
from PIL import Image

from albedo_pairs import lit
from clean_references import exr

FILTER_WIDTH = 1.5
SAMPLES, REFERENCE_SAMPLES = 4, 48


def filter_offsets():
    """Quantiles of the filter along one axis: what an even number from 0 to 1 becomes."""
    x = np.linspace(-0.5, 0.5, 1025)
    a = 2 * np.pi * (x + 0.5)
    density = 0.35875 - 0.48829 * np.cos(a) + 0.14128 * np.cos(2 * a) - 0.01168 * np.cos(3 * a)
    return np.cumsum(density) / density.sum(), x * FILTER_WIDTH


class Texture:
    """A colour for every place (u, v)."""

    def __init__(self, rng, files):
        self.kind = rng.choice(["plain", "image", "image", "image", "checker", "stripes", "bricks"])
        self.colours = rng.random((2, 3)) ** rng.choice([1.0, 2.2]) * rng.uniform(0.2, 1)
        if rng.random() < 0.5:  # patterns of nearly one colour
            self.colours[1] = np.clip(self.colours[0] * (1 + rng.normal(0, 0.12, 3)), 0, 1)
        if rng.random() < 0.4:
            self.colours = np.repeat(self.colours.mean(1, keepdims=True), 3, 1)
        if self.kind == "image":
            with Image.open(files[rng.integers(len(files))]) as image:
                image = np.asarray(image.convert("RGB").resize((256, 256)), np.float32) / 255
            self.image = image**2.2 * rng.uniform(0.3, 1)

    def at(self, u, v):
        """Colours, (n, 3)."""
        pick = lambda second: self.colours[second.astype(np.int64)]
        if self.kind == "plain":
            return np.broadcast_to(self.colours[0], (len(u), 3))
        if self.kind == "image":
            u, v = (t * 256 % 256 for t in (u, v))
            x, y = u.astype(np.int64) % 256, v.astype(np.int64) % 256
            p, q = (u - np.floor(u))[:, None], (v - np.floor(v))[:, None]
            right, below = (x + 1) % 256, (y + 1) % 256
            top = self.image[y, x] * (1 - p) + self.image[y, right] * p
            return top * (1 - q) + (self.image[below, x] * (1 - p) + self.image[below, right] * p) * q
        if self.kind == "checker":
            return pick((np.floor(u * 8) + np.floor(v * 8)) % 2)
        if self.kind == "stripes":
            return pick(u * 8 % 1 < 0.3)
        row = np.floor(v * 12)
        return pick(((u * 6 + 0.5 * (row % 2)) % 1 < 0.08) | (v * 12 % 1 < 0.12))


class Shape:
    """A part of the plane with a texture, a normal, a blur, and perhaps the ways of glass."""

    def __init__(self, rng, files, size, wall):
        self.kind = "wall" if wall else rng.choice(["polygon", "polygon", "disc", "bar", "bar", "grating"])
        self.centre = rng.uniform(0, size, 2)
        angle = rng.uniform(0, 2 * np.pi)
        self.turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
        self.extent = np.exp(rng.uniform(np.log(3), np.log(size / 3), 2))
        if self.kind in ("bar", "grating"):
            self.extent = np.array([rng.uniform(size / 8, size), np.exp(rng.uniform(np.log(0.3), np.log(6)))])
        self.pitch = self.extent[1] * rng.uniform(2.5, 6)
        self.lines = rng.integers(3, 12)
        corners = np.sort(rng.uniform(0, 2 * np.pi, rng.integers(3, 7)))
        self.edges = np.stack([np.cos(corners), np.sin(corners)], -1), rng.uniform(0.4, 1, len(corners))
        self.texture = Texture(rng, files)
        # Of a texture 16 to 800 pixels wide, in perspective along a direction.
        self.scale = 1 / np.exp(rng.uniform(np.log(16), np.log(800)))
        self.slope = rng.uniform(0, 0.9) / size * (rng.random() < 0.5)
        normal = np.append(rng.normal(0, 0.5, 2), 1)
        self.normal = normal / np.linalg.norm(normal)
        self.round = self.kind == "disc" and rng.random() < 0.6
        self.blur = 0.0
        self.glass = not wall and rng.random() < 0.12
        self.reflects, self.bend = rng.uniform(0.05, 0.6), rng.normal(0, 0.15, 2)
        self.tint = rng.uniform(0.5, 1, 3)

    def local(self, at):
        return (at - self.centre) @ self.turn.T

    def inside(self, at):
        """Which places belong to it."""
        x, y = self.local(at).T
        a, b = self.extent
        if self.kind == "wall":
            return np.ones(len(at), bool)
        if self.kind == "disc":
            return (x / a) ** 2 + (y / b) ** 2 < 1
        if self.kind == "bar":
            return (abs(x) < a) & (abs(y) < b)
        if self.kind == "grating":
            line = np.floor(y / self.pitch + 0.5)
            return (abs(x) < a) & (abs(y - line * self.pitch) < b) & (abs(line) < self.lines)
        directions, distances = self.edges
        return (np.stack([x / a, y / b], -1) @ directions.T < distances).all(1)

    def colours(self, at):
        x, y = self.local(at).T
        depth = np.maximum(1 + self.slope * y, 0.1)
        return self.texture.at(x * self.scale / depth, y * self.scale / depth)

    def normals(self, at):
        if not self.round:
            return np.broadcast_to(self.normal, (len(at), 3))
        x, y = (self.local(at) / self.extent).T
        return np.stack([x, y, np.sqrt(np.maximum(1 - x * x - y * y, 0))], -1)


class Picture:
    """Shapes, front to back; the last is the wall."""

    def __init__(self, rng, files, size):
        self.size = size
        self.shapes = [Shape(rng, files, size, False) for _ in range(rng.integers(6, 28))] + [Shape(rng, files, size, True)]
        if rng.random() < 0.25:
            focus = rng.uniform(0, 1)
            for place, shape in enumerate(self.shapes):
                shape.blur = rng.uniform(2, 14) * abs(place / len(self.shapes) - focus)

    def sample(self, rng, quantiles):
        """Albedo and normal at a place in each pixel, (size, size, 3)."""
        n = self.size * self.size
        y, x = np.divmod(np.arange(n), self.size)
        at = np.stack([x, y], -1) + 0.5 + np.interp(rng.random((n, 2)), *quantiles)
        radius, angle = np.sqrt(rng.random(n)), rng.uniform(0, 2 * np.pi, n)
        lens = np.stack([radius * np.cos(angle), radius * np.sin(angle)], -1)
        albedo, normal, through = np.zeros((n, 3)), np.zeros((n, 3)), np.ones((n, 3))
        left = np.arange(n)
        for shape in self.shapes:
            places = at[left] + shape.blur * lens[left]
            hit = shape.inside(places)
            if not hit.any():
                continue
            rays, places = left[hit], places[hit]
            stop = np.ones(len(rays), bool)
            if shape.glass:
                stop = rng.random(len(rays)) < shape.reflects
                passing = rays[~stop]
                at[passing] += shape.bend * shape.local(places[~stop])
                through[passing] *= shape.tint
            ended = rays[stop]
            albedo[ended] = through[ended] * (1.0 if shape.glass else shape.colours(places[stop]))
            normal[ended] = shape.normals(places[stop])
            left = np.setdiff1d(left, ended, assume_unique=True)
        return (image.reshape(self.size, self.size, 3) for image in (albedo, normal))

    def render(self, rng, quantiles, samples):
        """Means of some samples, as channels by name."""
        sums = [0.0, 0.0]
        for _ in range(samples):
            sums = [total + image for total, image in zip(sums, self.sample(rng, quantiles))]
        albedo, normal = (total / samples for total in sums)
        channels = {}
        for c in range(3):
            for name in ("Combined", "Denoising Albedo"):
                channels[f"ViewLayer.{name}.{'RGB'[c]}"] = albedo[..., c]
            channels[f"ViewLayer.Denoising Normal.{'XYZ'[c]}"] = normal[..., c]
        return lit({name: values.astype(np.float32) for name, values in channels.items()})


def main():
    """Entry point of the script."""
    parser = argparse.ArgumentParser(prog="flat_albedos.py", description="Makes albedo pairs without a renderer.")
    parser.add_argument("--out", required=True, help="folder for the pairs")
    parser.add_argument("--seeds", required=True, help="A:B, pictures A to B-1")
    parser.add_argument("--textures", nargs="+", required=True, help="folders of images, looked through to the bottom")
    parser.add_argument("--size", type=int, default=192, help="rows and columns (default 192)")
    options = parser.parse_args()
    files = sorted(f for folder in options.textures for kind in ("jpg", "png") for f in glob.glob(f"{folder}/**/*.{kind}", recursive=True))
    files = [f for f in files if not any(word in os.path.basename(f) for word in ("normal", "rough", "metal", "height"))]
    if not files:
        parser.error("no .jpg and no .png in the folders of --textures")
    os.makedirs(options.out, exist_ok=True)
    quantiles = filter_offsets()
    first, end = map(int, options.seeds.split(":"))
    for seed in range(first, end):
        stem = os.path.join(options.out, f"s{seed:05}_flat")
        if os.path.exists(f"{stem}_ref.exr"):
            continue
        rng = np.random.default_rng(seed)
        picture = Picture(rng, files, options.size)
        for name in ("_0004spp.exr", "_0004spp_n1.exr"):
            exr.write_half(stem + name, picture.render(rng, quantiles, SAMPLES))
        exr.write_half(f"{stem}_ref.exr", picture.render(rng, quantiles, REFERENCE_SAMPLES))
        print(f"s{seed:05}", flush=True)


if __name__ == "__main__":
    main()
