"""The folders given by --assets: models, texture sets, environments and pictures.

Layout of each: models/*.glb (metres, standing on z = 0), textures/NAME/{color,normal,rough,metal}.*,
hdri/*.exr|hdr, pictures/*.jpg|png; models.tsv and images.tsv tell categories and are optional:
without them the file name decides. Without a folder every list is empty, and callers fall back to
procedural content.
"""

import csv
import os

TEXTURE_SIDE = 512  # pixels of an imported texture, at most
_IMAGES = (".jpg", ".jpeg", ".png", ".exr", ".hdr", ".tif", ".tiff")
# What a model is used for, by words in its name; the first match wins.
_ROLES = (
    ("prop", ("tableware", "portrait", "fan", "chess")),
    ("ceiling", ("chandelier", "pendant")),
    ("lamp", ("lamp", "candle")),
    ("sofa", ("sofa", "couch")),
    ("chair", ("chair", "stool")),
    ("table", ("table", "desk")),
    ("bed", ("bed",)),
    ("wall", ("cabinet", "wardrobe", "shelf", "nightstand", "rack", "refrigerator", "fridge", "oven",
              "washing", "fireplace", "sink", "toilet", "bathtub", "cooktop", "dresser")),
    ("opening", ("curtain", "door", "window")),
)


class Model:
    """One model file: its name, path, category and largest dimension in metres (0 if unknown)."""

    def __init__(self, name, path, category, size):
        self.name, self.path, self.category, self.size = name, path, category, size
        self.role = _role(name, category)


def _role(name, category):
    plain = name.lower()
    if category in ("plant", "vehicle", "building", "figure", "nature"):
        return category
    for role, words in _ROLES:
        if any(word in plain for word in words):
            return role
    return "prop" if category != "furniture" else "wall"


class Library:
    """What the assets folders hold; empty lists without a folder. Names are sorted, so a seed picks
    the same thing on every machine."""

    def __init__(self, folders=()):
        self.models, self.textures, self.environments, self.pictures = [], {}, [], []
        self._indexed = {}  # name -> row of models.tsv or images.tsv
        for folder in folders:
            self._read(folder)

    def _read(self, folder):
        rows = _table(os.path.join(folder, "models.tsv"))
        images = _table(os.path.join(folder, "images.tsv"))
        self._indexed |= rows | images
        for name, path in _files(os.path.join(folder, "models"), (".glb", ".gltf")):
            row = rows.get(name, {})
            self.models.append(Model(name, path, row.get("category", ""), _number(row.get("size_m"))))
        kinds = {name: row.get("kind", "") for name, row in images.items()}
        self._read_textures(os.path.join(folder, "textures"), kinds)
        for name, path in _files(os.path.join(folder, "hdri"), (".exr", ".hdr")):
            self.environments.append((path, f"{name} {kinds.get(name, '')}".lower()))
        self.pictures += [path for _, path in _files(os.path.join(folder, "pictures"), _IMAGES)]

    def _read_textures(self, folder, kinds):
        for name in sorted(os.listdir(folder)) if os.path.isdir(folder) else []:
            maps = dict(_files(os.path.join(folder, name), _IMAGES))
            if "color" in maps:
                kind = kinds.get(name) or name.split("_")[0]
                self.textures.setdefault(kind, []).append(maps)

    def credit(self, path):
        """(name, author, licence) of the asset that a file belongs to, None for files that are none."""
        parts = os.path.normpath(path).split(os.sep)
        name = parts[-2] if parts[-3:-2] == ["textures"] else os.path.splitext(parts[-1])[0]
        row = self._indexed.get(name)
        return row and (name, row.get("author", ""), row.get("licence", ""))

    def with_role(self, *roles, smallest=0.0, largest=1e9):
        """Models of these roles whose size lies in a range (unknown sizes pass)."""
        return [m for m in self.models if m.role in roles and (m.size == 0 or smallest <= m.size <= largest)]

    def environments_like(self, *words, without=()):
        """Environments whose name or description holds one of the words; all without a match."""
        fit = [p for p, text in self.environments
               if any(w in text for w in words) and not any(w in text for w in without)]
        return fit or [p for p, _ in self.environments]

    def texture_sets(self, *kinds):
        """Texture sets of these kinds."""
        return [maps for kind in kinds for maps in self.textures.get(kind, [])]


def shrink(image):
    """Scales a Blender image down to the size of textures, where it is larger."""
    side = max(image.size)
    if side > TEXTURE_SIDE:
        image.scale(*(max(1, s * TEXTURE_SIDE // side) for s in image.size))


def _files(folder, endings):
    if not os.path.isdir(folder):
        return []
    return [(os.path.splitext(f)[0], os.path.join(folder, f)) for f in sorted(os.listdir(folder))
            if f.lower().endswith(endings)]


def _table(path):
    if not os.path.isfile(path):
        return {}
    with open(path, encoding="utf-8", newline="") as file:
        return {row["name"]: row for row in csv.DictReader(file, delimiter="\t", quoting=csv.QUOTE_NONE)}


def _number(text):
    try:
        return float(text)
    except (TypeError, ValueError):
        return 0.0
