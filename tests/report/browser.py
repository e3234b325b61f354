"""A real headless browser, driven by its command line."""

import html
import json
import re
import shutil
import subprocess

import pytest

_NAMES = ("chromium", "chromium-browser", "google-chrome", "chrome")
_PROBE = """
<script>
const found = {claims: [], overlaps: [], cut: [], wide: document.documentElement.scrollWidth,
  width: window.innerWidth, errors: window.pageErrors};
for (const row of document.querySelectorAll('[id^="claim-"]'))
  found.claims.push({name: row.id.slice(6), words: row.querySelector('.words').innerText,
    verdicts: [...row.querySelectorAll('.verdict')].map(each => each.textContent.trim())});
for (const picture of document.querySelectorAll('figure svg')) {
  const frame = picture.getBoundingClientRect();
  const texts = [...picture.querySelectorAll('text')].filter(each => each.textContent.trim());
  const boxes = texts.map(each => [each.textContent, each.getBoundingClientRect()]);
  const name = picture.closest('figure').innerText.trim();
  boxes.forEach(([one, a], place) => {
    if (a.left < frame.left - 1 || a.right > frame.right + 1) found.cut.push([name, one]);
    for (const [other, b] of boxes.slice(place + 1)) {
      const across = Math.min(a.right, b.right) - Math.max(a.left, b.left);
      const down = Math.min(a.bottom, b.bottom) - Math.max(a.top, b.top);
      if (across > 1 && down > 2) found.overlaps.push([name, one, other]);
    }
  });
}
document.getElementById('show-contradicted').checked = true;
found.filtered = [...document.querySelectorAll('details.claim')]
  .filter(each => each.offsetParent !== null).map(each => each.id.slice(6));
const outside = parent.document;
outside.body.innerHTML = '<pre id="probe"></pre>';
outside.getElementById('probe').textContent = JSON.stringify(found);
</script>
"""
_LISTEN = """
<script>
window.pageErrors = [];
window.addEventListener('error', each => window.pageErrors.push(String(each.message)), true);
</script>
"""


class Browser:
    """Opens pages with a profile of its own.

    Args:
        folder: for the profile and the probed copies of pages.
    """

    def __init__(self, folder):
        found = filter(None, map(shutil.which, _NAMES))
        self._program = next(found, None)
        if self._program is None:
            pytest.skip(f"no headless browser on this machine ({', '.join(_NAMES)})")
        self._folder = folder

    def _run(self, *arguments):
        command = (
            self._program, "--headless", "--no-sandbox", "--disable-gpu", "--no-first-run",
            "--hide-scrollbars", "--enable-logging=stderr", "--v=0",
            f"--user-data-dir={self._folder / 'profile'}", *arguments,
        )  # fmt: skip
        return subprocess.run(command, capture_output=True, text=True, timeout=180, check=True)

    def probe(self, page, width):
        """What a page shows at a width: claims, overlapping labels, console."""
        text = page.read_text(encoding="utf-8")
        text = text.replace("<head>", f"<head>{_LISTEN}", 1).replace("</body>", f"{_PROBE}</body>")
        frame = f'<iframe style="width: {width}px; height: 900px; border: 0" srcdoc="'
        outside = self._folder / "outside.html"  # a window is at least 500 px wide, a frame is not
        outside.write_text(
            f'<meta charset="utf-8"><body>{frame}{html.escape(text)}"></iframe>', encoding="utf-8"
        )
        done = self._run("--dump-dom", outside.as_uri())
        told = re.search(r'<pre id="probe">(.*?)</pre>', done.stdout, re.DOTALL)
        console = [line for line in done.stderr.splitlines() if ":CONSOLE" in line]
        return {**json.loads(html.unescape(told.group(1))), "console": console}

    def pdf(self, page, path):
        """Print a page."""
        self._run(f"--print-to-pdf={path}", "--no-pdf-header-footer", page.as_uri())
