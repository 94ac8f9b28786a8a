"""The refit that follows the network: the same as src/filters/refit.rs, whose first lines say what it is
for."""

import torch

from features import interpolate, window_sums
from solving import cholesky, solve

_WINDOW = (1.0, 4.0, 6.0, 4.0, 1.0)
_PIXELS = 256.0 / 70.0**2
_GUIDES, _COLOURS = 6, 3
_GUIDE_NOISE = (1e-5, 1e-5, 1e-5, 2e-4, 2e-4, 2e-4)
_SLOPE, _BLOTCHES, _NOISY = 0.5, 0.09, 0.1
_SAMPLE_FLOOR, _FLOOR, _MOST, _BRIGHT, _LARGEST = 0.3, 0.007, 2.0, 1.5, 0.7
_LEAST_COUNT, _LEAST_NOISE, _LEAST_LEVEL = 1e-2, 1e-3, 0.3


@torch.no_grad()
def factors(image, light, normal, albedo):
    """The factors by which the values of `image` are multiplied. They and all arguments are (N, 3, H, W): the
    denoised image, the noisy light (exposed and divided by albedo), the clean normal and the divisor."""
    denoised = image.clamp(min=0) / albedo
    weight = 1 / (1 + (denoised.mean(1, keepdim=True) / _BRIGHT) ** 4)
    guides = [*normal.split(1, 1), *albedo.log().split(1, 1)]
    logarithms = (denoised + _FLOOR).log().split(1, 1)
    ratios = ((light + _SAMPLE_FLOOR) / (denoised + _SAMPLE_FLOOR)).clamp(max=_MOST).split(1, 1)
    known, targets = [torch.ones_like(weight), *guides], [*logarithms, *ratios]

    products = [known[i] * known[j] for i in range(7) for j in range(i + 1)]
    for target in targets:
        products += [target * k for k in known] + [target * target]
    sums = iter(window_sums(torch.cat([weight * p for p in products], 1), _WINDOW).split(1, 1))
    lower = [[next(sums) for _ in range(i + 1)] for i in range(7)]
    of_targets = [[next(sums) for _ in range(8)] for _ in targets]

    count = lower[0][0]
    inverse = torch.where(count > _LEAST_COUNT, 1 / count.clamp(min=_LEAST_COUNT), 0)
    means = [row[0] * inverse for row in lower[1:]]
    covariance = [
        [lower[1 + i][1 + j] * inverse - means[i] * means[j] for j in range(i + 1)] for i in range(_GUIDES)
    ]
    for i, noise in enumerate(_GUIDE_NOISE):
        covariance[i][i] = covariance[i][i].clamp(min=0) + noise
    fitted = []
    for found in of_targets:
        mean = found[0] * inverse
        along = [found[1 + i] * inverse - means[i] * mean for i in range(_GUIDES)]
        fitted.append((mean, along, (found[7] * inverse - mean * mean).clamp(min=0)))

    noise = (sum(variance for _, _, variance in fitted[_COLOURS:]) / _COLOURS).clamp(min=_LEAST_NOISE)
    doubt = noise / (_PIXELS * _SLOPE**2 * count.clamp(min=_LEAST_COUNT))
    doubted = [[value + doubt if i == j else value for j, value in enumerate(row)] for i, row in enumerate(covariance)]
    doubted, plain = cholesky(doubted), cholesky(covariance)
    blotches = _BLOTCHES**2 * (noise / _NOISY).clamp(max=1)
    found = []
    for c in range(_COLOURS):
        (mean, along, variance), (level, missed, _) = fitted[c], fitted[_COLOURS + c]
        missed, smooth = solve(doubted, missed), solve(plain, along)
        rest = variance - sum(s * a for s, a in zip(smooth, along))
        given = torch.where(inverse > 0, blotches / (rest.clamp(min=0) + blotches), 0)
        slopes = [given * s + m / level.clamp(min=_LEAST_LEVEL) for s, m in zip(smooth, missed)]
        constant = given * mean - sum(slope * m for slope, m in zip(slopes, means))
        found += [constant, *slopes, -given]
    found = interpolate(torch.cat(found, 1)).split(8, 1)
    values = torch.cat(known, 1)
    logarithms = [
        (fit[:, :7] * values).sum(1, keepdim=True) + fit[:, 7:] * logarithm
        for fit, logarithm in zip(found, logarithms)
    ]
    return (torch.cat(logarithms, 1) * weight).clamp(-_LARGEST, _LARGEST).exp()
