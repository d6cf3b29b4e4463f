"""Entry point of ``python -m remodel_fenicsx``, the command remodel-fenicsx."""

import sys

from remodel_fenicsx.cli import main

if __name__ == "__main__":
    sys.exit(main())
