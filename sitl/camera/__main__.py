"""`python -m sitl.camera`: runs the depth camera for a foreign autopilot."""

import sys

from sitl.camera.command import main

if __name__ == "__main__":
    sys.exit(main())
