"""Makes layers.safetensors: what demc's layers must return, computed by JAX in float64.

Run: python -m venv venv && venv/bin/pip install jax==0.10.2 numpy==2.4.6 safetensors==0.8.0
     venv/bin/python make_layers.py        # writes layers.safetensors beside this script

The file here was made by JAX 0.10.2 on the CPU. A case `c` holds its arguments (`c/x`, `c/weight`),
its output `c/y`, random weights `c/r` of that output, and for each differentiable argument the
gradient of sum(r * y), `c/d_x`. Inputs are exact in float32; results are rounded to it.
"""

from pathlib import Path

import jax
import numpy as np
from jax import lax
from jax import numpy as jnp
from safetensors.numpy import save_file

jax.config.update("jax_enable_x64", True)

rng = np.random.default_rng(20240611)
arrays = {}


def normal(*shape):
    return rng.standard_normal(shape).astype(np.float32).astype(np.float64)


def case(name, function, fixed=None, **arguments):
    """Stores a function's arguments, output and gradients; no gradient for those in `fixed`."""
    fixed = fixed or {}
    y, pull = jax.vjp(lambda arguments: function(**arguments, **fixed), arguments)
    r = normal(*y.shape)
    (gradients,) = pull(jnp.asarray(r))
    results = {"r": r, "y": y} | {f"d_{key}": value for key, value in gradients.items()}
    for key, value in (fixed | arguments | results).items():
        arrays[f"{name}/{key}"] = np.asarray(value, dtype=np.float32)


def rectified(name, function, fixed=None, **arguments):
    """The same behind a ReLU; its kink must be farther away than float32 can err."""
    before = function(**arguments, **(fixed or {}))
    assert jnp.abs(before).min() > 5e-5, f"{name}: choose another seed"
    assert 0.2 < (before > 0).mean() < 0.8, f"{name}: both sides of the ReLU must count"
    case(name, lambda **a: jax.nn.relu(function(**a)), fixed, **arguments)


# Convolutions.


def bias_added(y, bias):
    return y + bias[None, :, None, None]


def conv(weight, bias, **sources):
    x = jnp.concatenate([sources[key] for key in sorted(sources)], axis=1)
    y = lax.conv_general_dilated(x, weight, (1, 1), "SAME", dimension_numbers=("NCHW", "OIHW", "NCHW"))
    return bias_added(y, bias)


def transposed(x, weight, bias):
    """Weights (I, O, 4, 4): the transpose of the 4x4 convolution of stride 2 and padding 1, O to I."""
    flipped = weight[:, :, ::-1, ::-1]
    y = lax.conv_general_dilated(
        x, flipped, (1, 1), ((2, 2), (2, 2)), lhs_dilation=(2, 2), dimension_numbers=("NCHW", "IOHW", "NCHW")
    )
    return bias_added(y, bias)


def transposed_by_definition(x, weight, bias):
    def strided(y):
        return lax.conv_general_dilated(
            y, weight, (2, 2), ((1, 1), (1, 1)), dimension_numbers=("NCHW", "OIHW", "NCHW")
        )

    n, _, h, w = x.shape
    like = jax.ShapeDtypeStruct((n, weight.shape[1], 2 * h, 2 * w), x.dtype)
    return bias_added(jax.linear_transpose(strided, like)(x)[0], bias)


def convolutions():
    def sources(*channels):
        return {f"x{i}": normal(2, c, 3, 5) for i, c in enumerate(channels)}

    shapes = [
        ("conv3x3", sources(5), (18, 5, 3, 3)),
        ("conv3x3_of_two", sources(17, 3), (4, 20, 3, 3)),
        ("fusion", sources(17, 3, 2), (17, 22, 1, 1)),
    ]
    for name, inputs, shape in shapes:
        arguments = inputs | {"weight": normal(*shape), "bias": normal(shape[0])}
        case(name, conv, **arguments)
        rectified(f"{name}_relu", conv, **arguments)
    arguments = {"x": normal(2, 18, 2, 3), "weight": normal(18, 5, 4, 4), "bias": normal(5)}
    np.testing.assert_allclose(transposed(**arguments), transposed_by_definition(**arguments), atol=1e-12)
    case("transposed", transposed, **arguments)
    rectified("transposed_relu", transposed, **arguments)


# Pooling and normalisation.


def max_pool(x):
    return lax.reduce_window(x, -jnp.inf, lax.max, (1, 1, 2, 2), (1, 1, 2, 2), "VALID")


def batch_norm(x, scale, shift, mean=None, variance=None):
    """Ioffe and Szegedy 2015: of the batch's own moments, unless the running ones are given."""
    if mean is None:
        mean, variance = jnp.mean(x, axis=(0, 2, 3)), jnp.var(x, axis=(0, 2, 3))
    channel = (None, slice(None), None, None)
    normal = (x - mean[channel]) / jnp.sqrt(variance[channel] + 1e-5)
    return scale[channel] * normal + shift[channel]


