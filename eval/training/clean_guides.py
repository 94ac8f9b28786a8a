"""Copies a test set with its guides denoised, which shows how much a better filter of the albedo could gain
at most.

    python clean_guides.py '../shared/data/val/*_0004spp.exr' OUT --oidn PATH/oidnDenoise --guides albedo

The noisy frames keep their Combined pass. The passes named by --guides are replaced by what Open Image
Denoise, quality high, makes of them. With --spp N they are replaced by those of a render with N samples,
<scene>_<N>spp.exr beside the frame, and frames without such a render are left out. References are copied.
With --keep-quotient, Combined is scaled by the ratio of clean to noisy albedo, so that a model that divides
it by the clean albedo gets what the original gives when divided by the noisy one.
"""

import argparse
import glob
import os
import shutil
import tempfile

from clean_references import denoise, divisor, exr, planes

GUIDES = {"albedo": ("Denoising Albedo", "RGB", "--alb"), "normal": ("Denoising Normal", "XYZ", "--nrm")}


def main():
    """Entry point of the script."""
    parser = argparse.ArgumentParser(prog="clean_guides.py", description="Denoises the guides of noisy frames.")
    parser.add_argument("frames", help="quoted glob of <scene>_<spp>spp.exr, beside <scene>_ref.exr")
    parser.add_argument("out", help="folder for the frames with clean guides")
    parser.add_argument("--guides", default="albedo,normal", help="albedo, normal or both (default)")
    parser.add_argument("--keep-quotient", action="store_true", help="leave radiance over albedo as it is")
    parser.add_argument("--spp", type=int, metavar="N", help="take guides from a render with N samples, not from the denoiser")
    parser.add_argument("--oidn", default=os.environ.get("OIDN_DENOISE", "oidnDenoise"), help="the program oidnDenoise")
    options = parser.parse_args()
    os.makedirs(options.out, exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        for source in sorted(glob.glob(options.frames)):
            scene = os.path.basename(source).rsplit("_", 1)[0]
            reference = os.path.join(os.path.dirname(source), scene + "_ref.exr")
            more = os.path.join(os.path.dirname(source), f"{scene}_{options.spp:04}spp.exr") if options.spp else None
            if more and not os.path.exists(more):
                continue
            channels = exr.read(source)
            for guide in options.guides.split(","):
                ending, letters, option = GUIDES[guide]
                noisy, names = planes(channels, ending, letters)
                if more:
                    clean, _ = planes(exr.read(more), ending, letters)
                else:
                    clean = denoise(options.oidn, folder, "clean", **{option: noisy})
                channels.update({name: clean[..., c] for c, name in enumerate(names)})
                if guide == "albedo" and options.keep_quotient:
                    radiance, names = planes(channels, "Combined", "RGB")
                    radiance = radiance * divisor(clean) / divisor(noisy)
                    channels.update({name: radiance[..., c] for c, name in enumerate(names)})
            exr.write_half(os.path.join(options.out, os.path.basename(source)), channels)
            shutil.copy(reference, options.out)
            print(scene, flush=True)


if __name__ == "__main__":
    main()
