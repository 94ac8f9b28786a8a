"""The command `demc`: the same program as cargo installs."""

import signal
import sys


def main():
    from . import _demc

    # Python's own handler would be called as well, and end in a traceback.
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    sys.exit(_demc.command(sys.argv))
