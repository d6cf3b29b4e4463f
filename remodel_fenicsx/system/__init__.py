"""What surrounds the program: signals, the terminal, versions."""

import logging

# a level for the log, and for the terminal unless it is to be quiet: a wait with its reason. No warning: all is well
NOTICE = (logging.INFO + logging.WARNING) // 2
logging.addLevelName(NOTICE, "NOTICE")
