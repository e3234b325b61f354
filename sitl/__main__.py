"""`python -m sitl`: runs the simulated vehicle alone."""

import sys

INTERRUPTED = 130

if __name__ == "__main__":
    try:
        from sitl.server import main
    except KeyboardInterrupt:  # before the server handles the signal
        sys.exit(INTERRUPTED)
    sys.exit(main())
