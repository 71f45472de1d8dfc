"""Take the pictures of the README: run the default experiment, open report and preview in Chromium.

::

    make screenshot
    python docs/images/take.py FOLDER      # of an experiment that is there already
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from playwright.sync_api import Browser, ViewportSize, sync_playwright

from runner.preview import planned_motion, preview_html
from runner.report.page import write_report

HERE = Path(__file__).resolve().parent
BROWSERS = ("chromium", "chromium-browser", "google-chrome")
FLAGS = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
SIZE: ViewportSize = {"width": 1280, "height": 800}
# What a browser without a graphics card says of itself has no place in a picture.
CLEAN = ".mantine-Notification-root, .mantine-Notifications-root { display: none !important; }"


def main(arguments: list[str]) -> None:
    """Take all pictures of a run, of one made now unless a folder is named."""
    browser = next((path for name in BROWSERS if (path := shutil.which(name))), None)
    if browser is None:
        sys.exit("no chromium on this computer; install the system's package `chromium`")
    with tempfile.TemporaryDirectory() as place:
        folder = Path(arguments[0]) if arguments else Path(place) / "lwr4plus"
        if not arguments:
            command = [sys.executable, "-m", "runner.cli", "experiment", "--yes", "--out", str(folder)]
            subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
        preview = Path(place) / "preview.html"
        preview.write_text(preview_html(planned_motion(str(folder))), encoding="utf-8")
        report = write_report(folder)
        with sync_playwright() as playwright:
            opened = playwright.chromium.launch(executable_path=browser, args=FLAGS)
            take(opened, report, preview, HERE)
            take_replay(opened, folder, HERE)
            opened.close()


def take(browser: Browser, report: Path, preview: Path, target: Path) -> None:
    """Open the pages and write the pictures into the folder `target`."""
    page = browser.new_page(viewport=SIZE)
    page.goto(report.resolve().as_uri())
    page.wait_for_selector("html[data-ready=yes]", state="attached", timeout=600_000)
    page.screenshot(path=target / "report.png", timeout=600_000)
    page.locator("#torque .panels").first.screenshot(path=target / "report_torque.png", timeout=600_000)
    page.goto(preview.resolve().as_uri())
    frame = page.frames[-1]
    frame.wait_for_selector("canvas", timeout=600_000)
    frame.add_style_tag(content=CLEAN)
    page.wait_for_timeout(8_000)
    page.screenshot(path=target / "preview.png", timeout=600_000)
    page.close()


def take_replay(browser: Browser, folder: Path, target: Path) -> None:
    """Open the replay of a run and write its picture into the folder `target`."""
    command = [sys.executable, "-m", "runner.cli", "replay", str(folder), "--port", "18232"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            page = browser.new_page(viewport=SIZE)
            page.goto(process.stdout.readline().strip())
            page.wait_for_timeout(5_000)
            page.get_by_label("play").uncheck(timeout=600_000)
            page.add_style_tag(content=CLEAN)
            page.wait_for_timeout(8_000)
            page.screenshot(path=target / "replay.png", timeout=600_000)
            page.close()
        finally:
            process.terminate()


if __name__ == "__main__":
    main(sys.argv[1:])
