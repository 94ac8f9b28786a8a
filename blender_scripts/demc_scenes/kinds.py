"""The kinds of scenes by name: what builds each, and the cameras that suit it."""

import math

from mathutils import Vector

from . import glowing, outside, printed, relief, rooms, studio, views


def _room(stage, mood=None):
    shell = rooms.room(stage, mood)
    return lambda: views.room_camera(stage, shell)


def _relief(stage):
    """Mouldings and boards that are of one colour with their walls, inside or out."""
    if stage.rng.random() < 0.7:
        shell = rooms.room(stage, relief=True)
        return lambda: views.room_camera(stage, shell)
    relief.house(stage)
    outside.sun(stage)

    def camera():
        return views.around_camera(stage, stage.rng.choice(stage.interest), (6, 18), (0.5, 2.5), (20, 45), 0.5)
    return camera


def _sunlit(stage):
    """Sharp shadows, as dense as textures, of which guides know nothing: the sun through blinds and bars, or
    through leaves onto a house."""
    rng = stage.rng
    if rng.random() < 0.85:
        shell = rooms.room(stage, "day", rng.random() < 0.3, sunlit=True)
        return lambda: views.room_camera(stage, shell)
    relief.house(stage)
    toward = outside.sun_lamp(stage, math.radians(rng.uniform(200, 340)), math.radians(rng.uniform(15, 60)))
    outside.environment(stage, outside.DAY, rng.uniform(0.3, 1.2), ("night", "moon"))
    for target in rng.sample(stage.interest, min(len(stage.interest), 4)):
        outside.bush(stage, Vector(target) + toward * rng.uniform(1.5, 6), rng.uniform(0.8, 2.5))

    def camera():
        return views.around_camera(stage, rng.choice(stage.interest), (5, 14), (0.5, 2.5), (20, 50), 0.5)
    return camera


def _table(build):
    return _around(build, (0.6, 1.5), (0.08, 0.8), (32, 70), 0.05)


def _street(stage):
    half = outside.street(stage)

    def camera():
        rng = stage.rng
        target = rng.choice(stage.interest) if stage.interest else (0, 0, 1.5)
        if rng.random() < 0.4:
            return views.around_camera(stage, target, (3, 8), (0.3, 2.0), (24, 50), 0.3)
        center = (rng.uniform(-8, 8), rng.uniform(-half, half), 1.5)
        return views.around_camera(stage, center, (4, 14), (0.0, 2.0), (20, 45), 1.0)
    return camera


def _outdoor(stage):
    outside.outdoor(stage)

    def camera():
        target = stage.rng.choice(stage.interest) if stage.interest else (0, 0, 1.0)
        return views.around_camera(stage, target, (1.5, 8.0), (0.2, 1.8), (24, 50), 0.2)
    return camera


def _many_lights(stage):
    outside.many_lights(stage)

    def camera():
        target = stage.rng.choice(stage.interest)
        return views.around_camera(stage, target, (0.8, 2.4), (0.1, 0.9), (24, 50), 0.1)
    return camera


def _fog(stage):
    """Haze in a room, a street or a garden."""
    rng = stage.rng
    place = rng.choice(("room", "street", "outdoor"))
    if place == "room":
        camera = _room(stage, rng.choice(("day", "dim", "night")))
        outside.add_fog(stage, (8, 9, 3.2), (3, 3.5, 1.65), rng.uniform(0.02, 0.15))
        outside.spots_in_fog(stage, rng.randint(0, 2), 2, 2.3)
    elif place == "street":
        camera = _street(stage)
        outside.add_fog(stage, (60, 24, 14), (0, 0, 7.01), rng.uniform(0.005, 0.05))
    else:
        camera = _outdoor(stage)
        outside.add_fog(stage, (30, 30, 6), (0, 0, 2.5), rng.uniform(0.01, 0.08))
        outside.spots_in_fog(stage, rng.randint(0, 2), 4, 5)
    return camera


def _around(build, radius, height, lens, spread):
    """Cameras on rings around what is worth looking at: (nearest, farthest), heights, lenses."""

    def kind(stage):
        build(stage)

        def camera():
            target = stage.rng.choice(stage.interest) if stage.interest else (0, 0, 0.1)
            return views.around_camera(stage, target, radius, height, lens, spread)

        return camera

    return kind


