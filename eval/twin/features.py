"""What the built-in network reads, computed from a batch of crops: the same as src/features.rs of the crate.

Every function takes and returns torch tensors (N, C, H, W); H and W are multiples of 16.
"""

import math

import torch
from torch.nn import functional as F

from solving import cholesky, solve

ALBEDO_FLOOR = 0.05
NORMAL_SCALE = 0.1
STEEPNESS = 16.0
MIDDLE_GREY = 0.18
FIREFLY = 32.0
SQUARE = 4  # rows and columns of the squares over which fits gather their moments

_LUMINANCE = (0.2126, 0.7152, 0.0722)
_SHADING_WINDOW = (1.0, 8.0, 28.0, 56.0, 70.0, 56.0, 28.0, 8.0, 1.0)
_RIDGE, _LEAST_VARIANCE, _BRIGHTEST, _LARGEST_SHADING = 0.02, 1e-4, 0.75, 1.0


def encode(light):
    """Radiance as the encoders read it: 0 stays 0, 1 stays 1, and above a sixteenth it is a logarithm."""
    return torch.log1p(STEEPNESS * light) / math.log1p(STEEPNESS)


def divisor(albedo):
    """The albedo by which radiance is divided."""
    return albedo.clamp(0, 1) + ALBEDO_FLOOR


def luminance(radiance):
    """The luminance of Rec. 709, (N, 1, H, W)."""
    return (radiance * radiance.new_tensor(_LUMINANCE).view(1, 3, 1, 1)).sum(1, keepdim=True)


def exposure(radiance):
    """The factor, (N, 1, 1, 1), that brings the log-average luminance of 16x16 squares to middle grey."""
    squares = F.avg_pool2d(luminance(radiance.clamp(min=0)), 16)
    lit = squares > 0
    logarithms = torch.where(lit, squares, 1).log().sum((1, 2, 3), keepdim=True)
    count = lit.sum((1, 2, 3), keepdim=True)
    found = MIDDLE_GREY / (logarithms / count.clamp(min=1)).exp()
    return torch.where(count > 0, found, 1)


def tame_fireflies(radiance, floor):
    """Dims single pixels to 32 times the brightest other one of the 5x5 around them, or to `floor`."""
    brightest = radiance.amax(1, keepdim=True)
    n, _, h, w = brightest.shape
    around = F.unfold(F.pad(brightest, (2, 2, 2, 2)), 5)  # nothing is brighter than black beyond the border
    others = torch.cat((around[:, :12], around[:, 13:]), 1).amax(1).view(n, 1, h, w)
    limit = torch.maximum(FIREFLY * others, floor)
    return radiance * torch.where(brightest > limit, limit / brightest.clamp(min=1e-30), 1)


def window_sums(planes, weights):
    """Weighted sums over the 4x4 squares around each; beyond the frame, squares count as zero."""
    squares = F.avg_pool2d(planes, SQUARE) * SQUARE**2
    n, c, h, w = squares.shape
    kernel, reach = planes.new_tensor(weights), len(weights) // 2
    lines = squares.reshape(n * c, 1, h, w)
    lines = F.conv2d(lines, kernel.view(1, 1, -1, 1), padding=(reach, 0))
    return F.conv2d(lines, kernel.view(1, 1, 1, -1), padding=(0, reach)).view(n, c, h, w)


def interpolate(squares):
    """Values of squares at every pixel, bilinear between their centres."""
    return F.interpolate(squares, scale_factor=SQUARE, mode="bilinear", align_corners=False)


def shading(radiance, albedo, normal, exposed):
    """The natural logarithm of how much brighter each pixel should be for its normal, (N, 1, H, W), by a fit
    of encoded light over the three components of the normal."""
    normal = normal.clamp(-1, 1)
    light = (radiance.clamp(min=0) * exposed / (3 * divisor(albedo))).sum(1, keepdim=True)
    light = encode(light).clamp(max=_BRIGHTEST)
    lines = [torch.ones_like(light), *normal.split(1, 1), light]
    products = torch.cat([lines[i] * lines[j] for i in range(5) for j in range(i + 1)], 1)
    moments = iter(window_sums(products, _SHADING_WINDOW).split(1, 1))
    matrix = [[next(moments) for _ in range(i + 1)] for i in range(4)]
    *right, square = moments
    count = matrix[0][0].clamp(min=1)
    mean = right[0] / count
    variance = square / count - mean * mean
    for i in range(1, 4):
        matrix[i][i] = matrix[i][i] + _RIDGE * variance.clamp(min=_LEAST_VARIANCE) * matrix[0][0]
    constant, *slopes = solve(cholesky(matrix), right)
    natural = math.log1p(STEEPNESS)
    kept = interpolate(torch.cat([*(s * natural for s in slopes), (mean - constant) * natural], 1))
    along = (kept[:, :3] * normal).sum(1, keepdim=True) - kept[:, 3:]
    return along.clamp(-_LARGEST_SHADING, _LARGEST_SHADING)


def noisy_guides(albedo, normal):
    """A prefilter's inputs: exposed divisor, exposed scaled normal, encoded divisor, normal; and the scale
    that undoes the exposure."""
    exposed = exposure(divisor(albedo))
    light, direction = divisor(albedo) * exposed, normal.clamp(-1, 1)
    return (light, direction * NORMAL_SCALE * exposed, encode(light), direction), exposed.reciprocal()


def guides(radiance, albedo, normal, clean_albedo, clean_normal):
    """The network's inputs, as `features::LightInputs` lists them (light, divisor, encoded light, guides,
    ratio, shading, clean normal), and the exposure. `radiance` is as rendered."""
    exposed = exposure(radiance)
    shade = shading(radiance, albedo, normal, exposed)
    tamed = tame_fireflies(radiance, MIDDLE_GREY / exposed)
    divided = divisor(clean_albedo)
    light = tamed.clamp(min=0) * exposed / divided
    ratio = (divided / divisor(albedo)).log()
    guide = torch.cat((clean_albedo.clamp(0, 1), normal.clamp(-1, 1), ratio.mean(1, keepdim=True)), 1)
    return (light, divided, encode(light), guide, ratio, shade, clean_normal), exposed
