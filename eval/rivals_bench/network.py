"""The base-16 dual encoder: what both rivals compute, as `src/models/demc.rs` defines it.

Colour (3 channels) and features (12); five levels; three 3x3 convolutions and a pool a level and
encoder; a decoder of 4x4 stride-2 transposed convolutions, each fused with both skips by a 1x1.
"""

WIDTHS = (16, 32, 64, 128, 128)
FEATURES, COLOUR, DETAIL = 12, 3, 3
GAMMA = 2.2


def layers(widths=WIDTHS):
    """Every convolution as (name, kind, inputs, outputs); kinds: 3x3, norm (3x3 with batch norm), up, 1x1."""
    first = widths[0]
    yield "fusion.0", "3x3", FEATURES, first
    yield "fusion.1", "norm", first, first
    yield "fusion.2", "norm", first, first
    yield "fusion.3", "3x3", first, DETAIL
    for encoder, inputs in (("feature", DETAIL), ("colour", COLOUR)):
        for level, width in enumerate(widths):
            for unit in range(3):
                yield f"{encoder}.{level}.{unit}", "3x3", inputs, width
                inputs = width
    for level in reversed(range(len(widths))):
        width, below = widths[level], widths[min(level + 1, len(widths) - 1)]
        yield f"up.{level}", "up", below, width
        yield f"fuse.{level}", "1x1", 3 * width, width
    yield "output", "1x1", first, 3


def parameters(widths=WIDTHS):
    """Trained parameters: weights, biases, and scale and shift of the batch norms."""
    taps = {"3x3": 9, "norm": 9, "up": 16, "1x1": 1}
    return sum(taps[kind] * i * o + o + (2 * o if kind == "norm" else 0) for _, kind, i, o in layers(widths))
