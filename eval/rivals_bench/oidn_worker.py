"""Open Image Denoise's side: its program on noise of the size of a frame, by the time of its filter."""

import argparse
import array
import random
import re
import subprocess
import tempfile
from pathlib import Path

from protocol import serve


def write_pfm(path, width, height, seed):
    values = random.Random(seed)
    # Noise need not differ from row to row: the filter's time does not depend on it.
    row = array.array("f", (values.random() for _ in range(3 * width)))
    with open(path, "wb") as file:
        file.write(f"PF\n{width} {height}\n-1.0\n".encode())
        for _ in range(height):
            file.write(row.tobytes())


def filter_(program, quality, width, height, threads, folder):
    names = ("color", "albedo", "normal")
    for seed, name in enumerate(names):
        write_pfm(folder / f"{name}_{width}x{height}.pfm", width, height, seed)
    color, albedo, normal = (str(folder / f"{name}_{width}x{height}.pfm") for name in names)
    command = [program, "-d", "cpu", "--hdr", color, "--alb", albedo, "--nrm", normal, "-q", quality]
    # The second of its runs is warm.
    command += ["-n", "2", "--threads", str(threads)]

    def run():
        done = subprocess.run(command, capture_output=True, text=True, check=True)
        _, log = done.stdout.split("\nDenoising", 1)
        return float(re.findall(r"msec=([0-9.]+)", log)[-1]) / 1e3

    return run


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--threads", type=int, required=True)
    parser.add_argument("--small", action="store_true")
    parser.add_argument("--program", required=True)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        folder = Path(folder)
        write_pfm(folder / "version.pfm", 16, 16, 0)
        log = subprocess.run([args.program, "--hdr", folder / "version.pfm"], capture_output=True, text=True).stdout
        version = re.search(r"version=([0-9.]+)", log)
        jobs = {
            f"oidn-{quality} {width}x{height}": lambda q=quality, w=width, h=height: filter_(
                args.program, q, w, h, args.threads, folder
            )
            for width, height in ([(160, 96)] if args.small else [(1280, 720), (1920, 1080)])
            for quality in ("fast", "balanced", "high")
        }
        serve(jobs, {"program": f"oidnDenoise {version[1] if version else ''}".strip()})


if __name__ == "__main__":
    main()
