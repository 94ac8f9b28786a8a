"""The extension in a real Blender: checked and installed by Blender's own commands, then used in a window
(window.py) on a screen of its own, which needs Xvfb and OpenGL (Mesa's by software will do).

    python3 in_window.py BLENDER ARCHIVE.zip [--pictures FOLDER]
"""

import argparse
import json
import os
import pathlib
import shutil
import struct
import subprocess
import sys
import tempfile
import zlib

WIDTH, HEIGHT = 1400, 900
PATIENCE_SECONDS = 1200


def run(command, environment):
    """Runs to success; what it said otherwise."""
    ended = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=PATIENCE_SECONDS)
    if ended.returncode:
        sys.exit(f"{' '.join(map(str, command))} failed:\n{ended.stdout[-4000:]}{ended.stderr[-4000:]}")
    return ended.stdout


def start_screen(folder):
    """Xvfb on a display that is free, and the display's name."""
    if shutil.which("Xvfb") is None:
        sys.exit("Xvfb is not installed: apt-get install xvfb")
    read, write = os.pipe()
    screen = subprocess.Popen(
        ["Xvfb", "-displayfd", str(write), "-screen", "0", f"{WIDTH}x{HEIGHT}x24", "-fbdir", folder],
        pass_fds=[write], stderr=subprocess.DEVNULL,
    )
    os.close(write)
    with os.fdopen(read) as told:
        return screen, f":{told.readline().strip()}"


def write_png(window_dump, png):
    """Xvfb's frame buffer, a dump in the format of xwd, as PNG."""
    data = window_dump.read_bytes()
    header = struct.unpack(">25I", data[:100])
    start, stride, colours = header[0], header[12], header[19]
    pixels = data[start + 12 * colours:]
    rows = b""
    for y in range(HEIGHT):
        row = pixels[y * stride:y * stride + WIDTH * 4]  # blue, green, red, nothing
        out = bytearray(WIDTH * 3)
        out[0::3], out[1::3], out[2::3] = row[2::4], row[1::4], row[0::4]
        rows += b"\0" + out

    def chunk(kind, body):
        return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))

    png.write_bytes(
        b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", struct.pack(">2I5B", WIDTH, HEIGHT, 8, 2, 0, 0, 0))
        + chunk(b"IDAT", zlib.compress(rows, 9)) + chunk(b"IEND", b""))


def main():
    """Prints what was found; the status is 1 where something is wrong."""
    parser = argparse.ArgumentParser(description="Tries the extension in a window of Blender.")
    parser.add_argument("blender", help="the program, 4.2 or later")
    parser.add_argument("archive", type=pathlib.Path, help="the extension, as build.py makes it")
    parser.add_argument("--pictures", type=pathlib.Path, help="keep pictures of the window in this folder")
    arguments = parser.parse_args()
    archive = str(arguments.archive.resolve())
    window = pathlib.Path(__file__).resolve().parent / "window.py"
    with tempfile.TemporaryDirectory() as home, tempfile.TemporaryDirectory() as folder:
        environment = {**os.environ, "BLENDER_USER_RESOURCES": home, "PYTHONDONTWRITEBYTECODE": "1"}
        extension = [arguments.blender, "--command", "extension"]
        run([*extension, "validate", archive], environment)
        run([*extension, "install-file", "--repo", "user_default", "--enable", archive], environment)
        screen, environment["DISPLAY"] = start_screen(folder)
        try:
            ended = subprocess.run(
                [arguments.blender, "--enable-event-simulate", "--window-geometry", "0", "0", str(WIDTH), str(HEIGHT),
                 "--python", str(window), "--", folder],
                env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, timeout=PATIENCE_SECONDS)
        finally:
            screen.terminate()
            screen.wait()
        report = pathlib.Path(folder, "said.json")
        if not report.is_file():
            sys.exit(f"Blender ended with status {ended.returncode}:\n{ended.stdout[-4000:]}")
        said = json.loads(report.read_text())
        if arguments.pictures:
            arguments.pictures.mkdir(parents=True, exist_ok=True)
            for dump in pathlib.Path(folder).glob("*.xwd"):
                write_png(dump, arguments.pictures / f"{dump.stem}.png")
    print(f"Blender {said['blender']}", *said["lines"], sep="\n")
    sys.exit(bool(said["failed"]))


if __name__ == "__main__":
    main()
