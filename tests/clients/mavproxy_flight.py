"""MAVProxy, unchanged, flies 10 m ahead and lands: this script types what a pilot would type.

Argument: the MAVLink URL of the vehicle.
"""

import importlib.util
import re
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

PREPARE = [
    ("", r"Received \d+ parameters"),
    ("long DO_SET_MODE 1 4 3 0 0 0 0", r"LOITER> "),
    ("arm throttle", r"ARMED"),
    ("long NAV_TAKEOFF 0 0 0 nan nan nan nan", r"TAKEOFF> (?s:.*)LOITER> "),
]
LAND = [("long NAV_LAND", r"LAND> (?s:.*)DISARMED")]
OFFBOARD = "long DO_SET_MODE 1 6 0 0 0 0 0"

program = Path(importlib.util.find_spec("MAVProxy").origin).with_name("mavproxy.py")
folder = tempfile.TemporaryDirectory()  # for MAVProxy's logs
options = ["--default-modules=arm,mode,cmdlong,misc,param", "--nowait"]
proxy = subprocess.Popen(
    [sys.executable, str(program), f"--master={sys.argv[1]}", *options],
    stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, cwd=folder.name,
)  # fmt: skip
text, ended = "", threading.Event()


def read():
    global text
    while piece := proxy.stdout.read1(4096).decode(errors="replace"):
        sys.stdout.write(piece)
        sys.stdout.flush()
        text += piece
    ended.set()


def type_line(line):
    proxy.stdin.write(f"{line}\n".encode())
    proxy.stdin.flush()


def follow(steps):
    """Type each line, and await the pattern in what MAVProxy prints after it."""
    global text
    for line, pattern in steps:
        text = "" if line else text
        type_line(line)
        while not re.search(pattern, text):
            if ended.wait(0.05):
                sys.exit(f"MAVProxy ended before {pattern!r}")


def fly(seconds, ahead_mps):
    for _ in range(round(5 * seconds)):
        type_line(f"velocity {ahead_mps} 0 0")
        time.sleep(0.2)


threading.Thread(target=read, daemon=True).start()
follow(PREPARE)
fly(1, 0)  # OFFBOARD needs setpoints before it begins
type_line(OFFBOARD)
fly(5, 2)
follow(LAND)
proxy.stdin.close()
proxy.wait()
