"""`python -m magtwin` is `magtwin`."""

from magtwin.cli import main

main()
