"""Digests of source code: what must not be mixed with what another version has left behind."""

from __future__ import annotations

import hashlib
from functools import cache
from pathlib import Path

PACKAGE = Path(__file__).parents[1]


@cache
def folder_digest(folder: Path, *, deep: bool = False) -> str:
    """SHA-256 of all Python sources of a folder, by name and content; `deep`: and below it."""
    digest = hashlib.sha256()
    for path in sorted(folder.rglob("*.py") if deep else folder.glob("*.py")):
        digest.update(str(path.relative_to(folder)).encode())
        digest.update(path.read_bytes())
    return digest.hexdigest()


def own_digest() -> str:
    """Of all of our own code, the vehicle's side included."""
    parts = [folder_digest(each, deep=True) for each in (PACKAGE, PACKAGE.parent / "sitl")]
    return hashlib.sha256("".join(parts).encode()).hexdigest()
