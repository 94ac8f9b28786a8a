"""The table of what was rendered into a folder: one row a file, with its seeds, its cost and its SHA-256.

A file counts as done once its row is there, which is written last: a killed run leaves at most a file
without a row, and the next run makes it again.
"""

import contextlib
import csv
import hashlib
import io
import os

NAME = "views.csv"
COLUMNS = (
    "view",
    "kind",
    "seed",
    "camera",
    "frame",
    "filter",
    "file",
    "spp",
    "noise_seed",
    "seconds",
    "noise",
    "sha256",
    "pattern",
)


def whole_lines(path):
    """The lines of a table, none where there is no table. One that a kill or a full disk cut off is left out."""
    with contextlib.suppress(FileNotFoundError), open(path, encoding="utf-8", newline="") as file:
        return [line for line in file if line.endswith("\n")]
    return []


def append(path, header, rows):
    """Adds rows to a table, all or none, in place of a line that was cut off; begins it with its header."""
    with open(path, "a+b") as file:
        file.seek(0)
        end = file.read().rfind(b"\n") + 1
        file.truncate(end)
        text = io.StringIO(newline="")
        csv.writer(text, lineterminator="\n").writerows([*([] if end else [header]), *rows])
        try:
            file.write(text.getvalue().encode())
            file.flush()
        except OSError:
            file.truncate(end)
            raise


class Ledger:
    """The folder's table. `seconds` are those of all processors together, `noise` is a reference's own, `pattern` that of
    samples where it is not Cycles' classic one."""

    def __init__(self, folder):
        self.folder, self.path = folder, os.path.join(folder, NAME)

    def rows(self):
        """File name -> its latest row."""
        return {row["file"]: row for row in csv.DictReader(whole_lines(self.path))}

    def missing(self, name):
        """Whether a file is still to be rendered: not there, or without its row."""
        return not os.path.exists(os.path.join(self.folder, name)) or name not in self.rows()

    def add(self, **row):
        """Adds a row for a file that is there; columns that are not named stay empty."""
        row["sha256"] = _sha256(os.path.join(self.folder, row["file"]))
        append(self.path, COLUMNS, [[row.get(column, "") for column in COLUMNS]])

    def write_manifest(self, pairs):
        """Replaces manifest.csv by these pairs: scene, noisy file, reference, samples."""
        partial = os.path.join(self.folder, "manifest.tmp")
        with open(partial, "w", encoding="utf-8", newline="") as file:
            csv.writer(file, lineterminator="\n").writerows([("scene", "noisy", "reference", "spp"), *pairs])
        os.replace(partial, os.path.join(self.folder, "manifest.csv"))

    def check(self):
        """Compares the files with their hashes; prints a line for each that is missing or differs, and
        returns how many those are."""
        rows, bad = self.rows(), 0
        if not rows:
            print(f"{self.path}: is missing or empty, so nothing tells what the folder should hold")
            return 1
        for name, row in rows.items():
            path = os.path.join(self.folder, name)
            wrong = (
                "is missing"
                if not os.path.exists(path)
                else f"is not what {NAME} lists" if _sha256(path) != row["sha256"] else ""
            )
            if wrong:
                bad += 1
                print(f"{path}: {wrong}; delete it and render again")
        print(f"{len(rows) - bad} of {len(rows)} files are as listed")
        return bad


def _sha256(path):
    with open(path, "rb") as file:
        return hashlib.sha256(file.read()).hexdigest()
