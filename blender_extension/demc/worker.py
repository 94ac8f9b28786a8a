"""Runs demc outside Blender: started by `jobs.py` with Blender's Python, never imported by Blender.

In: one JSON object in the first line of standard input (`paths` for sys.path, `arguments` of the command
demc, and `picture`: which layer of which result is wanted as a file of its own, or null). Out: the JSON lines
of `demc denoise --json`, then {"picture": path} where one was wanted. The rest of standard input is a
lifeline: when it closes, because the job is cancelled or Blender is gone, the worker stops as demc stops on
Ctrl-C, files whole or not there.
"""

import importlib.util
import json
import os
import signal
import sys
import threading
import time

# How long a frame that is being written may take after the end was asked for.
_GRACE_SECONDS = 5.0
_INTERRUPTED = 130


def main():
    """Runs the request; the status is that of the command demc."""
    # Not sys.stdin: a thread that waits in it for the lifeline would hold its lock at the end.
    request = json.loads(_first_line())
    threading.Thread(target=_end_with_the_lifeline, daemon=True).start()
    sys.path[:0] = request["paths"]
    status = _demc(request["arguments"])
    if status == 0 and request["picture"]:
        _picture(request["picture"])
    sys.stdout.flush()
    os._exit(status)


def _first_line():
    line = b""
    while not line.endswith(b"\n"):
        read = os.read(0, 1 << 16)
        if not read:
            os._exit(_INTERRUPTED)
        line += read
    return line


def _end_with_the_lifeline():
    while os.read(0, 1):
        pass
    if os.name == "posix":
        os.kill(os.getpid(), signal.SIGTERM)  # demc finishes the file it is writing
        time.sleep(_GRACE_SECONDS)
    os._exit(_INTERRUPTED)


def _demc(arguments):
    from demc._command import main as command

    sys.argv = ["demc", *arguments]
    try:
        command()
    except SystemExit as ended:
        return ended.code or 0
    return 0


def _picture(wanted):
    """Writes the denoised layer of a result as a plain EXR, which every Image Editor shows at once. One that
    cannot be made is no failure: the result itself is there."""
    try:
        exr = _module("exr")
        channels = _plain(exr.read(wanted["of"]), wanted["layer"], exr.channel_names(wanted["noisy"]))
        exr.write_float(wanted["as"], channels, level=1)
        print(json.dumps({"picture": wanted["as"]}))
    except (ImportError, ValueError, KeyError, OSError) as error:
        print(json.dumps({"no_picture": " ".join(str(error).split())}))


def _module(name):
    # By its path: the folder of this file on sys.path would offer every module of the extension.
    path = os.path.join(os.path.dirname(os.path.abspath(__file__)), f"{name}.py")
    spec = importlib.util.spec_from_file_location(f"demc_worker_{name}", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def _plain(channels, layer, before):
    """The channels R, G, B and A of the layer `<view layer>.<layer>`, which a file with the channels `before` was given;
    of the first eye, where there are two. The results of light groups, `<view layer>.<pass>.<layer>`, have longer
    names."""
    found = {}
    for name in sorted(set(channels) - set(before), key=lambda name: (name.count("."), name)):
        parts = name.split(".")
        if layer in parts[1:-1] and parts[-1] in "RGBA":
            found.setdefault(parts[-1], channels[name])
    if not {"R", "G", "B"} <= found.keys():
        raise ValueError(f"no layer {layer} among {', '.join(sorted(channels))}")
    return found


if __name__ == "__main__":
    main()
