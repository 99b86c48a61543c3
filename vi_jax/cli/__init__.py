"""The command line: what a TOML file asks for, as one command for each verb."""

from .command import main as main
