"""Authoring and reading USD. Importing this package registers magtwin's schemas with USD."""

from magtwin.usd.schema import register

register()
