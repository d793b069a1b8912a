"""The ``pgkit`` command."""
