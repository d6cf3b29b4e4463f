"""Strict tables with one-line errors, and TOML in and out; independent of any scene's keys."""
