"""A browser without a network, and what it saw of a page."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from importlib import resources
from pathlib import Path
from typing import Any

from playwright.sync_api import Browser, Page, sync_playwright

WIDE, NARROW = (1280, 800), (400, 800)
FLAGS = [
    "--no-sandbox",
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    # Pages drawn by the processor itself, not by an emulated graphics card; 3D views still take the latter.
    "--disable-gpu-rasterization",
    "--disable-gpu-compositing",
    "--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE 127.0.0.1",
]
CHROMIUM = ("chromium", "chromium-browser", "google-chrome")


def chromium() -> str | None:
    """Path of the browser, None where this computer has none."""
    return next((path for name in CHROMIUM if (path := shutil.which(name))), None)


@contextmanager
def browser() -> Iterator[Browser]:
    with sync_playwright() as playwright:
        opened = playwright.chromium.launch(executable_path=chromium(), args=FLAGS)
        yield opened
        opened.close()


@dataclass
class Seen:
    """A page with every error of its console and every request that left the computer."""

    page: Page
    errors: list[str] = field(default_factory=list)
    external: list[str] = field(default_factory=list)

    def wait_drawn(self) -> None:
        """Until every chart that is not folded away is drawn."""
        self.page.wait_for_selector("html[data-ready=yes]", state="attached", timeout=120_000)


@contextmanager
def opened(browser: Browser, address: str | Path, size: tuple[int, int] = WIDE) -> Iterator[Seen]:
    page = browser.new_page(viewport={"width": size[0], "height": size[1]})
    seen = Seen(page)

    def console(message: Any) -> None:
        if message.type == "error":
            seen.errors.append(message.text)

    def request(sent: Any) -> None:
        if not sent.url.startswith(
            ("file:", "data:", "blob:", "about:", "http://127.0.0.1", "ws://127.0.0.1")
        ):
            seen.external.append(sent.url)

    page.on("console", console)
    page.on("pageerror", lambda error: seen.errors.append(str(error)))
    page.on("request", request)
    page.goto(address.as_uri() if isinstance(address, Path) else address, wait_until="load", timeout=120_000)
    yield seen
    page.close()


CONTRAST = """() => {
  const light = (c) => { const v = c / 255; return v <= 0.03928 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4; };
  const luminance = ([r, g, b]) => 0.2126 * light(r) + 0.7152 * light(g) + 0.0722 * light(b);
  const parts = (text) => text.match(/[\\d.]+/g).map(Number);
  const ground = (node) => {
    for (; node; node = node.parentElement) {
      const c = parts(getComputedStyle(node).backgroundColor);
      if (c.length < 4 || c[3] > 0) return c;
    }
    return [255, 255, 255];
  };
  const worst = [];
  for (const node of document.querySelectorAll('h1,h2,h3,p,th,td,a,summary,span,figcaption,li,footer,pre')) {
    if (node.offsetParent === null || !node.textContent.trim()) continue;
    const a = luminance(parts(getComputedStyle(node).color)), b = luminance(ground(node));
    worst.push((Math.max(a, b) + 0.05) / (Math.min(a, b) + 0.05));
  }
  return Math.min(...worst);
}"""
"""Lowest contrast of any text to what is behind it, as WCAG 2 counts."""


CUT = """() => [...document.querySelectorAll('body *')].filter((node) => {
  const box = node.getBoundingClientRect();
  if (!box.width || !box.height || box.right <= innerWidth + 1) return false;
  for (let outer = node.parentElement; outer; outer = outer.parentElement) {
    if (['auto', 'scroll', 'hidden'].includes(getComputedStyle(outer).overflowX)) return false;
  }
  return true;
}).map((node) => node.outerHTML.slice(0, 80))"""
"""What reaches beyond the window outside of boxes that scroll or clip."""


CLIPPED = """() => [...document.querySelectorAll('body *')].filter((node) => {
  if (node.scrollWidth <= node.clientWidth + 1 || !node.clientWidth || !node.childNodes.length) return false;
  return ['auto', 'scroll', 'hidden'].includes(getComputedStyle(node).overflowX);
}).map((node) => node.outerHTML.slice(0, 80))"""
"""What clips or scrolls its content sideways."""


VIOLATIONS = """async () => {
  const taken = [...document.querySelectorAll('tbody tr:nth-child(n+6), .chart svg')].map((node) => {
    const mark = document.createComment('');
    node.replaceWith(mark);
    return [mark, node];
  });
  const found = await axe.run(document, {resultTypes: ['violations'], preload: false, iframes: false});
  taken.forEach(([mark, node]) => mark.replaceWith(node));
  return found.violations;
}"""
"""What axe-core finds without most rows of the tables, which are alike, and the insides of charts, each an image with a
text: with them it takes three times as long."""


def flaws(seen: Seen) -> list[str]:
    """What is wrong with a page: errors, requests, cut content, and serious violations found by axe-core."""
    page = seen.page
    found = [f"console: {error}" for error in seen.errors] + [f"request: {one}" for one in seen.external]
    width = page.evaluate("[document.documentElement.scrollWidth, window.innerWidth]")
    if width[0] > width[1]:
        found.append(f"{width[0]} px wide in a window of {width[1]} px")
    found += [f"cut off: {html}" for html in page.evaluate(CUT)]
    axe = resources.files("axe_playwright_python").joinpath("axe.min.js").read_text(encoding="utf-8")
    for frame in page.frames:
        # Nobody meets a hidden frame, such as that of the site's search.
        if frame.parent_frame is not None and not frame.frame_element().is_visible():
            continue
        frame.evaluate(axe)
        for violation in frame.evaluate(VIOLATIONS):
            if violation["impact"] in ("serious", "critical"):
                first = violation["nodes"][0]
                found.append(f"{violation['id']}, {len(violation['nodes'])} times: {first['html'][:120]}")
    return found
