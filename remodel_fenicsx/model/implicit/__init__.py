"""Cells that answer within a solve: the local Newton method at each point, and the consistent tangent."""
