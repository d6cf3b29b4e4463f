"""Independent solutions that the package is compared with; nothing here imports the package."""
