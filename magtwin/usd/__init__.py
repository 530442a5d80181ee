"""Authoring and reading USD. Importing this room registers magtwin's schemas with USD."""

from magtwin.usd.schema import register

register()
