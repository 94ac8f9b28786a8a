"""Tells how far a model is from Open Image Denoise, quality high with guides denoised first, on the pairs
of a manifest.

    python distance.py MANIFEST --model WEIGHTS --oidn PATH/oidnDenoise [--demc PATH/demc] [--most 110]

It reads pairs of 4 samples whose references were denoised and keep the reference as rendered as Noisy Image.
For all of them, and for each third in the order of Open Image Denoise's RelMSE, it prints two numbers. The
first is the geometric mean of the ratio of RelMSE, both against the denoised reference; it favours whoever
errs as the denoiser of the references does. The second is the median of (ours - its) / ours, where the
difference is of errors against the noisy reference, whose noise is the same for both and cancels, and the
denominator is our RelMSE against the denoised one.
"""

import argparse
import random
import tempfile

import numpy as np

import manifests
from clean_references import exr, planes
from methods import add_options, both


def errors(ours, theirs, denoised, raw):
    """RelMSE of both against a denoised reference, and the difference of their errors against a noisy one."""
    weight = 1 / (denoised**2 + 1e-3)
    relmse = [float(((image - denoised) ** 2 * weight).mean()) for image in (ours, theirs)]
    return *relmse, float(((ours - theirs) * (ours + theirs - 2 * raw) * weight).mean())


def tell(name, rows):
    ours, theirs, difference = np.array(rows).T
    ratio, median = np.exp(np.log(ours / theirs).mean()), np.median(difference / ours)
    print(f"{name:8} {len(rows):4} pairs, RelMSE {theirs.min():.4f} to {theirs.max():.4f}: ratio {ratio:.3f}, unbiased {median:+.3f}")


def main():
    """Entry point of the script."""
    parser = argparse.ArgumentParser(prog="distance.py", description="Compares a model with Open Image Denoise.")
    parser.add_argument("manifest", help="CSV with columns noisy, reference and spp")
    add_options(parser)
    parser.add_argument("--most", type=int, default=110, help="pairs drawn from the manifest, if it has more")
    options = parser.parse_args()
    pairs = [row for row in manifests.read(options.manifest) if row["spp"] == "4"]
    random.Random(3).shuffle(pairs)
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for pair in pairs:
            if len(rows) == options.most:
                break
            reference = exr.read(pair["reference"])
            if not any("Noisy Image." in name for name in reference):
                continue
            ours, theirs = both(options, pair["noisy"], folder)
            references = (planes(reference, name, "RGB")[0] for name in ("Combined", "Noisy Image"))
            rows.append(errors(ours, theirs, *references))
    if len(rows) < 3:
        raise SystemExit(f"{options.manifest}: {len(rows)} pairs of 4 samples whose references keep a Noisy Image, at least 3 are needed")
    rows.sort(key=lambda row: row[1])
    tell("all", rows)
    for k, name in enumerate(("lowest", "middle", "highest")):
        tell(name, rows[len(rows) * k // 3 : len(rows) * (k + 1) // 3])


if __name__ == "__main__":
    main()
