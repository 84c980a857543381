"""``python -m experiments.cli <command>``."""

from experiments.cli.main import main

main()
