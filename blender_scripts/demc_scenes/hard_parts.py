"""What the small scenes of `hard` have in common: plain materials, floors, lamps, haze and a still life.

The other builders of this package draw everything at random. Here all is fixed, as a case and its control
must differ in nothing but the trouble.
"""

import math

from . import materials as m
from . import shapes
from .stage import darkness

GREY = (0.5, 0.5, 0.5)
RED, GREEN, BLUE = (0.6, 0.12, 0.08), (0.12, 0.4, 0.1), (0.1, 0.2, 0.55)


def matt(tint, **inputs):
    """One colour that scatters evenly."""
    return m.Nodes("matt").principled(Base_Color=tint, Roughness=0.8, Specular_IOR_Level=0.2, **inputs)


def glow(strength, tint=(1, 1, 1)):
    """An emitter of one colour."""
    n = m.Nodes("glow")
    return n.finish(n.shader("ShaderNodeEmission", Color=tint, Strength=strength))


def glass(roughness=0.0):
    """Clear glass."""
    n = m.Nodes("glass")
    return n.finish(n.shader("ShaderNodeBsdfGlass", Color=(1, 1, 1), Roughness=roughness, IOR=1.45))


def squares(n, size, first, second):
    """The colour of a chequerboard whose squares are `size` metres wide."""
    node = n.new("ShaderNodeTexChecker")
    n.set(node.inputs["Vector"], n.uv(size))
    for name, value in (("Scale", 1.0), ("Color1", first), ("Color2", second)):
        n.set(node.inputs[name], value)
    return node.outputs["Color"]


def checker(size, first=(0.75, 0.72, 0.65), second=(0.12, 0.14, 0.2), roughness=0.8):
    """A matt chequerboard."""
    n = m.Nodes("checker")
    return n.principled(Base_Color=squares(n, size, first, second), Roughness=roughness)


def grained(scale=60.0):
    """A fine texture without edges, as of stone."""
    n = m.Nodes("grained")
    grain = n.noise(n.place(1.0), scale, 6, 0.7)
    tone = n.ramp(grain, (0.4, (0.15, 0.1, 0.07)), (0.6, (0.8, 0.72, 0.6)))
    return n.principled(Base_Color=tone, Roughness=0.8)


def floor(stage, material):
    """The ground, its top at height 0."""
    return stage.add(shapes.box((16, 16, 0.1), 0, (0, 0, -0.05)), material)


def wall(stage, material, y=2.0):
    """A wall across the view, its face at `y`."""
    return stage.add(shapes.box((16, 0.1, 8), 0, (0, 0.05, 4)), material, (0, y, 0))


def world(stage, level, tint=(1, 1, 1)):
    """Even light from everywhere."""
    darkness(stage, level)
    nodes = stage.scene.world.node_tree.nodes
    background = next(node for node in nodes if node.bl_idname == "ShaderNodeBackground")
    background.inputs["Color"].default_value = (*tint, 1.0)


def softbox(stage, energy, at=(1.8, -1.8, 2.6), size=0.7, aim=(0, 0, 0.3)):
    """A square lamp that the camera does not see."""
    lamp = stage.lamp("AREA", at, energy, aim=aim, size=size)
    lamp.visible_camera = False
    return lamp


def sun(stage, strength, azimuth, height, angle=0.5):
    """A sun; all angles in degrees, the last its width."""
    azimuth, height = math.radians(azimuth), math.radians(height)
    toward = (
        math.cos(azimuth) * math.cos(height),
        math.sin(azimuth) * math.cos(height),
        math.sin(height),
    )
    return stage.lamp("SUN", toward, strength, aim=(0, 0, 0), angle=math.radians(angle))


def haze(stage, size, center, density):
    """A box of even haze."""
    n = m.Nodes("haze")
    volume = n.shader("ShaderNodeVolumePrincipled", Color=(0.9, 0.92, 0.95), Density=density, Anisotropy=0.3)
    n.set(n.output.inputs["Volume"], volume)
    stage.add(shapes.box(size, 0, center), n.material)


def view(stage, at=(0, -3.2, 1.3), target=(0, 0, 0.42), lens=40):
    """The camera."""
    return stage.camera(at, target, lens)


def still_life(stage, light=1.0):
    """A ball, a carton, a ring and a head on a chequered floor: a scene without any trouble."""
    floor(stage, checker(0.3))
    wall(stage, matt((0.55, 0.5, 0.42)), 1.5)
    stage.add(shapes.sphere(0.35, 5), matt(RED), (-0.75, 0.1, 0))
    stage.add(shapes.box((0.5, 0.5, 0.6), 0.02, (0, 0, 0.3)), grained(), (0.1, 0.4, 0), 0.5)
    stage.add(shapes.torus(0.22, 0.08), matt(BLUE), (0.1, -0.5, 0), 0.3)
    stage.add(shapes.monkey(0.7), matt(GREEN), (0.95, 0.1, 0), -0.4)
    softbox(stage, 60 * light)
    world(stage, 0.25 * light)
    view(stage)
