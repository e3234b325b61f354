"""What the page tells of some committed campaigns."""

from pathlib import Path

from mavfi_cli.paper.document import document
from mavfi_cli.paper.sources import Evidence

RESULTS = Path(__file__).parents[2] / "docs" / "results"
_CAMPAIGNS = ("instruction", "effects-part2", "protected-part2", "hardening-part1", "sight-part1")


PLACES = [*(RESULTS / f"{name}.parquet" for name in _CAMPAIGNS), RESULTS / "kernels.json"]


def everything():
    """The whole document, made anew."""
    return document(Evidence.gather(PLACES))
