"""A template of an artificial kernel in a shared library, whose outcomes are known."""

import ctypes
import os
import sys

import numpy as np

from mavfi_cli.campaign.kernels import template
from mavfi_cli.campaign.kernels.catalogue import Kernel
from mavfi_cli.fi.native.image import Image
from mavfi_cli.mission.instruction.scope import KernelScope


class Known(Kernel):
    """Calls `victim` of a library."""

    def scope(self):
        name = os.path.basename(library_path)
        entry = Image(os.getpid()).function("victim", [name])
        return KernelScope(kernel=self.name, entry=entry, objects=(name,), regions={})


library_path = template.receive_inputs().decode()
library = ctypes.CDLL(library_path)
library.victim.restype = ctypes.c_long
template.serve(
    Known(name="known", title="known", prepare=lambda _: None),
    lambda: {"result": np.array([library.victim()])},
)
sys.exit(0)
