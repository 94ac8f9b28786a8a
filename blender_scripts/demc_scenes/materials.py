"""Materials: texture sets from the library, procedural surfaces, glass, metal, skin, light.

Every function takes the seeded `random.Random` and returns a `bpy.types.Material`. Image and
procedural textures read the mesh's UVs, which the shapes of this package lay out in metres.
"""

import bpy


class Nodes:
    """A node tree under construction, from an empty material."""

    def __init__(self, name):
        self.material = bpy.data.materials.new(name)
        if self.material.node_tree is None:  # before Blender 5
            self.material.use_nodes = True
        self.tree = self.material.node_tree
        self.tree.nodes.clear()
        self.output = self.new("ShaderNodeOutputMaterial")

    @classmethod
    def on(cls, tree):
        """More nodes for a tree that exists."""
        nodes = cls.__new__(cls)
        nodes.tree = tree
        return nodes

    def new(self, kind, **properties):
        """A node of this kind; keywords set its properties."""
        node = self.tree.nodes.new(kind)
        for name, value in properties.items():
            setattr(node, name, value)
        return node

    def set(self, socket, value):
        """Links a socket's input to another socket, or sets a constant (a grey for a colour)."""
        if isinstance(value, bpy.types.NodeSocket):
            self.tree.links.new(value, socket)
        elif socket.type == "RGBA":
            value = (value,) * 3 if isinstance(value, (int, float)) else value
            socket.default_value = (*value[:3], 1.0)
        else:
            socket.default_value = value

    def shader(self, kind, **inputs):
        """A node whose inputs are set by name, with _ for a space; returns its first output."""
        node = self.new(kind)
        for name, value in inputs.items():
            self.set(node.inputs[name.replace("_", " ")], value)
        return node.outputs[0]

    def math(self, operation, a, b=0.0, clamp=False):
        node = self.new("ShaderNodeMath", operation=operation, use_clamp=clamp)
        self.set(node.inputs[0], a)
        self.set(node.inputs[1], b)
        return node.outputs[0]

    def mix(self, factor, a, b, blend="MIX"):
        """Mixes two colours."""
        node = self.new("ShaderNodeMix", data_type="RGBA", blend_type=blend)
        self.set(node.inputs[0], factor)
        self.set(node.inputs[6], a)
        self.set(node.inputs[7], b)
        return node.outputs[2]

    def ramp(self, factor, *stops):
        """A colour ramp through (position, colour) stops."""
        node = self.new("ShaderNodeValToRGB")
        self.set(node.inputs[0], factor)
        elements = node.color_ramp.elements
        while len(elements) < len(stops):
            elements.new(0.5)
        for element, (position, color) in zip(elements, stops):
            color = (color,) * 3 if isinstance(color, (int, float)) else color
            element.position, element.color = position, (*color, 1.0)
        return node.outputs[0]

    def uv(self, scale=1.0, turn=0.0, offset=(0.0, 0.0)):
        """UV in units of `scale` metres."""
        node = self.new("ShaderNodeMapping")
        self.set(node.inputs["Vector"], self.new("ShaderNodeUVMap").outputs[0])
        scale = scale if isinstance(scale, tuple) else (scale, scale)
        node.inputs["Scale"].default_value = (1 / scale[0], 1 / scale[1], 1)
        node.inputs["Rotation"].default_value = (0, 0, turn)
        node.inputs["Location"].default_value = (*offset, 0)
        return node.outputs[0]

    def place(self, scale=1.0):
        """Object coordinates in units of `scale` metres: solid textures."""
        node = self.new("ShaderNodeMapping")
        self.set(node.inputs["Vector"], self.new("ShaderNodeTexCoord").outputs["Object"])
        node.inputs["Scale"].default_value = (1 / scale,) * 3
        return node.outputs[0]

    def noise(self, vector, scale=5.0, detail=4.0, roughness=0.55, distortion=0.0):
        return self.shader("ShaderNodeTexNoise", Vector=vector, Scale=scale, Detail=detail,
                           Roughness=roughness, Distortion=distortion)

    def bump(self, height, strength, distance=0.01, normal=None):
        node = self.new("ShaderNodeBump")
        node.inputs["Strength"].default_value = strength
        node.inputs["Distance"].default_value = distance
        self.set(node.inputs["Height"], height)
        if normal:
            self.set(node.inputs["Normal"], normal)
        return node.outputs[0]

    def finish(self, closure):
        self.set(self.output.inputs["Surface"], closure)
        return self.material

    def principled(self, **inputs):
        return self.finish(self.shader("ShaderNodeBsdfPrincipled", **inputs))


