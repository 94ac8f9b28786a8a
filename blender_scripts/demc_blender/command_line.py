"""Arguments and printing that work alike under `python SCRIPT` and `blender -P SCRIPT --`."""

import argparse
import atexit
import ctypes
import os
import shutil
import signal
import socket
import sys
import tempfile
import threading

import bpy

_chatter = None  # the file that takes what Blender prints, once quiet_stdout was called
_TROUBLE = ("error", "exception", "cannot", "failed", "unable")


def inside_blender():
    """True in the Blender program, false where Python imported bpy as a module."""
    return bool(bpy.app.binary_path)


def script_arguments():
    """The script's own arguments: after `--` in Blender, all of them under Python."""
    if inside_blender():
        return sys.argv[sys.argv.index("--") + 1:] if "--" in sys.argv else []
    return sys.argv[1:]


def quiet_stdout():
    """Keeps `print` for this script's lines and puts Blender's own chatter aside, see `trouble_heard`.

    Blender writes progress from C straight to file descriptor 1, so the descriptor itself moves.
    """
    global _chatter
    if not bpy.app.background:
        return
    sys.stdout.flush()
    ours = os.dup(1)
    _chatter = tempfile.TemporaryFile()
    os.dup2(_chatter.fileno(), 1)
    sys.stdout = os.fdopen(ours, "w", buffering=1, encoding="utf-8", errors="replace")


def forget_chatter():
    """Empties what was put aside: what is heard from here on belongs to what comes now."""
    if _chatter:
        _flush_c()
        os.ftruncate(_chatter.fileno(), 0)
        os.lseek(_chatter.fileno(), 0, os.SEEK_SET)


def trouble_heard():
    """What Blender has printed of trouble since `forget_chatter`, on one line; empty for none."""
    if not _chatter:
        return ""
    _flush_c()
    # Blender goes on writing where this ends: at the end, as before.
    os.lseek(_chatter.fileno(), 0, os.SEEK_SET)
    lines = os.read(_chatter.fileno(), os.fstat(_chatter.fileno()).st_size).decode(errors="replace").splitlines()
    told = [" ".join(line.split()) for line in lines if any(word in line.lower() for word in _TROUBLE)]
    return "; ".join(dict.fromkeys(told[-3:]))


def _flush_c():
    # C's own buffer of stdout is no business of Python's; where it cannot be reached, less is heard.
    try:
        ctypes.CDLL(None).fflush(None)
    except (OSError, TypeError, AttributeError):
        pass


def end_at_once(tidy):
    """Lets Ctrl-C and SIGTERM end the script at once, after `tidy()`.

    Python's own handler waits until a render ends, and the KeyboardInterrupt is then lost in Cycles'
    callbacks. An open Blender window keeps its handlers.
    """
    if not bpy.app.background:
        return
    reader, writer = socket.socketpair()
    writer.setblocking(False)
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: None)
    signal.set_wakeup_fd(writer.fileno())

    def wait():
        received = reader.recv(1)
        if received:
            tidy()
            os._exit(128 + received[0])

    thread = threading.Thread(target=wait, daemon=True)
    thread.start()

    def stop_waiting():
        signal.set_wakeup_fd(-1)
        writer.close()
        thread.join()

    # bpy 4.5 waits for ever at its own end where a thread still runs.
    atexit.register(stop_waiting)


def folder(text):
    """Parses the path of a folder that is there."""
    if not os.path.isdir(text):
        raise argparse.ArgumentTypeError(f"{text} is no folder")
    return text


def file(text):
    """Parses the path of a file that is there."""
    if not os.path.isfile(text):
        raise argparse.ArgumentTypeError(f"{text} is no file")
    return text


def make_folder(path):
    """Makes the folder of --out, or ends the script with a line that says why not."""
    try:
        os.makedirs(path, exist_ok=True)
    except FileExistsError:
        print(f"error: {path} is a file, not a folder (--out)", file=sys.stderr)
        sys.exit(1)
    except OSError as error:
        print(f"error: {path}: {error.strerror} (--out)", file=sys.stderr)
        sys.exit(1)


def reason(error):
    """An exception's message on one line."""
    return " ".join(str(error).split())


def finish(failed):
    """Ends a script with exit code 1 where something failed. An open Blender window stays open."""
    sys.stdout.flush()
    if not inside_blender() and bpy.app.version < (5, 0):
        # bpy 4.5 waits for ever to free the scripted drivers of a file.
        shutil.rmtree(bpy.app.tempdir, ignore_errors=True)
        os._exit(1 if failed else 0)
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


def share(text):
    """Parses a number from 0 to 1."""
    try:
        value = float(text)
    except ValueError:
        value = -1.0
    if not 0.0 <= value <= 1.0:
        raise argparse.ArgumentTypeError(f"{text} is not a number from 0 to 1")
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


def frame_spans(text):
    """Parses `7`, `1-9`, `1-9:4` (or `1-9x4`) and lists of them into (first, last, step) each, the step None
    where none is given; `scene` into None. Negative frames are written `--frames=-5--1`."""
    return None if text == "scene" else [_span(part) for part in text.split(",")]


def _span(text):
    frames, colon, step = text.replace("x", ":").partition(":")
    cut = frames.find("-", 1)
    try:
        first = int(frames if cut < 0 else frames[:cut])
        last = first if cut < 0 else int(frames[cut + 1:])
        step = int(step) if colon else None
    except ValueError:
        raise argparse.ArgumentTypeError(
            f"{text!r} is no list of frames; write 7, 1-9, 1-9:4 or 1,3,7-9, or scene for the scene's own"
        ) from None
    if last < first:
        raise argparse.ArgumentTypeError(f"{text}: the last frame comes before the first")
    if step is not None and step < 1:
        raise argparse.ArgumentTypeError(f"{text}: the step is not a number of at least 1")
    return first, last, step


def file_stem(text):
    """A name that a file can have; anything with a folder in it is none."""
    if not text or text.startswith(".") or any(c in "/\\" or ord(c) < 32 for c in text):
        raise argparse.ArgumentTypeError(f"{text!r} is no file name: leave out folders (they go to --out) and "
                                         "leading dots")
    return text


def names(text):
    """Parses `left,right` into names, in order, without repeats."""
    return list(dict.fromkeys(part.strip() for part in text.split(",") if part.strip()))


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
