"""Strict tables with errors of one line, and TOML in and out; knows no key of any scene."""
