"""``python -m optsim`` is the command line."""

from optsim.cli import main

main()
