"""``python -m docs``, which `scripts/softrig docs` runs."""

from __future__ import annotations

import argparse
import re
import shutil
import sys
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

from softrig_bringup.folder import alone_in
from softrig_core.errors import ScenarioError
from softrig_core.extras import need
from softrig_core.guard import guarded

from .outline import GALLERY, ROOT


def main() -> int:
    """Build the site; warnings are errors."""
    parser = argparse.ArgumentParser(prog="scripts/softrig docs", description=main.__doc__)
    parser.add_argument("--out", type=Path, default=ROOT / "runs" / "docs", metavar="DIR", help="where (runs/docs)")
    parser.add_argument(
        "--serve",
        nargs="?",
        type=int,
        const=8000,
        metavar="PORT",
        help="show it at http://127.0.0.1:PORT (8000; 0: any that is free) until Ctrl-C",
    )
    parser.add_argument(
        "--sources", action="store_true", help="only write what Sphinx reads, and check all links to files"
    )
    given = parser.parse_args()
    with alone_in(given.out):
        status = build(given.out, sources_only=given.sources)
    if status == 0 and given.serve is not None:
        serve(given.out / "html", given.serve)
    return status


def build(out: Path, sources_only: bool = False) -> int:
    """Write the sources to ``out/source`` and the site to ``out/html``; returns the exit status."""
    from . import collect, gallery, reference

    source = out / "source"
    _print("pages and their sources")
    shutil.rmtree(source, ignore_errors=True)
    collect.collect(source)
    gallery.write(source)
    for system in GALLERY:
        gallery.thumbnail(system, source)
    reference.write(source)
    gallery.write_indices(source)
    if sources_only:
        print(source)
        return 0
    need("myst_nb", "the site")  # requires Sphinx as well
    from sphinx.cmd.build import main as sphinx

    from .notebooks import execute

    _print("notebooks")
    execute(source)
    _print("the site, by Sphinx: some minutes")
    shutil.rmtree(out / "html", ignore_errors=True)
    options = ["-q", "-W", "--keep-going", "-b", "html", "-c", str(Path(__file__).parent), "-d", str(out / "doctrees")]
    status = sphinx([*options, str(source), str(out / "html")])
    for page in (out / "html").rglob("*.html"):
        page.write_text(accessible(page.read_text(encoding="utf-8")), encoding="utf-8")
    print(
        "there are warnings: see above" if status else f"wrote {out / 'html' / 'index.html'}",
        file=sys.stderr if status else sys.stdout,
    )
    return 1 if status else 0


def _print(what: str) -> None:
    print(f"softrig: docs: {what}", file=sys.stderr, flush=True)


def accessible(page: str) -> str:
    """Return a page made by Sphinx without accessibility faults.

    A cell without text is no head, what scrolls can be reached by keys, landmarks of one kind have names, a page has a
    head, long names break between their words.
    """
    page = re.sub(r"<th\b[^>]*>(?:\s|</?p>)*</th>", "<td></td>", page)
    page = re.sub(r'(class="highlight-(?:text|none) [^>]*><div class="highlight"><pre)>', r'\1 tabindex="0">', page)
    page = re.sub(
        r'<span class="pre">[^<]*', lambda name: re.sub(r"(?<=\w)([_/.])(?=[^\W\d])", r"\1<wbr>", name[0]), page
    )
    page = page.replace('<div class="table-wrapper', '<div tabindex="0" class="table-wrapper')
    page = page.replace('<aside class="sidebar-drawer"', '<aside class="sidebar-drawer" aria-label="Pages"')
    page = page.replace('<aside class="toc-drawer', '<aside aria-label="On this page" class="toc-drawer')
    page = page.replace('<div id="search-results"', '<h1>Search</h1><div id="search-results"')
    return page.replace(' aria-label="Toggle hidden content"', "")


def serve(folder: Path, port: int) -> None:
    """Show a folder on the loopback address until Ctrl-C."""
    try:
        made = ThreadingHTTPServer(("127.0.0.1", port), partial(SimpleHTTPRequestHandler, directory=folder))
    except OSError as error:
        raise ScenarioError(f"--serve {port}: {error.strerror}; 0 selects a free port") from None
    with made as server:
        print(f"http://127.0.0.1:{server.server_port} (Ctrl-C ends it)", flush=True)
        try:
            server.serve_forever()
        except KeyboardInterrupt:
            print()


if __name__ == "__main__":
    raise SystemExit(guarded(main))