def color(rng, saturation=(0.1, 0.7), value=(0.1, 0.8)):
    """A random linear colour; surfaces in a home are seldom saturated."""
    import colorsys
    return colorsys.hsv_to_rgb(rng.random(), rng.uniform(*saturation), rng.uniform(*value) ** 1.5)


def paint(rng, value=(0.4, 0.95), saturation=(0.0, 0.25)):
    """Painted plaster: almost flat, faint bump."""
    n = Nodes("paint")
    noise = n.noise(n.place(1.0), rng.uniform(20, 120), 5)
    tint = color(rng, saturation, value)
    return n.principled(Base_Color=n.mix(n.math("MULTIPLY", noise, 0.15), tint, (0.5, 0.5, 0.5)),
                        Roughness=rng.uniform(0.4, 0.9), Normal=n.bump(noise, rng.uniform(0, 0.15), 0.005))


def plastic(rng):
    """Plastic or lacquer, sometimes coated, sometimes worn by fingerprints."""
    n = Nodes("plastic")
    smudge = n.noise(n.place(1.0), rng.uniform(5, 40), 6, 0.6)
    low = rng.uniform(0.03, 0.5)
    return n.principled(Base_Color=color(rng, (0.0, 0.9), (0.05, 0.9)),
                        Roughness=n.math("ADD", low, n.math("MULTIPLY", smudge, rng.uniform(0, 0.3))),
                        Coat_Weight=rng.choice((0.0, 0.0, 1.0)), Coat_Roughness=rng.uniform(0, 0.2))


def metal(rng):
    """Polished, brushed or scratched metal of a common colour."""
    n = Nodes("metal")
    base = rng.choice(((0.9, 0.9, 0.9), (0.95, 0.75, 0.35), (0.9, 0.5, 0.35), (0.55, 0.55, 0.57),
                       (0.3, 0.29, 0.28), color(rng, (0.3, 0.9), (0.4, 0.9))))
    rough = rng.choice((rng.uniform(0.0, 0.08), rng.uniform(0.08, 0.3), rng.uniform(0.3, 0.5)))
    grain = n.noise(n.uv((rng.uniform(0.2, 1.0), 0.01)), 5.0, 3)
    scratch = n.noise(n.place(1.0), rng.uniform(30, 200), 8, 0.7)
    pattern = rng.choice((grain, scratch))
    return n.principled(Base_Color=base, Metallic=1.0,
                        Roughness=n.math("ADD", rough, n.math("MULTIPLY", pattern, rng.uniform(0, 0.25))),
                        Anisotropic=rng.choice((0.0, 0.0, 0.7)),
                        Normal=n.bump(pattern, rng.uniform(0, 0.1), 0.002))


def glass(rng, clear=False):
    """Clear, tinted or rough glass."""
    n = Nodes("glass")
    tint = (1, 1, 1) if clear or rng.random() < 0.5 else color(rng, (0.1, 0.8), (0.8, 1.0))
    rough = 0.0 if clear or rng.random() < 0.6 else rng.uniform(0.02, 0.5)
    extra = {}
    if not clear and rng.random() < 0.25:
        extra["Normal"] = n.bump(n.noise(n.place(1.0), rng.uniform(10, 60), 2), rng.uniform(0.05, 0.4))
    return n.finish(n.shader("ShaderNodeBsdfGlass", Color=tint, Roughness=rough,
                             IOR=rng.uniform(1.3, 1.6), **extra))


