"""What a user chooses, kept in each scene and saved with the .blend."""

import bpy
from bpy.props import BoolProperty, EnumProperty, IntProperty, PointerProperty, StringProperty

WEIGHTS_FILE = "FILE"
# Blender 4.5 and later show paths beside the .blend, such as //frames, as wrong where a property does not say
# so.
_PATH = {"PATH_SUPPORTS_BLEND_RELATIVE"} if bpy.app.version >= (4, 5) else set()


class DemcSettings(bpy.types.PropertyGroup):
    """Model and options, `scene.demc`."""

    model: EnumProperty(
        name="Model",
        description="The network that denoises",
        items=(
            ("demc-s", "Small (demc-s)", "Fastest"),
            ("demc-m", "Medium (demc-m)", "Takes twice as long as small, and is more accurate"),
            ("demc-l", "Large (demc-l)", "Takes over three times as long as small, and is the most accurate"),
            (WEIGHTS_FILE, "Weights File", "A network that 'demc train' made"),
        ),
        default="demc-m",
    )
    weights: StringProperty(
        name="Weights", description="The .safetensors file of the network", subtype="FILE_PATH", options=_PATH)
    view_layer: StringProperty(
        name="View Layer", description="The view layer to denoise; empty for the one with the most passes")
    keep_noisy: BoolProperty(
        name="Keep Noisy", default=True,
        description="Add the result to the files as the layer Denoised. Off: it takes the place of Combined. "
        "Denoise This Render always keeps the noisy picture")
    light_passes: BoolProperty(
        name="Light Passes",
        description="Denoise light passes and light groups too, so that they add up to the denoised picture")
    alpha: EnumProperty(
        name="Alpha",
        description="What becomes of the alpha channel",
        items=(
            ("auto", "Automatic", "Denoised where it differs from pixel to pixel"),
            ("denoise", "Denoise", "Denoised together with the colours"),
            ("keep", "Keep", "Left as it was rendered"),
        ),
        default="auto",
    )
    use_temporal: BoolProperty(
        name="Temporal",
        description="Take neighbouring frames along: less noise and flicker. For folders and frame ranges; needs "
        "the Vector pass, no motion blur, and a seed that changes from frame to frame")
    temporal: IntProperty(
        name="Neighbours", description="How many frames before and after each", min=1, max=8, default=2)
    threads: IntProperty(
        name="Threads", description="Processor threads for denoising; 0 for all", min=0, max=1024, default=0)
    output: StringProperty(
        name="Output", subtype="DIR_PATH", options=_PATH,
        description="Folder for the results. Empty: a folder 'denoised' beside the frames, or beside the .blend "
        "for a single render")
    overwrite: BoolProperty(
        name="Overwrite",
        description="Denoise frames again whose results are there already. Renders are never overwritten")
    folder: StringProperty(
        name="Folder", subtype="DIR_PATH", options=_PATH, description="A folder of multilayer EXR files to denoise")
    use_own_range: BoolProperty(
        name="Own Range", description="Denoise other frames than the scene's frame range")
    frame_first: IntProperty(name="First", description="First frame to denoise", default=1)
    frame_last: IntProperty(name="Last", description="Last frame to denoise", default=250)
    after_render: BoolProperty(
        name="Denoise After Render",
        description="Denoise each render when it is done: a still into an image, the frames of an animation into "
        "files beside them")
    use_compositor: BoolProperty(
        name="Wire into Compositor", default=True,
        description="Add the result to the compositor beside the noisy picture, with a wipe between both. What is "
        "there already stays as it is")


def register():
    """Adds `scene.demc`."""
    bpy.utils.register_class(DemcSettings)
    bpy.types.Scene.demc = PointerProperty(type=DemcSettings)


def unregister():
    """Takes it away; what was chosen stays in saved files, for the next time."""
    del bpy.types.Scene.demc
    bpy.utils.unregister_class(DemcSettings)
