"""Reads the multilayer EXR that Blender writes, and writes a compact one; numpy and zlib alone.

Blender stores data passes as 32-bit floats even in a half file, and offers scripts no way to read
the passes of a render. Training crops are read back here, judged, and stored as half in one part.
Scan lines with no, ZIPS or ZIP compression are understood: what these scripts make Blender write.
"""

import mmap
import os
import struct
import zlib

import numpy as np

_MAGIC = 20000630
_TYPES = {0: np.dtype("<u4"), 1: np.dtype("<f2"), 2: np.dtype("<f4")}
_LINES = {0: 1, 2: 1, 3: 16}
_ZIP = 3
_LEVEL = 6  # of zlib, its own default
MOST_HALF = float(np.finfo(np.float16).max)  # larger values are cut to it where half floats are written


def read(path):
    """Channel name -> (height, width) array, over all parts. A file that was cut off is a ValueError."""
    with open(path, "rb") as file:
        data = file.read()
    channels = {}
    try:
        headers, at, multipart = _headers(path, data)
        for header in headers:
            at = _read_part(data, at, header, multipart, channels)
    except (IndexError, KeyError, struct.error, zlib.error) as error:
        raise ValueError(f"{path}: cut off, or not as Blender writes it ({error})") from error
    return channels


def channel_names(path):
    """The names of the channels of all parts; pixels are not read."""
    with open(path, "rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        headers, _, _ = _headers(path, data)
    return [name for header in headers for name, _ in _channel_list(header["channels"])]


def is_whole(path):
    """Whether a file holds all the scan lines that its headers tell of: one that was cut off does not. Files
    that are compressed as these scripts never do are taken for whole."""
    try:
        with open(path, "rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
            headers, at, multipart = _headers(path, data)
            for header in headers:
                if header["compression"][0] not in _LINES:
                    return True
                for offset in _offsets(data, at, header):
                    offset += 4 if multipart else 0
                    _, size = struct.unpack_from("<ii", data, offset)
                    if offset < at or offset + 8 + size > len(data):
                        return False
                at += 8 * _chunks(header)
    except (ValueError, IndexError, KeyError, struct.error):
        return False
    return True


def text_attribute(path, name):
    """A text in the first header, or None where there is none of that name."""
    with open(path, "rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        headers, _, _ = _headers(path, data)
        raw = headers[0].get(name)
    return None if raw is None else raw.decode(errors="replace")


def add_text_attribute(path, name, text):
    """Adds a text to the first header of a whole file. All else moves down by its length: the tables of
    offsets are the only places that tell where."""
    with open(path, "rb") as file:
        data = file.read()
    headers, tables, _ = _headers(path, data)
    raw = text.encode()
    added = name.encode() + b"\0string\0" + struct.pack("<i", len(raw)) + raw
    count = sum(_chunks(header) for header in headers)
    offsets = struct.unpack_from(f"<{count}Q", data, tables)
    moved = struct.pack(f"<{count}Q", *(offset + len(added) for offset in offsets))
    partial = f"{path}.tmp"
    with open(partial, "wb") as file:
        for piece in (data[:8], added, data[8:tables], moved, data[tables + len(moved):]):
            file.write(piece)
    os.replace(partial, path)


def write_half(path, channels, spp=None):
    """Writes name -> (height, width) arrays as one part of half floats, ZIP, scan lines; whole or not at all.
    `spp` is told as Blender tells it, `cycles.<view layer>.samples`: denoisers treat final frames with more
    care."""
    halves = {name: np.clip(plane, -MOST_HALF, MOST_HALF).astype("<f2") for name, plane in channels.items()}
    layers = {name.split(".")[0] for name in channels} if spp else ()
    _write(path, halves, 1, texts={f"cycles.{layer}.samples": str(spp) for layer in sorted(layers)})


def write_float(path, channels, level=_LEVEL):
    """The same as 32-bit floats, with zlib at this level: 1 takes a third of the time of 6."""
    _write(path, {name: plane.astype("<f4") for name, plane in channels.items()}, 2, level)


def _write(path, channels, kind, level=_LEVEL, texts=None):
    names = sorted(channels)
    planes = [channels[name] for name in names]
    height, width = planes[0].shape
    header = struct.pack("<II", _MAGIC, 2 | (0x400 if max(map(len, names)) > 31 else 0))
    listed = b"".join(n.encode() + b"\0" + struct.pack("<iiii", kind, 0, 1, 1) for n in names) + b"\0"
    box = struct.pack("<iiii", 0, 0, width - 1, height - 1)
    for name, type_, value in (
        ("channels", "chlist", listed), ("compression", "compression", bytes([_ZIP])),
        ("dataWindow", "box2i", box), ("displayWindow", "box2i", box),
        ("lineOrder", "lineOrder", b"\0"), ("pixelAspectRatio", "float", struct.pack("<f", 1.0)),
        ("screenWindowCenter", "v2f", struct.pack("<ff", 0.0, 0.0)),
        ("screenWindowWidth", "float", struct.pack("<f", 1.0)),
        *((name, "string", text.encode()) for name, text in (texts or {}).items()),
    ):
        header += name.encode() + b"\0" + type_.encode() + b"\0" + struct.pack("<i", len(value)) + value
    header += b"\0"
    chunks = []
    for top in range(0, height, _LINES[_ZIP]):
        rows = range(top, min(top + _LINES[_ZIP], height))
        raw = b"".join(plane[y].tobytes() for y in rows for plane in planes)
        packed = _compress(raw, level)
        chunks.append(struct.pack("<ii", top, len(packed)) + packed)
    offset = len(header) + 8 * len(chunks)
    table = b""
    for chunk in chunks:
        table += struct.pack("<Q", offset)
        offset += len(chunk)
    partial = f"{path}.tmp"
    with open(partial, "wb") as file:
        file.write(header + table + b"".join(chunks))
    os.replace(partial, path)


def _text(data, at):
    end = data.find(b"\0", at)
    if end < 0:
        raise ValueError("the file ends within its header")
    return data[at:end].decode(), end + 1


def _headers(path, data):
    """The headers of a file's parts, where their tables of offsets begin, and whether it is multi-part."""
    magic, flags = struct.unpack_from("<II", data)
    if magic != _MAGIC or flags & 0x200:
        raise ValueError(f"{path}: not a scan-line EXR")
    multipart = bool(flags & 0x1000)
    at, headers = 8, []
    while True:
        header, at = _header(data, at)
        if header:
            headers.append(header)
        if not header or not multipart:
            return headers, at, multipart


def _chunks(header):
    """How many blocks of scan lines a part has."""
    _, top, _, bottom = struct.unpack("<iiii", header["dataWindow"])
    return -(-(bottom - top + 1) // _LINES[header["compression"][0]])


def _offsets(data, table, header):
    return struct.unpack_from(f"<{_chunks(header)}Q", data, table)


def _header(data, at):
    """One header as name -> raw value; empty at the end of a list of headers."""
    header = {}
    while data[at]:
        name, at = _text(data, at)
        _, at = _text(data, at)
        (size,) = struct.unpack_from("<i", data, at)
        header[name] = data[at + 4:at + 4 + size]
        at += 4 + size
    return header, at + 1


def _channel_list(raw):
    at, found = 0, []
    while raw[at]:
        name, at = _text(raw, at)
        (kind,) = struct.unpack_from("<i", raw, at)
        found.append((name, _TYPES[kind]))
        at += 16
    return found


def _read_part(data, table, header, multipart, channels):
    """Decodes a part whose chunk offsets stand at `table`; returns where the next table stands."""
    listed = _channel_list(header["channels"])
    left, top, right, bottom = struct.unpack("<iiii", header["dataWindow"])
    width, height = right - left + 1, bottom - top + 1
    compression = header["compression"][0]
    if compression not in _LINES:
        raise ValueError("only uncompressed and ZIP scan lines are read here")
    lines = _LINES[compression]
    out = {name: np.empty((height, width), kind) for name, kind in listed}
    row_bytes = sum(kind.itemsize for _, kind in listed) * width
    for offset in _offsets(data, table, header):
        offset += 4 if multipart else 0
        y, size = struct.unpack_from("<ii", data, offset)
        y -= top
        rows = min(lines, height - y)
        block = data[offset + 8:offset + 8 + size]
        if len(block) < rows * row_bytes:
            block = _decompress(block)
        at = 0
        for row in range(y, y + rows):
            for name, kind in listed:
                out[name][row] = np.frombuffer(block, kind, width, at)
                at += kind.itemsize * width
    part = header.get("name", b"").decode()
    for name, plane in out.items():
        # Blender's parts repeat the part name in the channel names; other writers' may not.
        channels[name if "." in name or not part else f"{part}.{name}"] = plane
    return table + 8 * _chunks(header)


def _decompress(block):
    # All modulo 256, as bytes compute.
    delta = np.frombuffer(zlib.decompress(block), np.uint8).copy()
    delta[1:] += 128
    flat = np.cumsum(delta, dtype=np.uint8)
    half = (len(flat) + 1) // 2
    out = np.empty_like(flat)
    out[0::2], out[1::2] = flat[:half], flat[half:]
    return out.tobytes()


def _compress(raw, level):
    bytes_ = np.frombuffer(raw, np.uint8)
    split = np.concatenate([bytes_[0::2], bytes_[1::2]])
    split[1:] = split[1:] - split[:-1] + 128
    packed = zlib.compress(split.tobytes(), level)
    return packed if len(packed) < len(raw) else raw