def pane(rng):
    """Window glass that lets shadow rays through, as artists build it; seen directly it reflects."""
    n = Nodes("pane")
    path = n.new("ShaderNodeLightPath")
    mix = n.new("ShaderNodeMixShader")
    n.set(mix.inputs[0], n.math("MAXIMUM", path.outputs["Is Shadow Ray"], path.outputs["Is Diffuse Ray"]))
    n.set(mix.inputs[1], n.shader("ShaderNodeBsdfGlass", Color=(0.95, 0.98, 0.96), Roughness=0.0, IOR=1.05))
    n.set(mix.inputs[2], n.shader("ShaderNodeBsdfTransparent", Color=(0.95, 0.97, 0.96)))
    return n.finish(mix.outputs[0])


def mirror(rng):
    """A mirror, sometimes dusty."""
    n = Nodes("mirror")
    dust = n.ramp(n.noise(n.place(1.0), rng.uniform(2, 10), 8), (0.5, 0.0), (0.9, rng.choice((0.0, 0.3))))
    return n.principled(Base_Color=(0.92, 0.92, 0.92), Metallic=1.0, Roughness=dust)


def light(rng, strength, tint=None):
    """An emitter; warm, neutral or cold without a tint."""
    n = Nodes("light")
    tint = tint or rng.choice(((1, 0.6, 0.3), (1, 0.8, 0.6), (1, 0.95, 0.9), (0.8, 0.9, 1.0)))
    return n.finish(n.shader("ShaderNodeEmission", Color=tint, Strength=strength))


def translucent(rng, tint=None):
    """Thin cloth or paper that light passes: curtains, lamp shades."""
    n = Nodes("translucent")
    tint = tint or color(rng, (0.0, 0.4), (0.5, 0.95))
    weave = n.noise(n.uv((0.02, 0.004)), 3.0, 2)
    tint = n.mix(n.math("MULTIPLY", weave, 0.3), tint, (0.3, 0.25, 0.2))
    mix = n.new("ShaderNodeMixShader")
    mix.inputs[0].default_value = rng.uniform(0.2, 0.6)
    n.set(mix.inputs[1], n.shader("ShaderNodeBsdfDiffuse", Color=tint))
    n.set(mix.inputs[2], n.shader("ShaderNodeBsdfTranslucent", Color=tint))
    return n.finish(mix.outputs[0])


def subsurface(rng, skin=False):
    """Skin, wax, milk, marble, jade."""
    n = Nodes("subsurface")
    if skin:
        tone = rng.uniform(0.15, 1.0)
        base, radius, scale = (0.8 * tone, 0.5 * tone, 0.38 * tone), (1.0, 0.35, 0.15), rng.uniform(0.005, 0.03)
    else:
        base, radius, scale = color(rng, (0.0, 0.6), (0.5, 1.0)), (1.0, rng.uniform(0.3, 1), rng.uniform(0.2, 1)), rng.uniform(0.01, 0.1)
    pores = n.shader("ShaderNodeTexVoronoi", Vector=n.place(1.0), Scale=rng.uniform(100, 400))
    blotch = n.noise(n.place(1.0), rng.uniform(4, 20), 6)
    return n.principled(
        Base_Color=n.mix(n.math("MULTIPLY", blotch, 0.4), base, tuple(c * 0.7 for c in base)),
        Subsurface_Weight=rng.uniform(0.5, 1.0), Subsurface_Radius=radius, Subsurface_Scale=scale,
        Roughness=n.math("ADD", rng.uniform(0.1, 0.4), n.math("MULTIPLY", blotch, 0.2)),
        Normal=n.bump(pores, rng.uniform(0.02, 0.2), 0.002))


