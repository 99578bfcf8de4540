"""The command line."""

from covocp.cli.commands import main as main
