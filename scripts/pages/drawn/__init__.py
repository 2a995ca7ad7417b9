"""Pictures of a page that are not plots of a scenario: one module for each page, with its name, and `draw(folder)`."""

from pathlib import Path

PAGES = sorted(p.stem for p in Path(__file__).parent.glob("[a-z]*.py"))
