"""Campaigns: planned lists of missions with a ledger of their results.

Calling the package reads a campaign. The library's function `mavfi_cli.campaign` and this package
share one name. Python binds the name to the package as soon as one of its modules is imported, so
the package itself can be called.
"""

import sys
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from mavfi_cli.library import Campaign


class _CallablePackage(ModuleType):
    """The package as a function."""

    def __call__(self, what: str | Path) -> "Campaign":
        """Read a campaign, as `mavfi_cli.library.campaign`."""
        from mavfi_cli.library import campaign

        return campaign(what)


sys.modules[__name__].__class__ = _CallablePackage
