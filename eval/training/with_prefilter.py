"""Replaces the prefilter of a network by that of another weights file.

    with_prefilter.py NETWORK.safetensors PREFILTER.safetensors OUT.safetensors

PREFILTER is a file of `demc train --model prefilter`.
"""

import sys

import weights
from weights import PREFILTER


def main():
    """Entry point of the script."""
    network, prefilter, target = sys.argv[1:]
    facts, tensors = weights.read(network)
    own_facts, own = weights.read(prefilter)
    if own_facts["network"]["architecture"] != "prefilter":
        sys.exit(f"{prefilter}: is no prefilter alone; `prefilter.py` takes one out of a network's weights")
    facts["network"]["prefilter"] = own_facts["network"]["widths"]
    ranges = {name: r for name, r in facts.get("ranges", {}).items() if not name.startswith(PREFILTER)}
    facts["ranges"] = ranges | {PREFILTER + name: r for name, r in own_facts.get("ranges", {}).items()}
    tensors = {name: tensor for name, tensor in tensors.items() if not name.startswith(PREFILTER)}
    tensors |= {PREFILTER + name: tensor for name, tensor in own.items()}
    weights.write(target, facts, dict(sorted(tensors.items())))


if __name__ == "__main__":
    main()
