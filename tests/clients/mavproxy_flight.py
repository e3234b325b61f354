"""MAVProxy, unchanged, flies 10 m ahead and lands: this script types what a pilot would type.

Arguments: the MAVLink URL of the vehicle, and its autopilot, px4 (the default) or ardupilot.
"""

import importlib.util
import re
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

PARAMETERS = [("", r"Received \d+ parameters")]
TAKE_OFF = {
    "px4": [
        ("long DO_SET_MODE 1 4 3 0 0 0 0", r"LOITER> "),
        ("arm throttle", r"ARMED"),
        ("long NAV_TAKEOFF 0 0 0 nan nan nan nan", r"TAKEOFF> (?s:.*)LOITER> "),
    ],
    "ardupilot": [
        ("set altreadout 2", ""),  # it then says every 2 m of height
        ("mode GUIDED", r"GUIDED> "),
        ("arm throttle", r"ARMED"),
        ("takeoff 3", r"height [23]"),
    ],
}
FOLLOW = {"px4": "long DO_SET_MODE 1 6 0 0 0 0 0", "ardupilot": "mode GUIDED"}
LAND = {"px4": "long NAV_LAND", "ardupilot": "mode LAND"}

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
autopilot = sys.argv[2] if len(sys.argv) > 2 else "px4"
follow(PARAMETERS + TAKE_OFF[autopilot])
fly(1, 0)  # OFFBOARD needs setpoints before it begins
type_line(FOLLOW[autopilot])
fly(5, 2)
follow([(LAND[autopilot], r"LAND> (?s:.*)DISARMED")])
proxy.stdin.close()
proxy.wait()
