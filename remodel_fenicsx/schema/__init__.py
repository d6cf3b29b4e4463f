"""Strict tables with one-line errors, and TOML input and output, independent of any scene's
keys."""
