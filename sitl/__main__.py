"""`python -m sitl`: the simulated vehicle on its own."""

import sys

INTERRUPTED = 130

if __name__ == "__main__":
    try:
        from sitl.server.main import main
    except KeyboardInterrupt:  # before the server listens for it
        sys.exit(INTERRUPTED)
    sys.exit(main())