def wood(rng):
    """Procedural planks with grain."""
    n = Nodes("wood")
    width = rng.uniform(0.06, 0.25)
    brick = n.new("ShaderNodeTexBrick", offset=rng.uniform(0.2, 0.5))
    n.set(brick.inputs["Vector"], n.uv(1.0))
    for name, value in (("Scale", 1.0), ("Mortar Size", rng.uniform(0.001, 0.003)), ("Brick Width", rng.uniform(0.6, 2.0)),
                        ("Row Height", width), ("Color1", 0.0), ("Color2", 1.0), ("Mortar", 0.5)):
        n.set(brick.inputs[name], value)
    grain = n.noise(n.uv((0.6, 0.02), offset=(rng.random(), 0)), rng.uniform(2, 6), 8, 0.65, rng.uniform(0, 2))
    dark = color_of_wood(rng)
    tone = n.mix(grain, dark, tuple(min(c * rng.uniform(1.5, 2.6), 0.9) for c in dark))
    tone = n.mix(n.math("MULTIPLY", brick.outputs[0], 0.35), tone, tuple(c * 0.5 for c in dark))
    tone = n.mix(brick.outputs[1], tone, tuple(c * 0.2 for c in dark))
    gap = n.math("SUBTRACT", n.math("MULTIPLY", grain, 0.2), brick.outputs[1])
    return n.principled(Base_Color=tone, Normal=n.bump(gap, 0.3, 0.004),
                        Roughness=n.math("ADD", rng.uniform(0.1, 0.5), n.math("MULTIPLY", grain, 0.2)),
                        Coat_Weight=rng.choice((0, 0, 0.6)), Coat_Roughness=0.1)


def color_of_wood(rng):
    """From pale birch to dark walnut."""
    return rng.choice(((0.35, 0.2, 0.1), (0.2, 0.09, 0.04), (0.08, 0.04, 0.02), (0.45, 0.33, 0.2), (0.25, 0.17, 0.12)))


def tiles(rng):
    """Glazed tiles with grout, each of its own shade, or a two-colour pattern."""
    n = Nodes("tiles")
    side = rng.choice((0.05, 0.1, 0.2, 0.4))
    brick = n.new("ShaderNodeTexBrick", offset=rng.choice((0.0, 0.5)))
    n.set(brick.inputs["Vector"], n.uv(1.0))
    first = color(rng, (0.0, 0.6), (0.2, 0.95))
    second = rng.choice((tuple(c * 0.8 for c in first), color(rng)))
    for name, value in (("Scale", 1.0), ("Mortar Size", side * 0.02), ("Mortar Smooth", 0.3), ("Brick Width", side * rng.choice((1, 2))),
                        ("Row Height", side), ("Color1", first), ("Color2", second), ("Mortar", rng.uniform(0.1, 0.7))):
        n.set(brick.inputs[name], value)
    rough = rng.uniform(0.03, 0.4)
    return n.principled(Base_Color=brick.outputs[0], Normal=n.bump(n.math("SUBTRACT", 1.0, brick.outputs[1]), 0.4, 0.003),
                        Roughness=n.math("MAXIMUM", rough, n.math("MULTIPLY", brick.outputs[1], 0.8)))


def marble(rng):
    """Veined stone, polished."""
    n = Nodes("marble")
    vein = n.noise(n.place(rng.uniform(0.2, 1.0)), 3.0, 10, 0.65, rng.uniform(1, 4))
    light_, dark = color(rng, (0, 0.2), (0.6, 0.95)), color(rng, (0, 0.4), (0.05, 0.4))
    return n.principled(Base_Color=n.ramp(vein, (0.35, light_), (0.5, dark), (0.56, light_)), Roughness=rng.uniform(0.02, 0.3))


