"""Removes Monte Carlo noise from Blender Cycles renders.

`denoise` takes numpy arrays, `denoise_file` an EXR file; `inspect` tells what a file holds, `compare` how far
one file is from another, `models` which models there are. The command `demc` is installed beside this module and makes the
same bits.
"""

import atexit
import json
import os
import typing

import numpy as np

from . import _demc
from ._demc import Error, __version__

__all__ = ["Error", "Report", "__version__", "compare", "denoise", "denoise_file", "inspect", "models"]

# Daemon threads may be in a call when Python ends, and must not take its lock any more.
atexit.register(_demc.leave)

# The largest number that float16 holds.
_HALF_MAX = float(np.finfo(np.float16).max)


class Report(typing.TypedDict):
    """What `denoise_file` returns."""

    view_layer: str
    width: int
    height: int
    samples: int | None
    was_denoised: bool
    expected_error: float | None
    seconds: float
    repaired: dict[str, int]
    notes: list[str]


def _image(name, image, shape=None):
    if not isinstance(image, np.ndarray):
        raise ValueError(f"{name} is a {type(image).__name__}; give a numpy array of shape (H, W, 3)")
    if shape is not None and len(shape) == 2:
        if image.ndim != 2:
            raise ValueError(f"{name} has shape {image.shape}; give (H, W)")
    elif image.ndim != 3 or image.shape[2] != 3 or 0 in image.shape:
        raise ValueError(f"{name} has shape {image.shape}; give (H, W, 3), and alpha by itself")
    if image.dtype.type not in (np.float32, np.float16):
        raise ValueError(f"{name} is of {image.dtype}; give float32 or float16")
    if shape is not None and image.shape != shape:
        raise ValueError(f"{name} has shape {image.shape}, color {shape}; give arrays of one render")
    if np.ma.isMaskedArray(image):
        image = image.filled(np.nan)
    return np.ascontiguousarray(image, dtype=np.float32)


def _count(name, value, most):
    if value is None:
        return None
    if isinstance(value, (int, np.integer)) and not isinstance(value, bool) and 1 <= value <= most:
        return int(value)
    raise ValueError(f"{name} is {value!r}; give a number from 1 to {most}, or None")


def _path(name, path):
    try:
        return os.fsdecode(path)
    except TypeError:
        raise ValueError(f"{name} is a {type(path).__name__}; give a path or a name as text") from None


def _name(what, name):
    """The name of a layer, or None."""
    if not isinstance(name, str | None):
        raise ValueError(f"{what} is a {type(name).__name__}; give its name, or None")
    return name


def _lines(names):
    """What `names` says, as `demc denoise --map` takes it."""
    if not isinstance(names or {}, dict):
        raise ValueError(f'names is a {type(names).__name__}; give a dict such as {{"albedo": "my colour"}}')
    for word, name in (names or {}).items():
        if not (isinstance(word, str) and isinstance(name, str)):
            raise ValueError(f"names has {word!r}: {name!r}; give text for both")
    return [f"{word}={name}" for word, name in (names or {}).items()]


def _like(values, image):
    """A flat float32 array, shaped and typed like an image."""
    values = values.reshape(image.shape)
    if image.dtype.type is np.float16:
        values = values.clip(-_HALF_MAX, _HALF_MAX)
    return values.astype(image.dtype, copy=False)


def denoise(color, albedo=None, normal=None, model="demc-m", *, alpha=None, samples=None, threads=None):
    """Denoised radiance, an array of the shape and dtype of `color`; with `alpha`, a pair of radiance and alpha.

    color: noisy linear radiance (Combined), shape (H, W, 3), float32 or float16.
    albedo, normal: Cycles' Denoising Albedo (0 to 1) and Denoising Normal (-1 to 1, camera space), of the
        same shape, float32 or float16. The built-in networks do without either, at a loss of detail.
    model: a name that `models` lists, or a weights file.
    alpha: of a transparent film, shape (H, W), float32 or float16. The built-in networks denoise it where it differs from
        pixel to pixel, so that it fits the colours over any background, and leave empty pixels empty; others return it.
    samples: samples per pixel of the render. Some models decide by it how much they trust a pixel; files tell
        it in their metadata, arrays cannot.
    threads: how many threads to use; None for all cores.

    Rows run from top to bottom. Values that are not finite, or masked, are filled in from around them. Python's lock is
    released; after Ctrl-C the call ends at once, and the work in the background when the model has done.

    ValueError: arrays that do not fit, an unknown model, or arrays that the model needs and that are missing.
    Error: the model cannot denoise the frame, or most of it is not finite.
    """
    radiance = _image("color", color)
    guides = [
        None if guide is None else _image(name, guide, color.shape)
        for name, guide in [("albedo", albedo), ("normal", normal)]
    ]
    coverage = None if alpha is None else _image("alpha", alpha, color.shape[:2])
    counts = _count("samples", samples, 65535), _count("threads", threads, _demc.MOST_THREADS)
    result, share = _demc.denoise_arrays(radiance, *guides, coverage, _path("model", model), *counts)
    result = _like(result, color)
    return result if alpha is None else (result, _like(share, alpha))


