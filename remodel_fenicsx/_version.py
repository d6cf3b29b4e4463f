"""The version of the package: a leaf, so that every room may ask for it."""

__version__ = "0.5.0"
