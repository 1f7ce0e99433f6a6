"""`python -m nermo_mjx` is the command `nermo-mjx`."""

from nermo_mjx.cli import main

main(prog_name="nermo-mjx")