def denoise_file(
    source, out, model="demc-m", *, overwrite=False, view_layer=None, layer="Denoised", passes=False, alpha="auto",
    confidence=False, albedo=None, normal=None, names=None, threads=None
):
    """Denoises an EXR file into another: all that it held, and the layer `Denoised`. Byte for byte what the
    command writes.

    source, out: paths of two files; the folder of `out` must exist.
    model: a name that `models` lists, or a weights file.
    overwrite: whether a file at `out` is replaced.
    view_layer: the view layer to denoise; None for the one with the most passes.
    layer: the name of the layer added; None to replace the beauty in place of that.
    passes: whether light passes and light groups are denoised too, so that they add up to the beauty.
    alpha: "auto", "denoise" or "keep", as of `demc denoise --alpha`.
    confidence: whether a layer is added that tells how far off each pixel is expected to be.
    albedo, normal: paths of files that hold those alone, of renderers that write a file for each pass.
    names: a dict of what the file calls passes, where their names do not tell: {"albedo": "my colour"}; the
        words are those of `demc denoise --map`.
    threads: how many threads to use; None for all cores.

    Returns a `Report`, a dict: view_layer; width and height in pixels; samples of a pixel, None where the file does not
    tell; was_denoised, whether Blender had done so and its Noisy Image was taken; expected_error, the RelMSE expected of
    the result, None where the model does not tell; seconds in the model; repaired, the count of values that were not finite
    by pass; notes, a list of what is good to know.

    ValueError: an unknown model, options that it cannot meet, or `out` is `source`.
    Error: a file cannot be read or written, lacks a pass, or exists without `overwrite`. `out` is whole, or
    not there; after Ctrl-C it is not begun. A process that ends within that may leave a file `.demc-*.tmp` beside it.
    """
    source, out, model = _path("source", source), _path("out", out), _path("model", model)
    guides = tuple(None if path is None else _path(name, path) for name, path in (("albedo", albedo), ("normal", normal)))
    lines = _lines(names)
    view_layer, layer = _name("view_layer", view_layer), _name("layer", layer)
    if not isinstance(alpha, str):
        raise ValueError(f'alpha is a {type(alpha).__name__}; give "auto", "denoise" or "keep"')
    if os.path.exists(out):
        read = [source, *(path for path in guides if path is not None)]
        if any(os.path.exists(path) and os.path.samefile(path, out) for path in read):
            raise ValueError(f"{out}: the result would overwrite what it is made of; choose another out")
        if not overwrite:
            raise Error(f"{out}: exists; overwrite=True replaces it, or choose another out")
    threads = _count("threads", threads, _demc.MOST_THREADS)
    options = layer, bool(passes), alpha, bool(confidence)
    return _demc.denoise_path(source, out, model, view_layer, guides, lines, options, threads)


def models():
    """The models there are: the list of dicts of `demc models --json` (model, weights, parameters, passes ...).

    Error: a weights file cannot be read.
    """
    return json.loads(_demc.models_json())


def inspect(path):
    """What an EXR file holds: the dict of `demc inspect --json` (layout, parts, layers with their passes,
    what each model misses, findings).

    Error: the file cannot be read.
    """
    return json.loads(_demc.inspect_json(_path("path", path)))


def compare(image, reference, *, view_layer=None, layer=None, reference_layer=None):
    """How far an EXR file is from its reference: a dict of the metrics of `demc compare`, by name.

    view_layer: the view layer to compare; None for the one of `image` with the most passes and its namesake.
    layer: the layer of `image` to judge; None for `Denoised` where there is one, else Combined.
    reference_layer: the layer of `reference` to judge it by; None for Combined.

    A metric that is not defined on the two is None.

    Error: a file cannot be read or lacks a layer, or the images differ in size or place or hold values that are not
    finite.
    """
    layers = [_name("view_layer", view_layer), _name("layer", layer), _name("reference_layer", reference_layer)]
    return dict(_demc.compare_files(_path("image", image), _path("reference", reference), layers))
