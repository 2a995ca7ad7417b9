"""Pictures of a page that no plot entry of a scenario gives: a module a page, named as it, with `draw(folder)`."""

from pathlib import Path

PAGES = sorted(p.stem for p in Path(__file__).parent.glob("[a-z]*.py"))
