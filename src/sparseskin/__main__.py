"""The command `sparseskin` as `python -m sparseskin`."""

import sys

from sparseskin.launch.commands.entry import main

if __name__ == "__main__":
    sys.exit(main())
