"""Takes the prefilter out of a network's weights file, as a network of its own that `demc train --init`
can begin with.

    prefilter.py IN.safetensors OUT.safetensors
"""

import sys

import weights
from weights import PREFILTER


def main():
    """Entry point of the script."""
    source, target = sys.argv[1:]
    facts, tensors = weights.read(source)
    facts["network"] = {"architecture": "prefilter", "widths": facts["network"]["prefilter"]}
    facts.pop("ranges", None)
    own = {name.removeprefix(PREFILTER): tensor for name, tensor in tensors.items() if name.startswith(PREFILTER)}
    weights.write(target, facts, own)


if __name__ == "__main__":
    main()
