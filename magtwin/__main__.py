"""`python -m magtwin` is `magtwin`."""

from magtwin.start import main

main()
