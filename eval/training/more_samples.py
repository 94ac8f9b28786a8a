"""Scores a frame by another render of the scene with more samples, where its reference shows something else.

    python more_samples.py ../shared/data/val/glass_caustics_0004spp.exr --model demc-m --oidn PATH/oidnDenoise [--spp 16]

Compared are what the model and what Open Image Denoise (quality high, guides denoised first) make of the frame. Printed are the
RelMSE of both against the mean of what the two make of the other render, and their difference against the other render as
it is, whose noise is the same for both and cancels.
"""

import argparse
import tempfile

from clean_references import exr, planes
from distance import errors
from methods import add_options, both


def main():
    """Entry point of the script."""
    parser = argparse.ArgumentParser(prog="more_samples.py", description="Scores a frame by a render with more samples.")
    parser.add_argument("frame", help="<scene>_<spp>spp.exr")
    add_options(parser)
    parser.add_argument("--spp", type=int, default=16, help="samples of the other render, beside the frame (default 16)")
    options = parser.parse_args()
    more = f"{options.frame[: options.frame.rindex('_')]}_{options.spp:04}spp.exr"
    with tempfile.TemporaryDirectory() as folder:
        ours, theirs = both(options, options.frame, folder)
        target = sum(both(options, more, folder)) / 2
    raw, _ = planes(exr.read(more), "Combined", "RGB")
    relmse, their_relmse, difference = errors(ours, theirs, target, raw)
    print(f"ours   {relmse:.5f}\ntheirs {their_relmse:.5f}\nours - theirs, unbiased {difference:+.5f}")


if __name__ == "__main__":
    main()
