"""The command `demc`: the same program as cargo installs."""

import os
import signal
import sys
import sysconfig


def main():
    from . import _demc

    # Python's own handler would be called as well, and end in a traceback.
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    program = sys.argv[0]
    if os.path.basename(program) == "__main__.py":  # `python -m demc`, which is no program that could be started again
        program = os.path.join(sysconfig.get_path("scripts"), "demc")
    sys.exit(_demc.command([program, *sys.argv[1:]]))
