"""Takes the prefilter out of a network's weights file, as a network of its own that `demc train --init`
can begin with.

    prefilter.py IN.safetensors OUT.safetensors
"""

import sys

import weights
from weights import PREFILTER


def of_prefilter(entries):
    """What a network knows of its prefilter's layers, by the names that they have in a prefilter alone."""
    return {name.removeprefix(PREFILTER): entry for name, entry in entries.items() if name.startswith(PREFILTER)}


def main():
    """Entry point of the script."""
    source, target = sys.argv[1:]
    facts, tensors = weights.read(source)
    facts["network"] = {"architecture": "prefilter", "widths": facts["network"]["prefilter"]}
    facts["ranges"] = of_prefilter(facts.get("ranges", {}))
    weights.write(target, facts, of_prefilter(tensors))


if __name__ == "__main__":
    main()