def fabric(rng):
    """Woven cloth with a pattern and sheen."""
    n = Nodes("fabric")
    size = rng.uniform(0.002, 0.01)
    wave = n.new("ShaderNodeTexChecker")
    n.set(wave.inputs["Vector"], n.uv(size))
    n.set(wave.inputs["Scale"], 1.0)
    base, other = color(rng, (0, 0.8), (0.1, 0.8)), color(rng, (0, 0.8), (0.1, 0.8))
    stripes = n.shader("ShaderNodeTexWave", Vector=n.uv(rng.uniform(0.05, 0.4), rng.choice((0, 0.78, 1.57))), Scale=1.0)
    tint = n.mix(n.ramp(stripes, (0.45, 0.0), (0.5, rng.choice((0.0, 1.0)))), base, other)
    tint = n.mix(n.math("MULTIPLY", wave.outputs[1], 0.25), tint, tuple(c * 0.4 for c in base))
    return n.principled(Base_Color=tint, Roughness=0.9, Sheen_Weight=rng.uniform(0, 0.6), Normal=n.bump(wave.outputs[1], 0.3, size))


def rough_stone(rng):
    """Concrete or rock."""
    n = Nodes("stone")
    grain = n.noise(n.place(1.0), rng.uniform(3, 15), 12, 0.7)
    pits = n.shader("ShaderNodeTexVoronoi", Vector=n.place(1.0), Scale=rng.uniform(10, 60))
    base = color(rng, (0, 0.2), (0.3, 0.8))
    return n.principled(Base_Color=n.ramp(grain, (0.3, tuple(c * 0.4 for c in base)), (0.7, base)), Roughness=rng.uniform(0.6, 1.0),
                        Normal=n.bump(n.math("ADD", grain, n.math("MULTIPLY", pits, 0.3)), rng.uniform(0.2, 0.8), 0.02))


def from_maps(rng, maps, size, alpha=False, turn=True):
    """A texture set as a material: `size` metres a repeat, with dirt, tint and gloss of its own."""
    n = Nodes("textured")
    vector = n.uv(size, rng.choice((0.0, 1.5708)) if turn and not alpha else 0.0, (rng.random(), rng.random()) if not alpha else (0, 0))
    base = image(n, maps["color"], vector)
    tint = n.mix(rng.uniform(0, 0.35), base.outputs[0], color(rng, (0.0, 0.5), (0.3, 1.0)), "MULTIPLY")
    if not alpha and rng.random() < 0.4:
        dirt = n.ramp(n.noise(n.place(1.0), rng.uniform(1, 6), 8, 0.65), (0.45, 0.0), (0.75, rng.uniform(0.2, 0.7)))
        tint = n.mix(dirt, tint, (0.08, 0.06, 0.045))
    inputs = {"Base_Color": tint, "Roughness": rng.uniform(0.25, 0.8)}
    if "rough" in maps:
        rough = image(n, maps["rough"], vector, data=True).outputs[0]
        inputs["Roughness"] = n.math("MULTIPLY", rough, rng.uniform(0.4, 1.2), clamp=True)
    if "metal" in maps:
        inputs["Metallic"] = image(n, maps["metal"], vector, data=True).outputs[0]
    if "normal" in maps:
        node = n.new("ShaderNodeNormalMap")
        node.inputs["Strength"].default_value = rng.uniform(0.4, 1.3)
        n.set(node.inputs["Color"], image(n, maps["normal"], vector, data=True).outputs[0])
        inputs["Normal"] = node.outputs[0]
    else:
        inputs["Normal"] = n.bump(base.outputs[0], rng.uniform(0.1, 0.4), 0.01)
    if alpha:
        inputs["Alpha"] = base.outputs[1]
        inputs["Roughness"] = 0.5
    elif rng.random() < 0.15:
        inputs["Coat_Weight"], inputs["Coat_Roughness"] = 1.0, rng.uniform(0.0, 0.2)
    return n.principled(**inputs)


