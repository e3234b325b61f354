"""What the pages about clients show, so that it is run as written."""

import re
from pathlib import Path

FOLDER = Path(__file__).parents[2] / "docs" / "how-to"


def block(page, language):
    """The only block of a language in a page."""
    text = (FOLDER / f"{page}.md").read_text()
    (found,) = re.findall(rf"^```{language}\n(.*?)^```$", text, re.DOTALL | re.MULTILINE)
    return found
