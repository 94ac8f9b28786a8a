"""The built-in network in PyTorch: the same function, the same names and shapes of parameters as
src/models/pyramid.rs, and the same weights files."""

import math

import torch
from torch import nn
from torch.nn import functional as F

import features
import refit
from weights import read_tensors, write_tensors

LEVELS = 4
KERNEL, FULL_KERNEL = 5, 3
_DECODER_EXTRA, _HEAD_GAIN, _LIMIT = 16, 0.3, 40.0
_BILINEAR = (0.5625, 0.1875, 0.1875, 0.0625)
INPUTS = "guides/logarithm/1"  # the name in weights files of what the network reads

SIZES = {
    "demc-s": {"widths": [16, 48, 64, 64], "prefilter": [16, 24, 32, 40]},
    "demc-m": {"widths": [80, 96, 96, 112], "prefilter": [32, 48, 48, 48]},
}


def _convolution(inputs, outputs, k, gain=1.0):
    layer = nn.Conv2d(inputs, outputs, k, padding=k // 2)
    limit = gain * math.sqrt(6 / ((inputs + outputs) * k * k))
    nn.init.uniform_(layer.weight, -limit, limit)
    nn.init.zeros_(layer.bias)
    return layer


def _upsampling(inputs, outputs):
    """A transposed convolution whose initial weights are bilinear interpolation."""
    layer = nn.ConvTranspose2d(inputs, outputs, 4, stride=2, padding=1)
    line = torch.tensor((0.25, 0.75, 0.75, 0.25))
    with torch.no_grad():
        layer.weight.zero_()
        layer.bias.zero_()
        for i in range(inputs):
            layer.weight[i, i % outputs] = torch.outer(line, line) / math.ceil(inputs / outputs)
    return layer


def filtered(image, logits, confidence):
    """Filters an image by softmax kernels. To `logits`, (N, k*k, H, W), confidence is added."""
    n, channels, h, w = image.shape
    k = math.isqrt(logits.shape[1])
    pad = (k // 2,) * 4
    trust = F.unfold(F.pad(confidence, pad, value=-1e30), k).view(n, k * k, h, w)
    weights = (logits + trust).softmax(1)
    near = F.unfold(F.pad(image, pad), k).view(n, channels, k * k, h, w)
    return (near * weights.unsqueeze(1)).sum(2)


def reduced(image, confidence):
    """Halves an image, each 2x2 square weighted by the exponential of its confidence."""
    weights = confidence.clamp(-_LIMIT, _LIMIT).exp()
    return F.avg_pool2d(image * weights, 2) / F.avg_pool2d(weights, 2)


def upsampled(coarse, corners):
    """Doubles an image. Each fine pixel is the mean of the four nearest coarse ones, weighted by bilinear
    weights times exponentials of `corners`."""
    padded = F.pad(coarse, (1, 1, 1, 1), mode="replicate")
    h, w = coarse.shape[2:]
    total, weights = 0, 0
    for corner, bilinear in enumerate(_BILINEAR):
        beside, above = corner % 2, corner // 2
        parts = []
        for y in (0, 1):
            for x in (0, 1):
                top, left = 1 + above * (2 * y - 1), 1 + beside * (2 * x - 1)
                parts.append(padded[:, :, top : top + h, left : left + w])
        near = F.pixel_shuffle(torch.stack(parts, 2).flatten(1, 2), 2)
        weight = bilinear * corners[:, corner : corner + 1].clamp(-_LIMIT, _LIMIT).exp()
        total, weights = total + near * weight, weights + weight
    return total / weights


def filter_levels(image, levels):
    """Filters an image by what was predicted for every level of its pyramid, full resolution first."""
    pyramid = []
    for level, predicted in enumerate(levels):
        pyramid.append(image)
        if level + 1 < len(levels):
            image = reduced(image, predicted["confidence"])
    below = None
    for image, predicted in zip(reversed(pyramid), reversed(levels)):
        if below is not None:
            share = predicted["mask"].clamp(-_LIMIT, _LIMIT).sigmoid()
            image = (1 - share) * image + share * upsampled(below, predicted["corners"])
        below = filtered(image, predicted["kernel"], predicted["confidence"])
    return below


def amplified(image, logits):
    """Every value times a gain of at most e^2 either way."""
    return image * (2 * torch.tanh(logits / 2)).exp()


def _relu(x, leak):
    """ReLU. Where it gives nothing, the share `leak` of the gradient passes, as `Conv::set_leak` of the crate has it."""
    return torch.where(x > 0, x, leak * (x - x.detach())) if leak else F.relu(x)


class _Encoder(nn.ModuleList):
    leak = 0.0

    def __init__(self, channels, widths):
        before = [4 * channels, *widths]
        super().__init__(
            nn.ModuleList((_convolution(a, b, 3), _convolution(b, b, 3))) for a, b in zip(before, widths)
        )

    def forward(self, x):
        skips = []
        for level, (first, second) in enumerate(self):
            if level > 0:
                x = F.max_pool2d(x, 2)
            x = _relu(second(_relu(first(x), self.leak)), self.leak)
            skips.append(x)
        return skips


class _Level(nn.Module):
    leak = 0.0

    def __init__(self, skip, below):
        super().__init__()
        width = skip + _DECODER_EXTRA
        self.up = _upsampling(below + _DECODER_EXTRA, width) if below else None
        self.fuse = _convolution(2 * skip + (width if below else 0), width, 1)
        self.refine = _convolution(width, width, 3)

    def forward(self, skips, below):
        sources = [*skips] if below is None else [*skips, _relu(self.up(below), self.leak)]
        return _relu(self.refine(_relu(self.fuse(torch.cat(sources, 1)), self.leak)), self.leak)


class Trunk(nn.Module):
    """Encoders, decoder and heads: what the network and its prefilter have in common."""

    narrow = False  # whether convolutions compute in bfloat16; everything else needs all its digits

    def __init__(self, widths, guide_channels, full_kernel, extra):
        super().__init__()
        self.kernel = full_kernel
        self.encoder = nn.ModuleDict({"radiance": _Encoder(3, widths), "guide": _Encoder(guide_channels, widths)})
        below = [*widths[1:], 0]
        self.decoder = nn.ModuleDict({str(l): _Level(widths[l], below[l]) for l in range(LEVELS)})
        heads = {str(l): _convolution(widths[l] + _DECODER_EXTRA, 31, 1, _HEAD_GAIN) for l in range(LEVELS)}
        full = 4 * (full_kernel**2 + 6 + extra)
        heads["full"] = _convolution(widths[0] + _DECODER_EXTRA, full, 1, _HEAD_GAIN)
        self.head = nn.ModuleDict(heads)

    def set_leak(self, leak):
        """Lets a share of the gradient pass the ReLUs where they give nothing, those of the prefilter too."""
        for part in self.modules():
            if isinstance(part, (_Encoder, _Level)):
                part.leak = leak

    def hidden(self):
        """The weights of hidden layers, which Muon trains."""
        return [p for name, p in self.named_parameters() if p.dim() == 4 and "head." not in name]

    def predict(self, radiance, guide):
        """The outputs of the heads by level, full resolution first, and the further outputs of the first."""
        with torch.autocast(radiance.device.type, torch.bfloat16, enabled=self.narrow):
            skips = [
                self.encoder[name](F.pixel_unshuffle(planes, 2).contiguous(memory_format=torch.channels_last))
                for name, planes in (("radiance", radiance), ("guide", guide))
            ]
            x, heads = None, []
            for l in reversed(range(LEVELS)):
                x = self.decoder[str(l)]([s[l] for s in skips], x)
                heads.insert(0, self.head[str(l)](x))
            full = self.head["full"](x)
        full = F.pixel_shuffle(full.float(), 2)  # four channels in a row are the pixels of a 2x2 square
        levels = [_parted(full, self.kernel), *(_parted(head.float(), KERNEL) for head in heads)]
        return levels, full[:, self.kernel**2 + 6 :]


def _parted(planes, k):
    taps = k * k
    return {
        "kernel": planes[:, :taps],
        "confidence": planes[:, taps : taps + 1],
        "mask": planes[:, taps + 1 : taps + 2],
        "corners": planes[:, taps + 2 : taps + 6],
    }


class Prefilter(Trunk):
    """Denoises albedo and normal."""

    makes_radiance = False

    def __init__(self, widths):
        super().__init__(widths, 3, KERNEL, 3)
        self.widths = list(widths)

    def config(self):
        """As weights files hold it."""
        return {"architecture": "prefilter", "widths": self.widths}

    def forward(self, noisy, learn_guides=True):
        """What training compares with `target`, (N, 6, H, W): the divisor, and the normal times 0.1; and its
        exposure, which is 1. `noisy` holds radiance, albedo and normal, (N, 9, H, W)."""
        made = self.denoise(noisy[:, 3:6], noisy[:, 6:9])
        return made, torch.ones_like(made[:, :1, :1, :1])

    def denoise(self, albedo, normal):
        """The divisor, and the normal times 0.1, (N, 6, H, W)."""
        (light, small, encoded, direction), scale = features.noisy_guides(albedo, normal)
        levels, gain = self.predict(encoded, direction)
        albedo, normal = amplified(filter_levels(light, levels), gain), filter_levels(small, levels)
        return torch.cat((albedo, normal), 1) * scale

    @staticmethod
    def target(reference, guides):
        """The output that training aims at, (N, 6, H, W), from the guides of a reference."""
        albedo, normal = guides[:, :3], guides[:, 3:]
        return torch.cat((features.divisor(albedo), normal.clamp(-1, 1) * features.NORMAL_SCALE), 1)

    def clean(self, albedo, normal):
        """The denoised albedo and normal."""
        made = self.denoise(albedo, normal)
        clean_albedo = (made[:, :3] - features.ALBEDO_FLOOR).clamp(0, 1)
        return clean_albedo, (made[:, 3:] / features.NORMAL_SCALE).clamp(-1, 1)


class Pyramid(Trunk):
    """The network with its prefilter."""

    makes_radiance = True

    def __init__(self, widths, prefilter):
        super().__init__(widths, 7, FULL_KERNEL, 5)
        self.prefilter = Prefilter(prefilter)
        self.widths, self.prefilter_widths = list(widths), list(prefilter)

    def config(self):
        """As weights files hold it."""
        return {"architecture": "pyramid", "widths": self.widths, "prefilter": self.prefilter_widths}

    def forward(self, noisy, learn_guides=False):
        """Denoised exposed radiance, (N, 3, H, W), and the exposure, (N, 1, 1, 1), from noisy radiance,
        albedo and normal, (N, 9, H, W). The prefilter learns too only if `learn_guides`."""
        radiance, albedo, normal = noisy.split(3, 1)
        with torch.set_grad_enabled(learn_guides and torch.is_grad_enabled()):
            clean = self.prefilter.clean(albedo, normal)
        inputs, exposed = features.guides(radiance, albedo, normal, *clean)
        return self.denoise(*inputs), exposed

    @staticmethod
    def target(reference, guides):
        """The output that training aims at, before the exposure."""
        return reference

    def denoise(self, light, divided, encoded, guide, ratio, shade, normal):
        """Runs the network and the refit on the network's inputs; returns denoised exposed radiance."""
        levels, rest = self.predict(encoded, guide)
        gain, divisor, follow = rest[:, :3], rest[:, 3:4], rest[:, 4:5]
        image = light * (ratio * divisor.clamp(-_LIMIT, _LIMIT).sigmoid()).exp()
        image = amplified(filter_levels(image, levels) * divided, gain + shade * follow)
        return image * refit.factors(image.detach(), light, normal, divided)


def build(config):
    """A network with fresh weights of a configuration as weights files hold it."""
    if config["architecture"] == "prefilter":
        return Prefilter(config["widths"])
    if config["architecture"] == "pyramid":
        return Pyramid(config["widths"], config["prefilter"])
    raise ValueError(f"this twin knows the built-in networks alone, not {config['architecture']}")


def read(path):
    """A network from a weights file, and the file's metadata."""
    tensors, metadata = read_tensors(path)
    network = build(metadata["network"])
    network.load_state_dict({name: torch.from_numpy(values) for name, values in tensors.items()})
    return network, metadata


def write(path, network, metadata):
    """Writes a weights file that the crate reads. It holds no ranges for 8-bit arithmetic: the crate measures
    them when it validates (`demc train --init`)."""
    state = {name: values.detach().float().cpu().numpy() for name, values in network.state_dict().items()}
    write_tensors(path, state, {**metadata, "ranges": {}})
