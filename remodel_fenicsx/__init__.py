"""Predict how collagen in living tissue reorients under load (Kuhl & Holzapfel 2007) with FEniCSx."""

__version__ = "0.1.0"
