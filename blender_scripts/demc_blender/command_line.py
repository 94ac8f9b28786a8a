"""Arguments and printing that work alike under `python SCRIPT` and `blender -P SCRIPT --`."""

import argparse
import os
import signal
import socket
import sys
import threading

import bpy


def inside_blender():
    """True in the Blender program, false where Python imported bpy as a module."""
    return bool(bpy.app.binary_path)


def script_arguments():
    """The script's own arguments: after `--` in Blender, all of them under Python."""
    if inside_blender():
        return sys.argv[sys.argv.index("--") + 1:] if "--" in sys.argv else []
    return sys.argv[1:]


def quiet_stdout():
    """Sends Blender's own chatter to nowhere and keeps `print` for this script's lines.

    Blender writes progress from C straight to file descriptor 1, so the descriptor itself moves.
    """
    if not bpy.app.background:
        return
    sys.stdout.flush()
    ours = os.dup(1)
    sink = os.open(os.devnull, os.O_WRONLY)
    os.dup2(sink, 1)
    os.close(sink)
    sys.stdout = os.fdopen(ours, "w", buffering=1, encoding="utf-8", errors="replace")


def end_at_once(tidy):
    """Lets Ctrl-C and SIGTERM end the script at once, after `tidy()`.

    Python's own handler waits until a render ends, and the KeyboardInterrupt is then lost in Cycles' callbacks. An open Blender
    window keeps its handlers.
    """
    if not bpy.app.background:
        return
    reader, writer = socket.socketpair()
    writer.setblocking(False)
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: None)
    signal.set_wakeup_fd(writer.detach())

    def wait():
        number = reader.recv(1)[0]
        tidy()
        os._exit(128 + number)

    threading.Thread(target=wait, daemon=True).start()


def make_folder(path):
    """Makes the folder of --out, or ends the script with a line that says why not."""
    try:
        os.makedirs(path, exist_ok=True)
    except OSError as error:
        print(f"error: {path}: {error.strerror} (--out)", file=sys.stderr)
        sys.exit(1)


def reason(error):
    """An exception's message on one line."""
    return " ".join(str(error).split())


def finish(failed):
    """Ends a script with exit code 1 where something failed. An open Blender window stays open."""
    sys.stdout.flush()
    if failed and bpy.app.background:
        sys.exit(1)


def counts(text):
    """Parses `4,16` into positive sample counts, in order, without repeats."""
    values = [positive(part) for part in text.split(",")]
    return list(dict.fromkeys(values))


def positive(text):
    """Parses an integer of at least 1."""
    value = _integer(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"{text} is not a number of at least 1")
    return value


def size(text):
    """Parses `480x270` into (width, height)."""
    parts = text.lower().split("x")
    if len(parts) != 2:
        raise argparse.ArgumentTypeError(f"{text} is not WIDTHxHEIGHT, for example 480x270")
    return positive(parts[0]), positive(parts[1])


def side_or_size(text):
    """Parses `128` or `320x180` into (width, height)."""
    return size(text) if "x" in text.lower() else (positive(text),) * 2


def frame_range(text):
    """Parses `A-B` or a single `A` into (first, last); negative frames are written `--frames=-5--1`."""
    cut = text.find("-", 1)
    first = _integer(text if cut < 0 else text[:cut])
    last = first if cut < 0 else _integer(text[cut + 1:])
    if last < first:
        raise argparse.ArgumentTypeError(f"{text}: the last frame comes before the first")
    return first, last


def seed_range(text):
    """Parses `A:B` (B left out, as in Python) or a single `A`."""
    first, colon, last = text.partition(":")
    start = _integer(first)
    stop = _integer(last) if colon else start + 1
    if stop <= start:
        raise argparse.ArgumentTypeError(f"{text} holds no seed; write for example 0:100")
    return range(start, stop)


def region(text):
    """Parses `X,Y,W,H` in pixels, counted from the top left corner."""
    parts = [_integer(part) for part in text.split(",")]
    if len(parts) != 4 or min(parts) < 0 or parts[2] < 1 or parts[3] < 1:
        raise argparse.ArgumentTypeError(f"{text} is not X,Y,WIDTH,HEIGHT in pixels")
    return tuple(parts)


def _integer(text):
    try:
        return int(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number") from None
