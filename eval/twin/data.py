"""Packs in memory, and the crops drawn from them, as src/train/dataset.rs and src/augment.rs draw theirs."""

import hashlib
import random

import torch

import pack

_STOPS = 2.0
# Channels of a noisy frame, and what stands in their place where it lacks them, as in
# src/features/stand_in.rs.
_ALBEDO, _NORMAL = (slice(3, 6), 0.5), (slice(6, 9), 0.0)
_DROPPED = ((_ALBEDO,), (_NORMAL,), (_ALBEDO, _NORMAL))
_ORDERS = [(0, 1, 2), (0, 2, 1), (1, 0, 2), (1, 2, 0), (2, 0, 1), (2, 1, 0)]
LEAST = 16  # sides are multiples of this


class Frames:
    """The pairs of some packs that have at least `least` rows and columns, on a device, in half precision.
    With `guides`, only those whose references keep their guides."""

    def __init__(self, paths, device, least, guides):
        self.guides = guides
        self.pairs = []  # (view, which noisy frame)
        self.views = []
        for path in paths:
            for view in pack.read(path):
                view["parts"] = {name: torch.from_numpy(p).to(device) for name, p in view["parts"].items()}
                is_large = min(view["parts"]["reference"].shape[1:]) >= least
                if not is_large or (guides and "guides" not in view["parts"]):
                    continue
                self.views.append(view)
                self.pairs += [(len(self.views) - 1, i) for i in range(len(view["spp"]))]
        self.sizes = [self.views[view]["parts"]["reference"][0].numel() for view, _ in self.pairs]

    def references(self):
        """A hash of each view's reference."""
        return {hashlib.sha256(view["parts"]["reference"].cpu().numpy().tobytes()).digest() for view in self.views}

    def __len__(self):
        return len(self.pairs)

    def whole(self, index):
        """A pair, cut to sides that the network can halve, as a batch of one."""
        view, which = self.pairs[index]
        parts, spp = self.views[view]["parts"], self.views[view]["spp"][which]
        h, w = (side // LEAST * LEAST for side in parts["reference"].shape[1:])
        cut = {name: parts[name][None, :, :h, :w].float() for name in ("reference", "raw", "guides") if name in parts}
        return {"noisy": parts[f"noisy.{which}"][None, :, :h, :w].float(), "spp": spp, **cut}

    def draw(self, rng, count, side, guide_dropout=0.0):
        """A batch of augmented crops: noisy (N, 9, S, S), reference and raw (N, 3, S, S), and the guides of
        the reference, (N, 6, S, S), or (N, 0, S, S) where `guides` were not asked for. A share of crops lacks
        the albedo, the normal, or both."""
        batch = []
        for view, which in rng.choices(self.pairs, self.sizes, k=count):
            parts, spp = self.views[view]["parts"], self.views[view]["spp"]
            h, w = parts["reference"].shape[1:]
            y, x = rng.randrange(h - side + 1), rng.randrange(w - side + 1)
            noisy = parts[f"noisy.{which}"]
            twins = [i for i, count_of in enumerate(spp) if count_of == spp[which] and i != which]
            if twins:  # a pixel from either of two renders is a render with a seed of its own
                other = parts[f"noisy.{rng.choice(twins)}"]
                noisy = torch.where(torch.rand(h, w, device=noisy.device) < 0.5, noisy, other)
            reference = parts["reference"]
            planes = [noisy, reference, parts.get("raw", reference)] + ([parts["guides"]] if self.guides else [])
            crop = _augmented(torch.cat(planes)[:, y : y + side, x : x + side].float(), rng)
            if rng.random() < guide_dropout:
                for channels, stand_in in rng.choice(_DROPPED):
                    crop[channels] = stand_in
            batch.append(crop)
        batch = torch.stack(batch)
        return batch[:, :9], batch[:, 9:12], batch[:, 12:15], batch[:, 15:]


def _augmented(planes, rng):
    """Flips and turns a crop, permutes its colours and makes it brighter or darker. Channels: radiance,
    albedo, normal, reference, raw reference, and maybe the albedo and normal of the reference."""
    order = list(rng.choice(_ORDERS))
    exposure = 2 ** rng.uniform(-_STOPS, _STOPS)
    flip, turns = rng.random() < 0.5, rng.randrange(4)
    if flip:
        planes = planes.flip(2)
    planes = planes.rot90(turns, (1, 2))
    radiance, albedo, normal, *rest = planes.split(3)
    normals = [normal] + rest[3:]
    colours = [radiance[order] * exposure, albedo[order]]
    targets = [p[order] * exposure for p in rest[:2]] + [p[order] for p in rest[2:3]]
    turned = []
    for n in normals:
        x, y, z = n
        x = -x if flip else x
        for _ in range(turns):
            x, y = -y, x
        turned.append(torch.stack((x, y, z)))
    return torch.cat([*colours, turned[0], *targets, *turned[1:]])
