"""Gives a network the heads in another weights file of the same widths, in the place of its own.

    with_heads.py NETWORK.safetensors HEADS.safetensors OUT.safetensors [SHARE]

Both began alike, and only the heads of HEADS were trained on, so that the ranges of all other layers are NETWORK's. SHARE of the
heads' change is taken, all of it by default.
"""

import sys

import numpy as np
import weights


def main():
    """Entry point of the script."""
    network, trained, target = sys.argv[1:4]
    share = float(sys.argv[4]) if len(sys.argv) > 4 else 1.0
    facts, tensors = weights.read(network)
    own_facts, own = weights.read(trained)
    for name, tensor in tensors.items():
        if name.startswith("head."):
            tensors[name] = tensor.astype(np.float32) + share * (own[name].astype(np.float32) - tensor)
        elif not np.array_equal(tensor, own[name]):
            raise SystemExit(f"{trained}: {name} was trained on too")
    facts["training"] = own_facts["training"]
    weights.write(target, facts, tensors)


if __name__ == "__main__":
    main()
