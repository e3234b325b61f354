"""`python -m sitl.world`, which `mavfi world` runs."""

import sys

from sitl.world.command import main

if __name__ == "__main__":
    sys.exit(main())
