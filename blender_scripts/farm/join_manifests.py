"""Joins what several tasks of generate_scenes.py rendered into one training set.

    python join_manifests.py SET

Each task has a folder of its own below SET (generate_scenes.py --out SET/0007 ...). Writes SET/manifest.csv,
which `demc train --data SET/manifest.csv` reads, SET/views.csv, so that generate_scenes.py --check checks all
files, and SET/rejected.csv. May be run again as more tasks end. Needs no bpy.
"""

import argparse
import csv
import glob
import os
import sys

# File -> the columns that hold paths relative to it, and the one that no two rows may share.
_TABLES = {
    "manifest.csv": (("noisy", "reference"), "noisy"),
    "views.csv": (("file",), "file"),
    "rejected.csv": ((), "scene"),
}


def rows_of(path):
    """The header and rows of a table; the line that a kill cut off is left out, even where it is the header."""
    with open(path, encoding="utf-8", newline="") as file:
        lines = file.read().splitlines(keepends=True)
    if lines and not lines[-1].endswith("\n"):
        lines.pop()
    if not lines:
        return None, []
    header, *rows = csv.reader(lines)
    return header, [dict(zip(header, row)) for row in rows if len(row) == len(header)]


def join(folder, name):
    """Joins the tables of one name; returns how many rows, or None where no task has one."""
    paths, unique = _TABLES[name]
    header, joined = None, {}
    for table in sorted(glob.glob(os.path.join(glob.escape(folder), "*", name))):
        part = os.path.basename(os.path.dirname(table))
        own, rows = rows_of(table)
        if own is None:
            print(f"note: {table} holds nothing yet; join again when its task has ended", file=sys.stderr)
            continue
        lacking = [column for column in (*paths, unique) if column not in own]
        if lacking:
            raise ValueError(f"{table} has no column {lacking[0]}: it is no table of generate_scenes.py")
        if header not in (None, own):
            raise ValueError(f"{table} has other columns than the rest: it is of another version of generate_scenes.py")
        header = own
        for row in rows:
            # The name alone, without its folder: it is the seed's, and of a seed there may be one.
            key = row[unique]
            for column in paths:
                row[column] = f"{part}/{row[column]}"
            other = joined.setdefault(key, row)
            if other is not row and other[unique] != row[unique]:
                raise ValueError(f"{other[unique]} and {row[unique]} are of one seed: give every task seeds of its own")
            joined[key] = row  # of rows for one file the last holds
    if header is None:
        return None
    partial = os.path.join(folder, f".{name}.{os.getpid()}.tmp")
    with open(partial, "w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, header, lineterminator="\n")
        writer.writeheader()
        writer.writerows(joined.values())
    os.replace(partial, os.path.join(folder, name))
    return len(joined)


def main():
    """Entry point of the script."""
    parser = argparse.ArgumentParser(description="Join what several tasks of generate_scenes.py rendered.")
    parser.add_argument("folder", metavar="SET", help="the folder that holds the tasks' folders")
    folder = parser.parse_args().folder
    try:
        counts = {name: join(folder, name) for name in _TABLES}
    except (ValueError, OSError) as error:
        sys.exit(f"error: {error}")
    if counts["manifest.csv"] is None:
        sys.exit(f"error: {folder} holds no folder with a manifest.csv of generate_scenes.py")
    print(f"{os.path.join(folder, 'manifest.csv')}: {counts['manifest.csv']} pairs")


if __name__ == "__main__":
    main()
