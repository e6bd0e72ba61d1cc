"""`python -m clothgym`: the same as the command `clothgym`."""

import sys

from clothgym.cli import main

if __name__ == "__main__":
    sys.exit(main())
