"""Digests of source code, to keep results of different versions apart."""

from __future__ import annotations

import hashlib
from functools import cache
from pathlib import Path

PACKAGE = Path(__file__).parents[1]


@cache
def folder_digest(folder: Path, *, deep: bool = False) -> str:
    """Return the SHA-256 of names and contents of all Python sources in a folder.

    `deep` includes its subfolders.
    """
    digest = hashlib.sha256()
    for path in sorted(folder.rglob("*.py") if deep else folder.glob("*.py")):
        digest.update(str(path.relative_to(folder)).encode())
        digest.update(path.read_bytes())
    return digest.hexdigest()


def own_digest() -> str:
    """Return the SHA-256 of all sources of mavfi, including the simulated vehicle."""
    parts = [folder_digest(each, deep=True) for each in (PACKAGE, PACKAGE.parent / "sitl")]
    return hashlib.sha256("".join(parts).encode()).hexdigest()
