"""The command line: one command for each function, with arguments in a TOML file."""

from .command import main as main
