"""Chooses a material for a purpose: from the library where it has one, procedural otherwise."""

from . import materials as m

# Purpose -> (texture kinds, repeats in metres, procedural stand-ins)
_PURPOSES = {
    "floor": (("wood", "tiles", "marble", "stone", "concrete", "rug"), (0.8, 2.5), (m.wood, m.tiles, m.marble)),
    "wall": (("plaster", "brick", "concrete", "wood", "tiles"), (1.0, 3.0), (m.paint, m.paint, m.tiles, m.wood)),
    "furniture": (("wood", "leather", "plastic", "metal", "marble"), (0.4, 1.2), (m.wood, m.plastic, m.metal)),
    "fabric": (("fabric", "rug", "leather", "print"), (0.2, 0.8), (m.fabric,)),
    "rug": (("rug", "fabric", "print"), (0.4, 1.5), (m.fabric,)),
    "metal": (("metal",), (0.3, 1.5), (m.metal,)),
    "road": (("asphalt", "stone", "concrete"), (2.0, 5.0), (m.rough_stone,)),
    "ground": (("ground", "grass", "stone"), (1.5, 4.0), (m.rough_stone,)),
    "facade": (("brick", "concrete", "plaster", "stone"), (1.5, 4.0), (m.rough_stone, m.tiles, m.paint)),
    "stone": (("stone", "marble", "concrete"), (0.5, 2.0), (m.rough_stone, m.marble)),
    "bark": (("bark",), (0.5, 1.0), (m.rough_stone,)),
    "print": (("print",), (0.1, 0.5), (m.fabric, m.tiles)),
}


def choose(rng, library, purpose, procedural=0.25):
    """A material for the purpose."""
    kinds, sizes, stand_ins = _PURPOSES[purpose]
    sets = library.texture_sets(*kinds)
    if not sets or rng.random() < procedural:
        return rng.choice(stand_ins)(rng)
    kind = rng.choice([k for k in kinds if library.texture_sets(k)])  # every kind alike
    return m.from_maps(rng, rng.choice(library.texture_sets(kind)), rng.uniform(*sizes),
                       turn=kind not in ("brick", "plaster"))


def anything(rng, library):
    """A material for an object of no purpose: the whole range of an artist's shelf."""
    roll = rng.random()
    if roll < 0.45:
        return choose(rng, library, rng.choice(("furniture", "fabric", "metal", "stone", "print", "floor")))
    makers = (m.plastic, m.plastic, m.metal, m.glass, m.glass, m.subsurface, m.mirror, m.marble, m.paint)
    return rng.choice(makers)(rng)


def walls(rng, library):
    """Wall materials: painted plaster more often than not."""
    if rng.random() < 0.45:
        return m.paint(rng)
    return choose(rng, library, "wall", 0.1)
