"""A wheel that holds no more of demc than the way to a program that was built already: what `cargo test`
bundles, in place of the wheel of `python/build_wheel.sh`, whose making takes minutes and which has tests of
its own.

    python thin_wheel.py PROGRAM FOLDER      prints the wheel's path
"""

import pathlib
import sys
import zipfile

COMMAND = '''"""The command, as the whole wheel has it."""
import ctypes
import signal
import subprocess
import sys


def main():
    """Runs the program with this process's arguments; it ends when this process is asked to."""
    # 1 is PR_SET_PDEATHSIG: where this process is killed, the program dies as well, as if it were of this
    # process.
    die_with_this = (lambda: ctypes.CDLL(None).prctl(1, signal.SIGKILL)) if sys.platform == "linux" else None
    program = subprocess.Popen([{program!r}, *sys.argv[1:]], preexec_fn=die_with_this)
    signal.signal(signal.SIGTERM, lambda *_: program.terminate())
    sys.exit(program.wait())
'''
WHEEL = "Wheel-Version: 1.0\nGenerator: thin_wheel\nRoot-Is-Purelib: true\nTag: py3-none-manylinux_2_28_x86_64\n"


def main(program, folder):
    """Writes the wheel."""
    info = "demc-0.1.0.dist-info"
    files = {
        "demc/__init__.py": "",
        "demc/_command.py": COMMAND.format(program=program),
        f"{info}/METADATA": "Metadata-Version: 2.1\nName: demc\nVersion: 0.1.0\n",
        f"{info}/WHEEL": WHEEL,
    }
    files[f"{info}/RECORD"] = "".join(f"{name},,\n" for name in [*files, f"{info}/RECORD"])
    wheel = pathlib.Path(folder, "demc-0.1.0-py3-none-manylinux_2_28_x86_64.whl")
    with zipfile.ZipFile(wheel, "w") as out:
        for name, text in files.items():
            out.writestr(name, text)
    print(wheel)


if __name__ == "__main__":
    main(*sys.argv[1:])
