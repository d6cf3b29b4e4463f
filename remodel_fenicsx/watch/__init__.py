"""What looks on and warns, off the path of a step: each is a `Watcher`, and a run is the same without it."""