def _beams(stage):
    """Light that haze makes visible: the sun through a window, lamps of a street, spots over a stage."""
    rng = stage.rng
    way = rng.choice(("window", "window", "street", "stage", "stage"))
    if way == "window":
        shell = rooms.room(stage, "day", sunlit=True)
        rooms.dim(stage, rng.uniform(0.05, 0.3))
        outside.add_fog(
            stage,
            (shell.width + 1, shell.depth + 1, shell.height),
            (shell.width / 2, shell.depth / 2, shell.height / 2),
            rng.uniform(0.01, 0.08),
        )
        return lambda: views.room_camera(stage, shell)
    if way == "street":
        half = outside.street(stage, night=True)
        outside.add_fog(stage, (60, 24, 14), (0, 0, 7.01), rng.uniform(0.01, 0.05))
        return lambda: views.around_camera(
            stage, (rng.uniform(-8, 8), rng.uniform(-half, half), 1.8), (5, 14), (0.0, 2.0), (20, 40), 1.0
        )
    outside.many_lights(stage)
    outside.add_fog(stage, (8, 6, 4), (0, -0.8, 2.0), rng.uniform(0.02, 0.12))
    outside.spots_in_fog(stage, rng.randint(2, 6), 1.6, 3.2, 5.0)
    return lambda: views.around_camera(
        stage, rng.choice(stage.interest), (1.2, 3.2), (0.2, 1.4), (20, 40), 0.2
    )


def _cutout(stage):
    """A transparent film, as for compositing: fur, glass, leaves, figures, and nothing behind them."""
    rng = stage.rng
    stage.backdrop, stage.least_covered, stage.dark = False, 0.2, True
    stage.scene.render.film_transparent = True
    stage.scene.cycles.film_transparent_glass = rng.random() < 0.3
    if rng.random() < 0.35:
        for _ in range(rng.randint(2, 6)):
            at = (rng.gauss(0, 0.6), rng.gauss(0, 0.6), 0.0)
            if rng.random() < 0.6:
                outside.bush(stage, at, rng.uniform(0.3, 1.0), rng.random() < 0.4)
            else:
                outside.tree(stage, at, rng.uniform(1.2, 2.5))
            stage.interest.append(Vector(at) + Vector((0, 0, 0.4)))
        outside.sun(stage)
        return lambda: views.around_camera(
            stage, rng.choice(stage.interest), (1.5, 4), (0.0, 0.8), (30, 60), 0.1
        )
    return _table(rng.choice((studio.hair, studio.hair, studio.glass, studio.studio, studio.skin)))(stage)


def _bokeh(stage):
    """A wide aperture close up: discs of light, and nearly nothing that is sharp."""
    stage.defocus = 1.0
    return stage.rng.choice(
        (_many_lights, _table(studio.studio), _table(studio.glass), _table(glowing.desk), _outdoor)
    )(stage)


def _stars(stage):
    """Points of light smaller than a pixel, over a dark land or in space."""
    stage.dark, stage.least_covered = True, 0.1
    glowing.night_sky(stage)

    def camera():
        rng = stage.rng
        above = Vector((0, 0, rng.uniform(0.3, 1.8)))  # the sky, with the land at its foot
        return views.around_camera(
            stage, rng.choice(stage.interest) + above, (2, 7), (-1.2, 0.3), (24, 50), 0.3
        )

    return camera


def _panorama(stage):
    """All around in one frame, as for a headset or an environment map."""
    place = stage.rng.choice((_room, _room, _street, _outdoor))(stage)

    def camera():
        found = place()
        return found and views.all_around(stage, found)

    return camera


# Name -> (builder, weight). A builder fills the stage and returns a function that places a camera.
KINDS = {
    "room": (_room, 12),
    "relief": (_relief, 6),
    "sunlit": (_sunlit, 4),
    "street": (_street, 2),
    "outdoor": (_outdoor, 3),
    "studio": (_table(studio.studio), 2),
    "materials": (_table(studio.shaderballs), 1),
    "glass": (_table(studio.glass), 2),
    "manylights": (_many_lights, 1),
    "fog": (_fog, 1),
    "hair": (_table(studio.hair), 1),
    "skin": (_table(studio.skin), 1),
    "beams": (_beams, 2),
    "foliage": (_around(outside.thicket, (1.5, 5), (0.0, 1.2), (24, 60), 0.3), 2),
    "print": (_table(printed.desk), 3),
    "screens": (_around(glowing.desk, (0.5, 1.5), (0.05, 0.6), (24, 50), 0.08), 3),
    "glints": (_around(outside.glints, (2, 7), (0.2, 1.5), (28, 60), 0.4), 2),
    "stars": (_stars, 1),
    "cutout": (_cutout, 2),
    "bokeh": (_bokeh, 2),
    "embossed": (_table(studio.embossed), 2),
    "backdrop": (_around(outside.backdrop, (2.5, 8), (-0.2, 0.8), (28, 70), 0.4), 2),
    "pool": (_around(studio.pool, (0.5, 1.3), (0.6, 1.4), (28, 60), 0.1), 2),
    "panorama": (_panorama, 1),
}
