"""Entry point of ``python -m experiments.console <command>``."""

from experiments.console.main import main

main()
