"""``python -m optsim`` is the command line."""

from optsim.app.cli import main

main()
