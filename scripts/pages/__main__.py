"""``python -m pages``."""

from .generated import main

raise SystemExit(main())
