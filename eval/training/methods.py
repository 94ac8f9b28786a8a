"""Denoises a frame by demc and by Open Image Denoise, for the scripts that compare them."""

import os
import subprocess

from clean_references import clean, exr, planes


def add_options(parser):
    """The options that `both` reads."""
    parser.add_argument("--model", required=True, help="a model's name or a weights file")
    parser.add_argument("--demc", default="demc", help="the program demc")
    parser.add_argument("--oidn", default=os.environ.get("OIDN_DENOISE", "oidnDenoise"), help="the program oidnDenoise")


def demc(program, model, path, folder):
    """The result of `demc denoise` on a frame, (height, width, 3); its file is written into `folder`."""
    out = os.path.join(folder, "out")
    subprocess.run([program, "denoise", path, "--model", model, "--out", out, "--overwrite"], check=True, capture_output=True)
    return planes(exr.read(os.path.join(out, os.path.basename(path))), "Denoised", "RGB")[0]


def both(options, path, folder):
    """The results of the model and of Open Image Denoise, quality high with guides denoised first."""
    frame = exr.read(path)
    theirs = clean(options.oidn, folder, planes(frame, "Combined", "RGB")[0], frame)
    return demc(options.demc, options.model, path, folder), theirs
