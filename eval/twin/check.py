"""Compares the twin's results with the crate's on the same frame (tests/twin.rs writes the file FACTS).

    python check.py WEIGHTS FACTS LOSS LEAK

Inputs, image and loss must agree to 1e-3, gradients to 1e-2. Each difference is measured as the root of its
summed squares, relative to that of the crate's values.
"""

import sys

import torch

import features
import losses
import network
from weights import read_tensors


def compare(name, found, wanted, tolerance):
    error = ((found - wanted).norm() / wanted.norm().clamp(min=1e-12)).item()
    if not error <= tolerance:
        sys.exit(f"{name} differs by {error:.2e}, more than {tolerance:.0e}")
    return error


def main(weights, facts, loss, leak):
    net, _ = network.read(weights)
    net.set_leak(float(leak))
    facts, _ = read_tensors(facts)
    facts = {name: torch.from_numpy(values) for name, values in facts.items()}

    def passes(kind, names):
        return [facts[f"{kind}.{name}"] for name in names]

    guides, scale = ("Denoising Albedo", "Denoising Normal"), facts["scale"].view(1, 1, 1, 1)
    if net.makes_radiance:
        for parameter in net.prefilter.parameters():
            parameter.requires_grad = False  # the crate trains it by itself
        noisy = passes("noisy", ("Combined", *guides))
        inputs, exposed = features.guides(*noisy, *net.prefilter.clean(*noisy[1:]))
        image, found_scale = net(torch.cat(noisy, 1))[0], exposed.reciprocal()
        reference = facts["reference.Combined"]
    else:
        noisy = passes("noisy", guides)
        inputs, found_scale = features.noisy_guides(*noisy)
        image = net.denoise(*noisy) / found_scale
        reference = net.target(None, torch.cat(passes("reference", guides), 1))
    compare("the scale", found_scale, scale, 1e-5)
    errors = [compare(f"input {i}", x, facts[f"input.{i}"], 1e-3) for i, x in enumerate(inputs)]
    print("inputs", " ".join(f"{e:.1e}" for e in errors))
    print(f"image {compare('the image', image, facts['image'], 1e-3):.1e}")
    value = losses.LOSSES[loss](image, reference / scale, None, 1 / scale)
    print(f"loss {loss} {compare('the loss', value, facts['loss'][0], 1e-3):.1e}")
    value.backward()
    gradients = {n: p.grad for n, p in net.named_parameters() if p.grad is not None}
    wanted = {n.removeprefix("gradient."): g for n, g in facts.items() if n.startswith("gradient.")}
    if gradients.keys() != wanted.keys():
        sys.exit(f"other parameters learn: {sorted(gradients.keys() ^ wanted.keys())}")
    errors = [compare(f"the gradient of {n}", g, wanted[n], 1e-2) for n, g in gradients.items()]
    print(f"gradients of {len(errors)} parameters, the worst {max(errors):.1e}")


if __name__ == "__main__":
    main(*sys.argv[1:])
