"""Run the command line by `python -m rover_lib.cli`."""

from rover_lib.cli import main

main()
