"""A kernel of one's own in one file: `victim` of a library that lies beside it."""

import ctypes
from pathlib import Path

import numpy as np

from mavfi_cli.attack.kernels.catalogue import Kernel
from mavfi_cli.attack.kernels.scope import library_scope

LIBRARY = Path(__file__).with_name("libvictim.so")


def prepare(_inputs):
    library = ctypes.CDLL(str(LIBRARY))
    library.victim.restype = ctypes.c_long
    return lambda: {"result": np.array([library.victim()])}


KERNEL = Kernel(
    name="known",
    title="Known",
    prepare=prepare,
    code=lambda: library_scope(LIBRARY.name, "victim"),
)
