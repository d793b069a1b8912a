"""``python -m pgkit`` is the command ``pgkit``."""

from pgkit.cli.main import main

main()
