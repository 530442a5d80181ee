"""Version of magtwin."""

__version__ = "0.3.0"
