"""Where the tables go."""

import sys

from rich.console import Console

console = Console(width=None if sys.stdout.isatty() else 120, highlight=False)
