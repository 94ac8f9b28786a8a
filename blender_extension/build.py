"""Builds the extension: target/extension/demc-<version>.zip, which Blender installs (Preferences > Get
Extensions > Install from Disk). Takes the wheel that `python/build_wheel.sh` makes.

    python3 blender_extension/build.py [WHEEL ...] [--out FILE]
"""

import argparse
import pathlib
import re
import sys
import zipfile

ROOT = pathlib.Path(__file__).resolve().parent.parent
SOURCE = ROOT / "blender_extension/demc"
# By a pattern of what a wheel's name ends in, what Blender calls the system.
PLATFORMS = {
    r"manylinux.*_x86_64": "linux-x64", "win_amd64": "windows-x64", "macosx_11_0_arm64": "macos-arm64",
    "macosx_10_12_x86_64": "macos-x64",
}


def platform(wheel):
    """What Blender calls the system of a wheel."""
    for ending, name in PLATFORMS.items():
        if re.search(ending, wheel.name):
            return name
    sys.exit(f"{wheel.name}: Blender has no name for its system; known are {', '.join(PLATFORMS)}")


def manifest(wheels):
    """The manifest with the wheels that are bundled and the systems that they are for."""
    text = (SOURCE / "blender_manifest.toml").read_text()
    listed = ", ".join(f'"./wheels/{wheel.name}"' for wheel in wheels)
    systems = ", ".join(f'"{name}"' for name in sorted({platform(wheel) for wheel in wheels}))
    text = re.sub(r"^wheels = .*$", f"wheels = [{listed}]", text, flags=re.M)
    return re.sub(r"^platforms = .*$", f"platforms = [{systems}]", text, flags=re.M)


def main():
    """Writes the archive and prints where it is."""
    parser = argparse.ArgumentParser(description="Builds the Blender extension.")
    parser.add_argument("wheels", nargs="*", type=pathlib.Path, help="wheels to bundle [default: those of target/wheels]")
    parser.add_argument("--out", type=pathlib.Path, help="the archive [default: target/extension/demc-<version>.zip]")
    arguments = parser.parse_args()
    wheels = arguments.wheels or sorted((ROOT / "target/wheels").glob("demc-*.whl"))
    if not wheels:
        sys.exit("no wheel in target/wheels: run python/build_wheel.sh first, or name one")
    version = re.search(r'^version = "(.*)"', manifest(wheels), re.M).group(1)
    archive = arguments.out or ROOT / f"target/extension/demc-{version}.zip"
    archive.parent.mkdir(parents=True, exist_ok=True)
    with zipfile.ZipFile(archive, "w", zipfile.ZIP_DEFLATED) as out:
        out.writestr("blender_manifest.toml", manifest(wheels))
        for file in sorted(SOURCE.glob("*.py")):
            out.write(file, file.name)
        # The worker reads results with the scripts' reader of EXR.
        out.write(ROOT / "blender_scripts/demc_blender/exr.py", "exr.py")
        for wheel in wheels:
            out.write(wheel, f"wheels/{wheel.name}", zipfile.ZIP_STORED)
    print(archive)


if __name__ == "__main__":
    main()
