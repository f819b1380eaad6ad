"""The one exception of the package."""

from __future__ import annotations


class ModelError(Exception):
    """A model can't be loaded, was given an unusable image, or failed; the text says what to do."""
