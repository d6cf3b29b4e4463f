"""What a step changes, and what a transaction restores: unknown, cells, loads, and the numbers of the tissue."""