def picture(rng, path):
    """An image filling UV 0..1: a painting, a poster."""
    n = Nodes("picture")
    base = image(n, path, n.uv(1.0))
    return n.principled(Base_Color=base.outputs[0], Roughness=rng.uniform(0.1, 0.9), Coat_Weight=rng.choice((0, 1)), Coat_Roughness=0.02)


def screen(rng, source):
    """A glowing screen showing an image, behind its glass."""
    n = Nodes("screen")
    base = image(n, source, n.uv(1.0))
    return n.principled(Base_Color=(0.01,) * 3, Roughness=0.05, Emission_Color=base.outputs[0], Emission_Strength=rng.uniform(0.5, 4))


def glowing_picture(rng, source):
    """An image that shines and reflects nothing: a light box, a projection."""
    n = Nodes("glowing picture")
    base = image(n, source, n.uv(1.0))
    return n.finish(n.shader("ShaderNodeEmission", Color=base.outputs[0], Strength=rng.uniform(0.5, 6)))


def embossed(rng, size):
    """One colour, all detail in the normal: scales, weave, bricks, hammering; `size` metres a repeat."""
    n = Nodes("embossed")
    way = rng.choice(("scales", "waves", "bricks", "hammered", "weave", "cracks"))
    if way == "bricks":
        brick = n.new("ShaderNodeTexBrick", offset=rng.choice((0.0, 0.5)))
        n.set(brick.inputs["Vector"], n.uv(size))
        for name, value in (
            ("Scale", 1.0),
            ("Mortar Size", 0.03),
            ("Mortar Smooth", 0.2),
            ("Brick Width", 0.8),
            ("Row Height", 0.4),
        ):
            n.set(brick.inputs[name], value)
        height = n.math("SUBTRACT", n.math("MULTIPLY", n.noise(n.uv(size), 12.0), 0.2), brick.outputs[1])
    elif way == "waves":
        height = n.shader(
            "ShaderNodeTexWave",
            Vector=n.uv(size, rng.uniform(0, 3.1)),
            Scale=1.0,
            Distortion=rng.uniform(0, 8),
            Detail=3.0,
        )
    elif way == "weave":
        height = n.math(
            "ADD",
            n.shader("ShaderNodeTexWave", Vector=n.uv(size), Scale=1.0),
            n.shader("ShaderNodeTexWave", Vector=n.uv(size, 1.5708), Scale=1.0),
        )
    elif way == "hammered":
        height = n.noise(n.place(size), 4.0, 6, 0.6)
    else:
        cells = n.new("ShaderNodeTexVoronoi", feature="F1" if way == "scales" else "DISTANCE_TO_EDGE")
        n.set(cells.inputs["Vector"], n.place(size))
        n.set(cells.inputs["Scale"], 3.0)
        height = n.math("MULTIPLY", cells.outputs["Distance"], 1.0 if way == "scales" else 3.0, clamp=True)
    metal_ = rng.random() < 0.35
    return n.principled(
        Base_Color=color(rng, (0.0, 0.6), (0.3, 0.95)),
        Metallic=float(metal_),
        Roughness=rng.uniform(0.05, 0.7),
        Normal=n.bump(height, rng.uniform(0.3, 1.0), size * rng.uniform(0.05, 0.3)),
    )


def principled_of(material):
    """The material's Principled BSDF, None without one."""
    return next((n for n in material.node_tree.nodes if n.bl_idname == "ShaderNodeBsdfPrincipled"), None)


def image(n, source, vector, data=False):
    """An image texture node of a Blender image or of a file; images are shared by path."""
    node = n.new("ShaderNodeTexImage")
    node.image = (
        source if isinstance(source, bpy.types.Image) else bpy.data.images.load(source, check_existing=True)
    )
    if data:
        node.image.colorspace_settings.name = "Non-Color"
    n.set(node.inputs["Vector"], vector)
    return node
