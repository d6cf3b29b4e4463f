"""What is kept of a run, and read back: columns, history, fields."""
