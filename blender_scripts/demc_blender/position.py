"""World position averaged over samples, as the shader AOV `DEMC Position`.

Cycles' own Position pass holds the first sample alone: aliased, and wrong under depth of field and
motion blur. A colour AOV is averaged like the beauty. It is written by materials, so every material
gets an AOV Output node; objects without a material get one that shades as Cycles' default does.
Where nothing is hit (the world background, light seen directly) the AOV stays 0, and volumes alone
write nothing: behind them stands the position of the surface seen through them.

Cycles writes AOVs at every transparent layer that a camera ray passes, and adds them up. The value
is therefore multiplied by 0 where the surface is more transparent than the view layer's alpha
threshold, which is also the rule by which Cycles picks the surface for its data passes. Paths that
such a surface, or haze, scatters away write nothing, so behind it the position is darkened in
proportion, as at edges against the background.
"""

import bpy

POSITION_AOV = "DEMC Position"
_OPACITY_SOCKET = "DEMC Opacity"
_SURFACES = {"MESH", "CURVE", "SURFACE", "META", "FONT", "CURVES", "POINTCLOUD"}


def store_position(edits, view_layers):
    """Adds the AOV to the passes of the view layers; the materials must write it."""
    for layer in view_layers:
        # With Open Shading Language, Cycles leaves AOVs empty.
        if POSITION_AOV not in layer.aovs and not layer.id_data.cycles.shading_system:
            aov = layer.aovs.add()
            aov.name, aov.type = POSITION_AOV, "COLOR"
            edits.on_undo(lambda layer=layer: layer.aovs.remove(layer.aovs[POSITION_AOV]))


def write_position(edits, view_layers):
    """Makes every material write the AOV. Returns the names of materials that refused it."""
    _cover_bare_objects(edits)
    threshold = min((layer.pass_alpha_threshold for layer in view_layers), default=0.5)
    groups, refused = {}, []
    for material in list(bpy.data.materials):
        if getattr(material, "is_grease_pencil", False):
            continue
        try:
            _add_to_material(edits, material, threshold, groups)
        except (RuntimeError, AttributeError, TypeError):  # linked from a library, for instance
            refused.append(material.name)
    return refused


def _cover_bare_objects(edits):
    default = None
    for obj in list(bpy.data.objects):
        if obj.type not in _SURFACES or obj.data is None:
            continue
        empty = [slot for slot in obj.material_slots if slot.material is None]
        if obj.material_slots and not empty:
            continue
        default = default or _default_material(edits)
        try:
            for slot in empty:
                slot.material = default
                edits.on_undo(lambda slot=slot: setattr(slot, "material", None))
            if not obj.material_slots:
                materials = obj.data.materials
                materials.append(default)
                _keep_indices(edits, obj.data)
                edits.on_undo(lambda materials=materials: materials.clear())
        except (RuntimeError, AttributeError):  # data of a linked library cannot be edited
            continue


def _keep_indices(edits, data):
    """Puts back which slot each face is of: clearing the slots of a mesh drops that."""
    attribute = getattr(data, "attributes", {}).get("material_index")
    if attribute is None:
        return
    indices = [0] * len(attribute.data)
    attribute.data.foreach_get("value", indices)

    def put_back():
        again = data.attributes.get("material_index") or data.attributes.new("material_index", "INT", "FACE")
        again.data.foreach_set("value", indices)

    edits.on_undo(put_back)


def _default_material(edits):
    """A material that shades as Cycles shades an object without one: diffuse 0.8."""
    material = bpy.data.materials.new("DEMC Default")
    edits.on_undo(lambda: bpy.data.materials.remove(material))
    _use_nodes(material)
    _plain_diffuse(material.node_tree, (0.8, 0.8, 0.8, 1.0))
    return material


def _has_nodes(material):
    # From Blender 5 on every material has nodes, and asking for use_nodes only warns.
    return material.node_tree is not None and (bpy.app.version >= (5, 0, 0) or material.use_nodes)


def _use_nodes(material):
    if not _has_nodes(material):
        material.use_nodes = True


def _plain_diffuse(tree, color):
    tree.nodes.clear()
    output = tree.nodes.new("ShaderNodeOutputMaterial")
    diffuse = tree.nodes.new("ShaderNodeBsdfDiffuse")
    diffuse.inputs["Color"].default_value = color
    tree.links.new(diffuse.outputs["BSDF"], output.inputs["Surface"])


