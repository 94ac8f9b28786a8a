"""Writes what Open Image Denoise makes of noisy frames, as references to imitate.

    python teacher.py MANIFEST --out OUT --oidn PATH/oidnDenoise

MANIFEST is a CSV with a column `noisy`, as `demc train --data` takes it. For each of its frames OUT gets <frame>_ref.exr, quality
high with guides denoised first, and OUT/manifest.csv the pairs. A reference holds detail that no network can know from
4 samples; a teacher's output does not, and so tells with less noise which way the weights should go. What is there
already is kept.
"""

import argparse
import csv
import os
import tempfile

from clean_references import clean, exr, planes


def main():
    """Entry point of the script."""
    parser = argparse.ArgumentParser(prog="teacher.py", description="Denoises noisy frames for networks to imitate.")
    parser.add_argument("manifest", help="CSV with a column noisy")
    parser.add_argument("--out", required=True, help="folder for the references and their manifest.csv")
    parser.add_argument("--oidn", default=os.environ.get("OIDN_DENOISE", "oidnDenoise"), help="the program oidnDenoise")
    options = parser.parse_args()
    os.makedirs(options.out, exist_ok=True)
    with open(options.manifest, encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    pairs = []
    with tempfile.TemporaryDirectory() as folder:
        for row in rows:
            scene = os.path.basename(row["noisy"]).removesuffix(".exr")
            target = os.path.join(options.out, f"{scene}_ref.exr")
            if not os.path.exists(target):
                channels = exr.read(row["noisy"])
                radiance, names = planes(channels, "Combined", "RGB")
                taught = clean(options.oidn, folder, radiance, channels)
                exr.write_half(target, {name: taught[..., c] for c, name in enumerate(names)})
            pairs.append([f"{scene}_taught", row["noisy"], target, row["spp"]])
    with open(os.path.join(options.out, "manifest.csv"), "w", encoding="utf-8", newline="") as file:
        csv.writer(file, lineterminator="\n").writerows([["scene", "noisy", "reference", "spp"], *pairs])
    print(f"{len(pairs)} pairs in {options.out}")


if __name__ == "__main__":
    main()
