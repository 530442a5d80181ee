"""Version: the one place where it stands, below every room that writes it into what it makes."""

__version__ = "0.1.0"
