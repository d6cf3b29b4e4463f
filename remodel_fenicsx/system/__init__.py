"""Interfaces to the system: signals, terminal, child processes, files and versions."""

import logging

# Level of lines that explain a long wait: in the log, and on the terminal unless the run is quiet.
# They are not warnings.
NOTICE = (logging.INFO + logging.WARNING) // 2
logging.addLevelName(NOTICE, "NOTICE")
