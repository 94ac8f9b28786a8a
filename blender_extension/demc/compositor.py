"""The result beside the noisy picture in the compositor, with a wipe between both."""

import math

import bpy

_MARK = "demc"


def wire(scene, picture, layer=""):
    """Adds an image node with the result of a view layer, or of the first that is rendered, a Split node and a
    viewer. Nodes of the user's stay as they are; those that an earlier result brought make room for the new ones. Returns the tree, or None where the user
    has nodes that are turned off."""
    tree = _tree(scene)
    if tree is None:
        return None
    for node in [node for node in tree.nodes if node.get(_MARK)]:
        tree.nodes.remove(node)
    layer = layer or next((layer.name for layer in scene.view_layers if layer.use), "")
    renders = [node for node in tree.nodes if node.bl_idname == "CompositorNodeRLayers"]
    noisy = next((node for node in renders if node.scene == scene and node.layer == layer), None)
    left = min((node.location.x for node in tree.nodes), default=0.0)
    bottom = min((node.location.y - 400 for node in tree.nodes), default=0.0)
    if noisy is None:
        noisy = _add(tree, "CompositorNodeRLayers", "Noisy", (left, bottom - 320))
        noisy.scene = scene
        if layer:
            noisy.layer = layer
    result = _add(tree, "CompositorNodeImage", "Denoised by demc", (left, bottom))
    result.image = picture
    split = _add(tree, "CompositorNodeSplit", "Noisy | denoised", (left + 320, bottom))
    viewer = _add(tree, "CompositorNodeViewer", "Wipe", (left + 560, bottom))
    images = [socket for socket in split.inputs if socket.type == "RGBA"]
    # The node shows its first image at the right; Blender 5 where its line is turned so, which lies slanting
    # at first.
    if "Rotation" in split.inputs:
        split.inputs["Rotation"].default_value = -math.pi / 2
    tree.links.new(noisy.outputs["Image"], images[1])
    tree.links.new(result.outputs["Image"], images[0])
    tree.links.new(split.outputs[0], viewer.inputs["Image"])
    # Of several viewers, Blender shows the active one.
    tree.nodes.active = viewer
    return tree


def _tree(scene):
    # Blender 5 keeps it as a node group that scenes share; before, each scene had one of its own.
    if hasattr(scene, "compositing_node_group"):
        if scene.compositing_node_group is None:
            scene.compositing_node_group = _group(scene)
        return scene.compositing_node_group
    if not scene.use_nodes:
        if scene.node_tree is not None:
            return None
        scene.use_nodes = True
    return scene.node_tree


def _group(scene):
    """What Blender 4 begins with: the render goes to the output. F12 is refused where nothing does."""
    tree = bpy.data.node_groups.new("Compositor Nodes", "CompositorNodeTree")
    tree.interface.new_socket("Image", in_out="OUTPUT", socket_type="NodeSocketColor")
    render, output = tree.nodes.new("CompositorNodeRLayers"), tree.nodes.new("NodeGroupOutput")
    render.scene, output.location = scene, (320, 0)
    tree.links.new(render.outputs["Image"], output.inputs[0])
    return tree


def _add(tree, kind, label, location):
    node = tree.nodes.new(kind)
    node.label, node.location = label, location
    node[_MARK] = True
    return node
