"""Open every page of the built documentation in Chromium and say what is wrong with it.

    python docs/check_in_browser.py [docs/_build/html] [--pictures folder]

Wrong are: an error in the console, a request that fails or leaves this machine, a link to a page or an anchor that does
not exist, a picture that is not drawn, a search without results. Needs Chromium (`chromium`, `google-chrome` or the
path in CHROMIUM).
"""

from __future__ import annotations

import argparse
import os
import shutil
import sys
import threading
import time
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from urllib.parse import unquote, urldefrag

from playwright.sync_api import Browser, Page, Route, sync_playwright

BUILT = Path(__file__).resolve().parent / "_build" / "html"
NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
ARGUMENTS = (
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
)
QUERIES = ("covariance", "export_c", "Riccati")
FOUND = "#search-results ul.search li"
SECONDS = 20.0
# Pictures below the window are loaded late: asks for them now.
DRAW = """() => Promise.all([...document.images].map(image => {
    image.loading = 'eager';
    return image.decode().catch(() => 0);
}))"""
# What a page says of itself: its links as absolute addresses, its anchors, the pictures that are not drawn.
LOOK = """() => ({
    links: [...document.querySelectorAll('a[href]')].map(a => a.href),
    anchors: [...document.querySelectorAll('[id], a[name]')].map(e => e.id || e.name),
    blank: [...document.images].filter(i => !i.complete || !i.naturalWidth).map(i => i.src),
    title: document.title,
    words: (document.querySelector('article') || document.body).innerText.length,
})"""


class Quiet(SimpleHTTPRequestHandler):
    """A server of files that does not print."""

    def log_message(self, format: str, *arguments: object) -> None:
        """Say nothing."""


def chromium() -> str:
    """The path of the browser."""
    found = os.environ.get("CHROMIUM") or next(filter(None, map(shutil.which, NAMES)), None)
    if found is None:
        raise SystemExit(f"no Chromium: none of {', '.join(NAMES)} is installed, and CHROMIUM is not set")
    return found


def watched(browser: Browser, home: str, wrong: list[str]) -> Page:
    """A page whose errors are written down."""
    page = browser.new_page(viewport={"width": 1280, "height": 900})

    def local_only(route: Route) -> None:
        if route.request.url.startswith((home, "data:")):
            route.continue_()
        else:
            wrong.append(f"{page.url}: asks for {route.request.url}")
            route.abort()

    page.route("**/*", local_only)
    page.on("console", lambda m: wrong.append(f"{page.url}: console: {m.text}") if m.type == "error" else None)
    page.on("pageerror", lambda error: wrong.append(f"{page.url}: {error}"))
    page.on("requestfailed", lambda r: wrong.append(f"{page.url}: failed: {r.url}"))
    page.on("response", lambda r: wrong.append(f"{page.url}: {r.status} for {r.url}") if r.status >= 400 else None)
    return page


def look_at_pages(page: Page, home: str, built: Path, names: list[str], wrong: list[str]) -> int:
    """Open all pages; then follow their links in what was found. Returns the number of links."""
    anchors: dict[str, set[str]] = {}
    links: dict[str, list[str]] = {}
    for name in names:
        page.goto(home + name, wait_until="load")
        page.evaluate(DRAW)
        seen = page.evaluate(LOOK)
        anchors[home + name] = set(seen["anchors"])
        links[name] = [link for link in seen["links"] if link.startswith(home)]
        wrong += [f"{name}: picture not drawn: {source}" for source in seen["blank"]]
        if not seen["title"].strip() or (seen["words"] < 20 and name != "search.html"):
            wrong.append(f"{name}: no title, or nothing on it")
    for name, found in links.items():
        for link in sorted(set(found)):
            address, anchor = urldefrag(link)
            address += "index.html" if address.endswith("/") else ""
            if address in anchors:
                if anchor and unquote(anchor) not in anchors[address]:
                    wrong.append(f"{name}: no anchor: {link}")
            elif not (built / unquote(address.removeprefix(home))).is_file():
                wrong.append(f"{name}: no page: {link}")
    return sum(map(len, links.values()))


def search(page: Page, home: str, wrong: list[str]) -> None:
    """Ask the search page."""
    for query in QUERIES:
        page.goto(f"{home}search.html?q={query}")
        end = time.monotonic() + SECONDS
        while not page.locator(FOUND).count() and time.monotonic() < end:
            page.wait_for_timeout(100)
        page.wait_for_load_state("networkidle")  # each result shows a line of its page, which it asks for
        count = page.locator(FOUND).count()
        print(f"search for {query}: {count} results")
        if not count:
            wrong.append(f"search.html: nothing found for {query}")


def take_pictures(page: Page, home: str, names: list[str], folder: Path) -> None:
    """Pictures of some pages, whole, for a look by eye."""
    folder.mkdir(parents=True, exist_ok=True)
    for name in names:
        page.goto(home + name, wait_until="load")
        page.screenshot(path=folder / (name.replace("/", "-").removesuffix(".html") + ".png"), full_page=True)


def main() -> None:
    """Check all pages."""
    parser = argparse.ArgumentParser(description="open every page of the built documentation in Chromium")
    parser.add_argument("built", nargs="?", type=Path, default=BUILT)
    parser.add_argument("--pictures", type=Path, help="write pictures of pages into this folder")
    parser.add_argument("--of", nargs="*", default=["index.html"], help="pages that --pictures shows")
    arguments = parser.parse_args()
    built = arguments.built.resolve()
    names = sorted(path.relative_to(built).as_posix() for path in built.rglob("*.html"))
    if "index.html" not in names:
        raise SystemExit(f"no documentation in {built}: build it first")
    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(Quiet, directory=str(built)))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    home, wrong = f"http://127.0.0.1:{server.server_port}/", []
    with sync_playwright() as play:
        browser = play.chromium.launch(executable_path=chromium(), args=list(ARGUMENTS))
        page = watched(browser, home, wrong)
        if arguments.pictures:
            take_pictures(page, home, arguments.of, arguments.pictures)
        else:
            links = look_at_pages(page, home, built, names, wrong)
            search(page, home, wrong)
            print(f"{len(names)} pages, {links} links within them")
        browser.close()
    server.shutdown()
    for line in wrong:
        print(line, file=sys.stderr)
    if wrong:
        raise SystemExit(f"{len(wrong)} faults")


if __name__ == "__main__":
    main()
