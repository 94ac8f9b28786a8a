"""`python -m demc`: the command `demc`."""

from ._command import main

main()
