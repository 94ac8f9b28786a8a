"""Training losses on exposed radiance, the same as src/train/loss.rs. Images are (N, C, H, W)."""

import torch
from torch.nn import functional as F

from features import luminance

_EPSILON, _SMALL, _RAW_LIMIT, _SSIM_WEIGHT = 0.001, 2e-4, 8.0, 10.0
_TARGET, _CAP, _GAMMA, _DARK = 0.35, 0.98, 2.2, 0.005


def _weights(reference, exposed):
    """The weights of squared errors: the inverse of r^2 + 0.001 in scene radiance."""
    return 1 / (reference * reference + _EPSILON * exposed * exposed)


def relmse(image, reference, exposed=1.0):
    """The mean of (x - r)^2 / (r^2 + 0.001) of each image, (N, 1, 1, 1)."""
    return (_weights(reference, exposed) * (image - reference) ** 2).mean((1, 2, 3), keepdim=True)


def geomean(image, reference, raw, exposed):
    """Mean over images of ln(1 + RelMSE / 0.0002). Its gradient is taken against the `raw` reference, if
    there is one, since noise in the target of a squared error does not change the gradient on average."""
    weight, error = _weights(reference, exposed), relmse(image.detach(), reference, exposed)
    target = reference if raw is None else torch.minimum(raw, _RAW_LIMIT * reference + 1)
    loss = (weight / (error + _SMALL) * (image - target) ** 2).mean()
    value = torch.log1p(error / _SMALL).mean()
    return loss + (value - loss).detach()


def display_exposure(reference):
    """The factor that brings each image's mean luminance, its brightest 2 % capped, to 0.35; 0 if black."""
    values = luminance(reference).flatten(1)
    capped = torch.minimum(values, values.quantile(_CAP, 1, keepdim=True)).mean(1)
    return torch.where(capped > 0, _TARGET / capped.clamp(min=1e-30), 0).view(-1, 1, 1, 1)


class _Encode(torch.autograd.Function):
    """Exposed radiance as a display shows it; its slope is bounded in the dark."""

    @staticmethod
    def forward(ctx, exposed):
        ctx.save_for_backward(exposed)
        return exposed.clamp(0, 1) ** (1 / _GAMMA)

    @staticmethod
    def backward(ctx, gradient):
        (exposed,) = ctx.saved_tensors
        slope = exposed.clamp(min=_DARK) ** (1 / _GAMMA - 1) / _GAMMA
        return gradient * torch.where(exposed < 1, slope, 0)


def ssim(image, reference):
    """Mean structural similarity of each image, (N), within 0..1: a Gaussian window of 11x11 pixels."""
    at = torch.arange(-5, 6, dtype=image.dtype, device=image.device)
    line = torch.exp(-0.5 * (at / 1.5) ** 2)
    line = (line / line.sum()).view(1, 1, -1, 1)
    n, c, h, w = image.shape

    def windows(planes):
        planes = planes.reshape(n * c, 1, h, w)
        return F.conv2d(F.conv2d(planes, line), line.transpose(2, 3))

    x, r = windows(image), windows(reference)
    xx = windows(image * image) - x * x
    rr = windows(reference * reference) - r * r
    xr = windows(image * reference) - x * r
    found = (2 * x * r + 1e-4) * (2 * xr + 9e-4) / ((x * x + r * r + 1e-4) * (xx + rr + 9e-4))
    return found.view(n, -1).mean(1)


def displayed_ssim(image, reference):
    """SSIM of what a display shows of each image, exposed for its reference; 1 where that is black."""
    exposed = display_exposure(reference)
    found = ssim(_Encode.apply(image * exposed), _Encode.apply(reference * exposed))
    return torch.where(exposed.flatten() > 0, found, 1)


def ssim_loss(image, reference, raw, exposed):
    """`geomean` and ten times 1 - SSIM."""
    return geomean(image, reference, raw, exposed) + _SSIM_WEIGHT * (1 - displayed_ssim(image, reference).mean())


LOSSES = {"geomean": geomean, "ssim": ssim_loss}
