"""Reads and writes manifests of pairs as demc does: CSV with the header scene,noisy,reference,spp and paths
relative to the manifest."""

import csv
import os

HEADER = ("scene", "noisy", "reference", "spp")


def read(path):
    """The rows of a manifest, a dictionary each, with paths as seen from the working directory.

    Lines that begin with # are comments.
    """
    folder = os.path.dirname(path)
    with open(path, encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader((line for line in file if not line.startswith("#")), skipinitialspace=True))
    for row in rows:
        for column in ("noisy", "reference"):
            row[column] = os.path.join(folder, row[column])
    return rows


def write(path, rows):
    """Writes (scene, noisy, reference, spp) rows, whose paths are as seen from the working directory."""
    folder = os.path.dirname(path) or "."
    rows = [(scene, relative(noisy, folder), relative(reference, folder), spp) for scene, noisy, reference, spp in rows]
    with open(path, "w", encoding="utf-8", newline="") as file:
        csv.writer(file, lineterminator="\n").writerows([HEADER, *rows])


def relative(path, folder):
    """A file's path relative to a folder.

    Links to folders are resolved first, since `..` behind a link leads elsewhere; the file keeps its name.
    """
    place, name = os.path.split(path)
    return os.path.normpath(os.path.join(os.path.relpath(os.path.realpath(place), os.path.realpath(folder)), name))
