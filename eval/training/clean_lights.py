"""Denoises what each light group lights of the references in a folder of `generate_scenes.py --light-groups`.

    python clean_lights.py FOLDER --oidn PATH/oidnDenoise

Blender denoises Combined alone. Here each Combined_<group> of a reference becomes Noisy Image_<group>, and what Open Image
Denoise (quality high, guides denoised first) makes of it Combined_<group>, as it is with Combined itself. What is done already
is kept.
"""

import argparse
import glob
import os
import re
import tempfile

from clean_references import denoise, exr, planes


def groups(channels):
    """The prefix of a frame's channels and the names of its light groups, sorted."""
    named = [re.fullmatch(r"(.*\.)?Combined_(.+)\.R", name) for name in channels]
    return sorted(match.groups("") for match in named if match)


def main():
    """Entry point of the script."""
    parser = argparse.ArgumentParser(prog="clean_lights.py", description="Denoises the light groups of references.")
    parser.add_argument("folder", help="folder of <scene>_ref.exr")
    parser.add_argument("--oidn", default=os.environ.get("OIDN_DENOISE", "oidnDenoise"), help="the program oidnDenoise")
    options = parser.parse_args()
    done = 0
    for path in sorted(glob.glob(os.path.join(glob.escape(options.folder), "*_ref.exr"))):
        channels = exr.read(path)
        if any("Noisy Image_" in name for name in channels) or not groups(channels):
            continue
        with tempfile.TemporaryDirectory() as folder:
            denoise(options.oidn, folder, "albedo", **{"--alb": planes(channels, "Denoising Albedo", "RGB")[0]})
            denoise(options.oidn, folder, "normal", **{"--nrm": planes(channels, "Denoising Normal", "XYZ")[0]})
            for layer, group in groups(channels):
                radiance, names = planes(channels, f"Combined_{group}", "RGB")
                guides = {"--alb": "albedo", "--nrm": "normal"}
                clean = denoise(options.oidn, folder, "clean", "--clean_aux", **{"--hdr": radiance}, **guides)
                for c, (name, letter) in enumerate(zip(names, "RGB")):
                    channels[f"{layer}Noisy Image_{group}.{letter}"] = channels[name]
                    channels[name] = clean[..., c]
        exr.write_half(path, channels)
        done += 1
    print(f"{options.folder}: {done} references")


if __name__ == "__main__":
    main()
