"""Studies: several runs of a scene that answer one question."""
