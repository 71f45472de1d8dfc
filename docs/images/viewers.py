"""Open a session log with its layouts in the real viewers, in Chromium, and take their pictures.

::

    pip install rerun-sdk
    npm install --prefix NPM @foxglove/studio-base@1.48.0 react@17.0.2 react-dom@17.0.2
    python docs/images/viewers.py loaded.mcap --rerun rerun --studio NPM/node_modules

`@foxglove/studio-base` is the last public build of Foxglove Studio, from which Lichtblick was forked; its panels and
the format of its layouts are common to all three. The pictures are `rerun.png` and `foxglove.png`.
"""

from __future__ import annotations

import http.server
import json
import os
import re
import shutil
import signal
import subprocess
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import click
from playwright.sync_api import Browser, ViewportSize, sync_playwright

from lwr_driver.configuration import CONFIGS
from runner.rerun_log import open_log

HERE = Path(__file__).resolve().parent
BROWSERS = ("chromium", "chromium-browser", "google-chrome")
FLAGS = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
SIZE: ViewportSize = {"width": 1400, "height": 800}
PAGE = """<!doctype html><meta charset=utf-8><title>Foxglove Studio</title>
<style>html, body, #root { height: 100%; margin: 0; font-family: sans-serif; }</style><div id=root></div>
<script src=react/umd/react.production.min.js></script>
<script src=react-dom/umd/react-dom.production.min.js></script>
<script>
  globalThis.global = globalThis;
  globalThis.process = { env: { NODE_ENV: "production" }, platform: "browser", cwd: () => "/", nextTick: setTimeout };
  globalThis.react = React; globalThis["react-dom"] = ReactDOM;
  globalThis.FOXGLOVE_STUDIO_VERSION = "1.48.0";
</script>
<script src=@foxglove/studio-base/assets/index.js></script>
<script>
  const layout = LAYOUT, settings = new Map([["colorScheme", "light"]]);
  const kept = { id: "lwr", name: "lwr", permission: "CREATOR_WRITE", baseline: { data: layout } };
  const storage = { list: async () => [kept], get: async () => kept, put: async (_, one) => one,
    delete: async () => {}, importLayouts: async () => {}, migrateUnnamespacedLayouts: async () => {} };
  const configuration = { get: (key) => settings.get(key), set: async (key, value) => settings.set(key, value),
    addChangeListener: () => {}, removeChangeListener: () => {} };
  (async () => {
    await initI18n();
    ReactDOM.render(React.createElement(App, { deepLinks: [location.href], appConfiguration: configuration,
      dataSources: [new RemoteDataSourceFactory()], layoutStorage: storage, extensionLoaders: [],
      enableGlobalCss: true }), document.getElementById("root"));
  })();
</script>"""


class _Files(http.server.SimpleHTTPRequestHandler):
    """Files of a folder, also in parts, as viewers read large logs."""

    def do_GET(self) -> None:
        """A file, or the part named by the header Range."""
        asked = re.match(r"bytes=(\d+)-(\d*)$", self.headers.get("Range", ""))
        path = Path(self.translate_path(self.path))
        if asked is None or not path.is_file():
            super().do_GET()
            return
        size = path.stat().st_size
        first, last = int(asked[1]), min(int(asked[2] or size), size - 1)
        self.send_response(206)
        self.send_header("Content-Range", f"bytes {first}-{last}/{size}")
        self.send_header("Content-Length", str(last - first + 1))
        self.end_headers()
        with path.open("rb") as file:
            file.seek(first)
            self.wfile.write(file.read(last - first + 1))

    def end_headers(self) -> None:
        """Parts are served."""
        self.send_header("Accept-Ranges", "bytes")
        super().end_headers()

    def log_message(self, *_: Any) -> None:
        """Silent."""


class _Server(http.server.ThreadingHTTPServer):
    def handle_error(self, *_: Any) -> None:
        """Silent: a viewer breaks off what it needs no longer."""


@contextmanager
def served(folder: Path) -> Iterator[str]:
    """The address of a server of a folder."""
    server = _Server(("127.0.0.1", 0), lambda *given: _Files(*given, directory=str(folder)))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        yield f"http://127.0.0.1:{server.server_address[1]}"
    finally:
        server.shutdown()


def studio(browser: Browser, log: Path, packages: Path, target: Path) -> list[str]:
    """Open the log in Foxglove Studio with `configs/layouts/lwr.json`; returns the errors of its console."""
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        for name in ("react", "react-dom", "@foxglove"):
            (folder / name).symlink_to((packages / name).resolve())
        (folder / "log.mcap").symlink_to(log.resolve())
        layout = json.loads((CONFIGS / "layouts/lwr.json").read_text(encoding="utf-8"))
        (folder / "index.html").write_text(PAGE.replace("LAYOUT", json.dumps(layout)), encoding="utf-8")
        with served(folder) as address:
            page, errors = browser.new_page(viewport=SIZE), []
            page.on("console", lambda said: errors.append(said.text) if said.type == "error" else None)
            page.on("pageerror", lambda error: errors.append(str(error)))
            page.goto(f"{address}/index.html?ds=remote-file&ds.url={address}/log.mcap&layoutId=lwr")
            page.wait_for_timeout(20_000)
            page.mouse.click(25, 25)  # closes the list of topics
            page.mouse.click(838, 58)  # closes a hint
            page.mouse.click(0.4 * SIZE["width"], SIZE["height"] - 56)
            page.mouse.move(0.5 * SIZE["width"], 5)
            page.wait_for_timeout(20_000)
            page.screenshot(path=target, timeout=120_000)
            page.close()
    return errors


def rerun(browser: Browser, log: Path, command: str, target: Path) -> list[str]:
    """Open the log with its layout in Rerun's web viewer; returns the errors of its console."""
    with tempfile.TemporaryDirectory() as place:
        recording = Path(place) / "log.rrd"
        open_log(log, recording)
        serve = [command, str(recording), "--serve-web", "--web-viewer-port", "19090", "--port", "19876"]
        quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        with subprocess.Popen(serve, start_new_session=True, **quiet) as process:
            try:
                time.sleep(8.0)
                page, errors = browser.new_page(viewport=SIZE), []
                page.on("console", lambda said: errors.append(said.text) if said.type == "error" else None)
                source = "rerun%2Bhttp://127.0.0.1:19876/proxy"
                page.goto(f"http://127.0.0.1:19090/?url={source}&renderer=webgl")
                page.wait_for_timeout(90_000)
                page.screenshot(path=target, timeout=120_000)
                page.close()
            finally:
                os.killpg(process.pid, signal.SIGKILL)
    return errors


@click.command()
@click.argument("log", type=click.Path(path_type=Path, exists=True))
@click.option("--rerun", "rerun_command", help="The program of rerun-sdk.")
@click.option("--studio", "packages", type=click.Path(path_type=Path), help="Folder node_modules.")
@click.option("--out", type=click.Path(path_type=Path), default=HERE, help="Folder of the pictures.")
def main(log: Path, rerun_command: str | None, packages: Path | None, out: Path) -> None:
    """Take the pictures of the viewers with LOG, of those that are named."""
    chromium = next((path for name in BROWSERS if (path := shutil.which(name))), None)
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium, args=FLAGS)
        if packages is not None:
            click.echo("\n".join(studio(browser, log, packages, out / "foxglove.png")) or "no error")
        if rerun_command is not None:
            click.echo("\n".join(rerun(browser, log, rerun_command, out / "rerun.png")) or "no error")
        browser.close()


if __name__ == "__main__":
    main()
