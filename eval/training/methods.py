"""What demc and Open Image Denoise make of a frame, for the scripts that compare them."""

import os
import subprocess

from clean_references import clean, exr, planes


def add_options(parser):
    """The options that `both` reads."""
    parser.add_argument("--model", required=True, help="a model's name or a weights file")
    parser.add_argument("--demc", default="demc", help="the program demc")
    parser.add_argument("--oidn", default=os.environ.get("OIDN_DENOISE", "oidnDenoise"), help="the program oidnDenoise")


def demc(program, model, path, folder):
    """What `demc denoise` makes of a frame, (height, width, 3), by way of `folder`."""
    out = os.path.join(folder, "out")
    subprocess.run([program, "denoise", path, "--model", model, "--out", out, "--overwrite"], check=True, capture_output=True)
    return planes(exr.read(os.path.join(out, os.path.basename(path))), "Denoised", "RGB")[0]


def both(options, path, folder):
    """What the model makes of a frame, and Open Image Denoise, quality high with guides denoised first."""
    frame = exr.read(path)
    theirs = clean(options.oidn, folder, planes(frame, "Combined", "RGB")[0], frame)
    return demc(options.demc, options.model, path, folder), theirs