def _add_to_material(edits, material, threshold, groups):
    if not _has_nodes(material):
        # Cycles renders a material without nodes as plain diffuse of its viewport colour.
        if material.node_tree is not None:  # nodes switched off by the user: leave them alone
            return
        color = tuple(material.diffuse_color)
        material.use_nodes = True
        edits.on_undo(lambda: setattr(material, "use_nodes", False))
        _plain_diffuse(material.node_tree, color)
    tree = material.node_tree
    output = tree.get_output_node("CYCLES")
    if output is None or not output.inputs["Surface"].is_linked:
        return  # volume alone, or nothing
    build = _Builder(edits, tree)
    opacity = _opacity(build, output.inputs["Surface"], groups, 0)
    if isinstance(opacity, float) and opacity < threshold:
        return  # seen through everywhere
    value = build.node("ShaderNodeNewGeometry").outputs["Position"]
    if not isinstance(opacity, float):
        solid = build.math("GREATER_THAN", opacity, threshold - 1e-4)
        scale = build.node("ShaderNodeVectorMath")
        scale.operation = "SCALE"
        build.link(value, scale.inputs["Vector"])
        build.link(solid, scale.inputs["Scale"])
        value = scale.outputs["Vector"]
    aov = build.node("ShaderNodeOutputAOV")
    aov.aov_name = POSITION_AOV
    build.link(value, aov.inputs["Color"])


class _Builder:
    """Adds nodes to one tree, each of them undoable."""

    def __init__(self, edits, tree):
        self.edits, self.tree = edits, tree

    def node(self, kind):
        tree, node = self.tree, self.tree.nodes.new(kind)
        name = node.name
        self.edits.on_undo(lambda: tree.nodes.remove(tree.nodes[name]))
        return node

    def link(self, source, target):
        """Links a socket, or sets a constant."""
        if isinstance(source, float):
            target.default_value = source
        else:
            self.tree.links.new(source, target)

    def math(self, operation, *inputs):
        node = self.node("ShaderNodeMath")
        node.operation = operation
        for source, target in zip(inputs, node.inputs):
            self.link(source, target)
        return node.outputs[0]


def _opacity(build, socket, groups, depth):
    """How opaque the closure feeding a shader socket is: a constant, or a socket that computes it."""
    if not socket.is_linked or depth > 32:
        return 1.0
    link = socket.links[0]
    node, output = link.from_node, link.from_socket
    if node.mute:
        return 1.0
    below = lambda target: _opacity(build, target, groups, depth + 1)
    kind = node.bl_idname
    if kind == "NodeReroute":
        return below(node.inputs[0])
    if kind == "ShaderNodeBsdfTransparent":
        return 0.0
    if kind == "ShaderNodeBsdfPrincipled":
        return _value(node.inputs["Alpha"])
    if kind == "ShaderNodeMixShader":
        first, second = (below(s) if s.is_linked else 0.0 for s in node.inputs[1:3])
        return _mix(build, _value(node.inputs[0]), first, second)
    if kind == "ShaderNodeAddShader":
        return _add(build, *(below(s) if s.is_linked else 0.0 for s in node.inputs[:2]))
    if kind == "ShaderNodeGroup" and node.node_tree:
        return _group_opacity(build, node, output, groups, depth)
    return 1.0


def _value(socket):
    return socket.links[0].from_socket if socket.is_linked else float(socket.default_value)


def _mix(build, factor, first, second):
    if isinstance(first, float) and first == second:
        return first
    if all(isinstance(v, float) for v in (factor, first, second)):
        return first + (second - first) * min(max(factor, 0.0), 1.0)
    # first * (1 - factor) + second * factor
    rest = build.math("SUBTRACT", 1.0, factor)
    return build.math("ADD", build.math("MULTIPLY", rest, first), build.math("MULTIPLY", factor, second))


def _add(build, first, second):
    if isinstance(first, float) and isinstance(second, float):
        return min(first + second, 1.0)
    # Adding a transparent closure leaves the rest as it is; a sum above 1 counts as opaque.
    return build.math("MINIMUM", build.math("ADD", first, second), 1.0)


def _group_opacity(build, node, output, groups, depth):
    """The opacity of a node group's shader output, handed out through an extra group socket."""
    tree, key = node.node_tree, (node.node_tree.name_full, output.identifier)
    if key not in groups:
        groups[key] = 1.0  # also what a group inside itself would get
        inner = next((n for n in tree.nodes if n.bl_idname == "NodeGroupOutput" and n.is_active_output), None)
        source = inner and next((s for s in inner.inputs if s.identifier == output.identifier), None)
        if source is not None:
            inside = _Builder(build.edits, tree)
            groups[key] = _exported(inside, inner, _opacity(inside, source, groups, depth + 1))
    found = groups[key]
    if isinstance(found, float):
        return found
    return next(s for s in node.outputs if s.identifier == found)


def _exported(build, group_output, opacity):
    if isinstance(opacity, float):
        return opacity
    interface = build.tree.interface
    item = interface.new_socket(_OPACITY_SOCKET, in_out="OUTPUT", socket_type="NodeSocketFloat")
    identifier = item.identifier
    build.edits.on_undo(lambda: interface.remove(item))
    build.link(opacity, next(s for s in group_output.inputs if s.identifier == identifier))
    return identifier
