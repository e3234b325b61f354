"""Print depth frames: `mavfi fly --companion "python depth_client.py {camera} 10"`."""

import socket
import struct
import sys

import numpy as np

HEADER = struct.Struct("<8sQIIf3f4f")


def read_frame(stream):
    """Return stamp (us), depth (rows, columns) in m, field of view, position, quaternion."""
    fields = HEADER.unpack(stream.read(HEADER.size))
    magic, stamp_us, columns, rows, hfov_rad = fields[:5]
    if magic != b"MAVFI-D1" or not (0 < columns <= 2048 and 0 < rows <= 2048):
        sys.exit("this is no depth frame")
    depth_m = np.frombuffer(stream.read(4 * columns * rows), "<f4").reshape(rows, columns)
    return stamp_us, depth_m, hfov_rad, fields[5:8], fields[8:]


with socket.socket(socket.AF_UNIX) as link:
    link.connect(sys.argv[1])
    stream = link.makefile("rb")
    for _ in range(int(sys.argv[2])):
        stamp_us, depth_m, hfov_rad, position_enu_m, quaternion = read_frame(stream)
        place = " ".join(f"{value:.2f}" for value in position_enu_m)
        print(stamp_us, *depth_m.shape, f"{depth_m.min():.1f} m, at {place}", flush=True)
