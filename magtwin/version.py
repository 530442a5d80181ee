"""Version of magtwin."""

__version__ = "0.2.0"