def normalisations():
    case("max_pool", max_pool, x=rng.permutation(2 * 17 * 2 * 4).reshape(2, 17, 2, 4) / 64.0)
    x = 2 * normal(3, 18, 3, 4) + normal(18)[None, :, None, None]
    arguments = {"x": x.astype(np.float32).astype(np.float64), "scale": normal(18), "shift": normal(18)}
    rectified("batch_norm_training", batch_norm, **arguments)
    flat = np.moveaxis(arguments["x"], 1, 0).reshape(18, -1)
    arrays["batch_norm_training/mean"] = flat.mean(axis=1).astype(np.float32)
    arrays["batch_norm_training/variance"] = flat.var(axis=1, ddof=1).astype(np.float32)
    running = {"mean": normal(18), "variance": np.square(normal(18)) + 0.25}
    running = {key: value.astype(np.float32).astype(np.float64) for key, value in running.items()}
    rectified("batch_norm_inference", batch_norm, running, **arguments)


# Predicted kernels.


def filtered(image, logits, confidence=None):
    """Softmax over the k x k neighbours inside the image, of logit plus the neighbour's confidence."""
    (n, taps, h, w), k = logits.shape, round(logits.shape[1] ** 0.5)
    border = ((0, 0), (0, 0), (k // 2, k // 2), (k // 2, k // 2))
    confidence = jnp.zeros((n, 1, h, w)) if confidence is None else confidence

    def neighbours(planes, outside):
        """(N, C, H, W) to (N, C, k * k, H, W)."""
        padded = jnp.pad(planes, border, constant_values=outside)
        return jnp.stack([padded[:, :, i // k :, i % k :][:, :, :h, :w] for i in range(taps)], axis=2)

    weights = jax.nn.softmax(logits + neighbours(confidence, -jnp.inf)[:, 0], axis=1)
    return (weights[:, None] * neighbours(image, 0.0)).sum(axis=2)


def squares(planes):
    """(N, C, H, W) to (N, C, H/2, W/2, 4)."""
    n, c, h, w = planes.shape
    split = planes.reshape(n, c, h // 2, 2, w // 2, 2)
    return split.transpose(0, 1, 2, 4, 3, 5).reshape(n, c, h // 2, w // 2, 4)


def reduced(image, confidence):
    return (squares(image) * jax.nn.softmax(squares(confidence), axis=-1)).sum(axis=-1)


def blended(fine, coarse, alpha):
    return fine + jax.nn.sigmoid(alpha) * (jax.image.resize(coarse, fine.shape, "bilinear") - fine)


def amplified(image, logits):
    return image * jnp.exp(2 * jnp.tanh(logits / 2))


def redivided(logits, image, ratio):
    return image * jnp.exp(ratio * jax.nn.sigmoid(logits))


def shuffled(x):
    """Channels 8..20 of 21: each four in a row are the pixels of a 2x2 square."""
    n, _, h, w = x.shape
    split = x[:, 8:20].reshape(n, 3, 2, 2, h, w)
    return split.transpose(0, 1, 4, 2, 5, 3).reshape(n, 3, 2 * h, 2 * w)


def fields():
    for name, k, h, w in [("filter3", 3, 4, 7), ("filter5", 5, 5, 6), ("filter5_wider_than_image", 5, 3, 2)]:
        image, logits = jnp.exp(normal(2, 3, h, w)), normal(2, k * k, h, w)
        image = np.asarray(image, dtype=np.float32).astype(np.float64)
        case(name, filtered, image=image, logits=logits)
        case(f"{name}_confidence", filtered, image=image, logits=logits, confidence=2 * normal(2, 1, h, w))
    case("reduce", reduced, image=normal(2, 3, 4, 6), confidence=normal(2, 1, 4, 6))
    for name, h, w in [("blend", 4, 6), ("blend_smallest", 2, 2)]:
        coarse = normal(2, 3, h // 2, w // 2)
        case(name, blended, fine=normal(2, 3, h, w), coarse=coarse, alpha=normal(2, 1, h, w))
    case("shuffle", shuffled, x=normal(2, 21, 2, 3))
    case("amplify", amplified, image=normal(2, 3, 5, 7), logits=2 * normal(2, 3, 5, 7))
    fixed = {"image": normal(2, 3, 5, 7), "ratio": normal(2, 3, 5, 7)}
    case("redivide", redivided, fixed, logits=2 * normal(2, 1, 5, 7))
    product = lambda sum, a, b: sum + a * b
    case("plus_product", product, {"a": normal(2, 1, 5, 7)}, sum=normal(2, 3, 5, 7), b=normal(2, 1, 5, 7))


if __name__ == "__main__":
    convolutions()
    normalisations()
    fields()
    made_by = {"made_by": f"make_layers.py, JAX {jax.__version__}"}
    save_file(arrays, Path(__file__).with_name("layers.safetensors"), metadata=made_by)
