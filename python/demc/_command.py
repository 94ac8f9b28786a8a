"""The command `demc`: the same program as cargo installs."""

import sys


def main():
    from . import _demc

    sys.exit(_demc.command(sys.argv))
