"""What surrounds the program: signals, the terminal, versions."""
