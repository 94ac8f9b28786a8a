"""File names of render pairs, as the demc tool reads them.

`<scene>_<spp>spp.exr` beside `<scene>_ref.exr`; in a sequence the frame stands before the extension
(`shot_0004spp.0017.exr`). Half buffers add `_a` and `_b` (`shot_0004spp_a.exr`).
"""


def _with_frame(stem, frame):
    return f"{stem}.exr" if frame is None else f"{stem}.{frame:04d}.exr"


def noisy_name(scene, spp, frame=None, half="", seed=0):
    """Name of a noisy frame; `half` is "", "a" or "b", `seed` that of its noise, where there are several."""
    suffix = (f"_{half}" if half else "") + (f"_n{seed}" if seed else "")
    return _with_frame(f"{scene}_{spp:04d}spp{suffix}", frame)


def reference_name(scene, frame=None):
    """Name of a reference frame."""
    return _with_frame(f"{scene}_ref", frame)
